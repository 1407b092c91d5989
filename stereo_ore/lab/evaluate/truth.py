"""A scene folder's truth as arrays in metres."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stereo_ore.errors import SourceError
from stereo_ore.io.npz_io import load_arrays
from stereo_ore.types import F64, I32

LUMP_KEYS = (
    "com_left_mm",
    "com_world_mm",
    "volume_mm3",
    "obb_dims_mm",
    "max_caliper_mm",
    "oversize",
)
"""What gt.json must say of a lump that must be found."""
MIN_PIXELS, MIN_VISIBLE = 400, 0.3
"""Lumps that show fewer pixels, or a smaller share of themselves, need not be found."""


def must_be_found(visible_pixels: int, visible_fraction: float, cut: bool) -> bool:
    """Whether a lump counts: enough of it is seen, and the image border does not cut it."""
    return visible_pixels >= MIN_PIXELS and visible_fraction >= MIN_VISIBLE and not cut


@dataclass(frozen=True)
class Truth:
    """What is true of the rectified left view.

    `depth` (H, W) [m], 0 where nothing is seen; `instance` (H, W), lumps from 2 on; `lumps` by id,
    as gt.json has them (mm); `normal` of the screen in the arm's frame; `K` [px] and
    `focal_baseline` [px m].
    """

    name: str
    depth: F64
    instance: I32
    K: F64
    focal_baseline: float
    lumps: dict[int, dict[str, Any]]
    opening_m: float
    normal: F64

    @property
    def disparity(self) -> F64:
        """(H, W) [px], 0 where nothing is seen."""
        return np.where(self.depth > 0, self.focal_baseline / np.maximum(self.depth, 1e-6), 0)

    @property
    def wanted(self) -> list[int]:
        """Ids of the lumps that must be found."""
        return [
            id_
            for id_, lump in self.lumps.items()
            if must_be_found(
                lump["visible_pixels"], lump["visible_fraction"], lump["cut_by_image_border"]
            )
        ]

    def centre(self, id_: int) -> F64:
        """Centre of mass of a lump in the rectified left camera [m]."""
        lump = self.lumps[id_]
        return np.array(lump.get("com_left_rect_mm", lump["com_left_mm"])) / 1000


def load_truth(scene: Path) -> Truth:
    """The truth of a scene folder with calib.json, gt.json and gt.npz.

    Raises
    ------
    SourceError
        When a file is missing or lacks a key, naming both.
    """
    try:
        calib = json.loads((scene / "calib.json").read_text(encoding="utf-8"))
        truth = json.loads((scene / "gt.json").read_text(encoding="utf-8"))
        return _truth(scene.name, calib, truth, load_arrays(scene / "gt.npz", SourceError))
    except (OSError, ValueError, TypeError, IndexError, AttributeError, RecursionError) as fault:
        raise SourceError(f"truth can't be read: {fault}", file=scene) from None
    except KeyError as fault:
        remedy = (
            "A scene folder holds calib.json, gt.json and gt.npz as `stereo-ore synth` writes them"
        )
        raise SourceError("is missing", file=scene, key=str(fault.args[0]), remedy=remedy) from None


def _truth(
    name: str, calib: dict[str, Any], truth: dict[str, Any], arrays: dict[str, Any]
) -> Truth:
    if calib.get("rectified", True):
        depth, instance = arrays["depth_left_mm"], arrays["instance_left"]
        K, focal_baseline = (
            np.array(calib["K"], float),
            calib["K"][0][0] * calib["baseline_mm"] / 1000,
        )
    else:
        depth, instance = arrays["depth_left_rect_mm"], arrays["instance_left_rect"]
        reference = calib["reference_rectification"]
        K, focal_baseline = np.array(reference["P1"])[:, :3], -reference["P2"][0][3] / 1000
    if depth.ndim != 2 or depth.shape != instance.shape:
        raise ValueError(f"depth and instances have the shapes {depth.shape} and {instance.shape}")
    normal = np.array(truth["T_world_screen"], float)[:3, 2]
    lumps = {lump["id"]: lump for lump in truth["lumps"]}
    opening = truth["clear_opening_mm"] / 1000
    whole = Truth(
        name, depth / 1000, instance.astype(np.int32), K, focal_baseline, lumps, opening, normal
    )
    if missing := [key for id_ in whole.wanted for key in LUMP_KEYS if key not in lumps[id_]]:
        raise KeyError(missing[0])
    return whole
