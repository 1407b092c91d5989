"""Scenes that faults are planted in, made up or from a folder with truth, and what is wrong with a
target in them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from stereo_ore.io.recordings import open_source
from stereo_ore.lab import synth
from stereo_ore.lab.bench.scene_files import load_rig
from stereo_ore.lab.evaluate.truth import load_truth
from stereo_ore.stages.rectify import make_rectifier
from stereo_ore.transforms import transform_points
from stereo_ore.types import F64, U8, Json, Mask, Rig, Site, StereoCalibration, StereoPair

LIMIT_M, LIMIT_SHARE = 0.03, 0.03
"""A strike this far from each lump, or this share of its distance from the camera, is wrong."""
_FIRST_LUMP, _TOOL = 2, 255
"""Labels of the true instances: lumps from the first of these on, but for the breaker's hammer."""
NOISE_GREY = 0.7
"""Standard deviation of what another exposure differs by."""


@dataclass(frozen=True)
class Case:
    """What a run is given: frames, the last of which is judged, calibration and site."""

    frames: tuple[StereoPair, ...]
    calibration: StereoCalibration
    site: Site


@dataclass(frozen=True)
class Planted:
    """A scene as it is: the sound case, its geometry, the pixels of lumps, and where they truly
    are.

    `lumps` finds the nearest of their visible true points in the arm's frame [m]; `depth_m` (H, W)
    is NaN where nothing is known.
    """

    name: str
    case: Case
    rig: Rig
    depth_m: F64
    ore: Mask
    lumps: KDTree

    def wrong_targets(self, record: Json) -> int:
        """Number of targets whose strike lies on no true lump."""
        ores = {ore["id"]: ore for ore in record["ores"]}
        return sum(self._is_off(ores[target]["strike"]["point"]) for target in record["targets"])

    def _is_off(self, point: dict[str, Any]) -> bool:
        off = float(self.lumps.query(np.array(point["arm"]))[0])
        return bool(off > max(LIMIT_M, LIMIT_SHARE * point["camera"][2]))


def made_scenes(scene: synth.Scene) -> Planted:
    """A made-up scene."""
    case = Case((scene.pair,), scene.calibration, scene.site)
    return _planted(scene.spec.name, case, scene.depth_m.astype(float), scene.instance)


def traced(folder: Path) -> Planted:
    """A folder with left.png, right.png and the truth of its left view; the arm's frame is the
    camera's.

    Raises
    ------
    SourceError
        When pair or truth are missing.
    """
    calibration, site = load_rig(folder)
    truth = load_truth(folder)
    pair = replace(open_source(folder).read(0), name=folder.name)
    case = Case((pair,), calibration, replace(site, T_arm_camera=np.eye(4)))
    return _planted(
        folder.name, case, np.where(truth.depth > 0, truth.depth, np.nan), truth.instance
    )


def _planted(name: str, case: Case, depth_m: F64, instance: Any) -> Planted:
    ore = (instance >= _FIRST_LUMP) & (instance != _TOOL) & np.isfinite(depth_m)
    v, u = np.nonzero(ore)
    rig = make_rectifier(case.calibration).rig
    T = case.site.T_arm_camera
    assert T is not None, "the arm's frame is known"
    points = (
        transform_points(T, rig.back_project(u, v, depth_m[ore]))
        if len(u)
        else np.full((1, 3), np.inf)
    )
    return Planted(name, case, rig, depth_m, ore, KDTree(points))


def exposed(pair: StereoPair, seed: int) -> StereoPair:
    """The pair as a sensor gives it once more, with other noise."""
    return replace(pair, left=_noisy(pair.left, seed, 0), right=_noisy(pair.right, seed, 1))


def _noisy(image: U8, seed: int, eye: int) -> U8:
    noise = np.random.default_rng([seed, eye]).normal(0, NOISE_GREY, image.shape)
    return np.asarray(np.clip(np.rint(image + noise), 0, 255), np.uint8)
