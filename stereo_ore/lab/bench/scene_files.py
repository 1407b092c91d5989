"""Calibration and working volume of a scene folder that has truth files, with or without the native
YAML files.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from stereo_ore.errors import SourceError
from stereo_ore.io import calibration
from stereo_ore.io.site import load_site
from stereo_ore.types import F64, BarLine, CameraModel, Plane, Site, StereoCalibration, Volume

BELOW_M, ABOVE_M = 0.15, 1.0
"""Depth and height of the working volume about the bar tops."""


def load_rig(folder: Path) -> tuple[StereoCalibration, Site]:
    """Calibration and site: the YAML files if there, else what calib.json and gt.json say.

    Raises
    ------
    SourceError
        When neither is whole.
    """
    if (folder / "calibration.yaml").exists() and (folder / "site.yaml").exists():
        return calibration.load(folder / "calibration.yaml"), load_site(folder / "site.yaml")
    try:
        calib, truth = (
            json.loads((folder / name).read_text(encoding="utf-8"))
            for name in ("calib.json", "gt.json")
        )
        opening, bar_width = truth["clear_opening_mm"] / 1000, truth["bar_width_mm"] / 1000
        T_screen_camera = _screen_from_camera(calib, truth)
        # Row z of the transform: height over the screen.
        plane = Plane(T_screen_camera[2, :3], -float(T_screen_camera[2, 3]))
        volume, bar = _volume(T_screen_camera, truth), _bar(T_screen_camera, truth)
        site = Site(None, volume, plane, opening, bar_width, bar=bar)
        return _calibration(folder.name, calib), site
    except (OSError, ValueError) as fault:
        raise SourceError(f"truth can't be read: {fault}", file=folder) from None
    except KeyError as fault:
        raise SourceError("is missing", file=folder, key=str(fault.args[0])) from None


def _calibration(name: str, calib: dict[str, Any]) -> StereoCalibration:
    size = (int(calib["width"]), int(calib["height"]))
    if calib.get("rectified", True):
        eye = _eye(calib["K"])
        return StereoCalibration(
            size, eye, eye, np.eye(3), np.array([-calib["baseline_mm"] / 1000, 0, 0]), camera=name
        )
    left, right = (_eye(calib[side]["K"], calib[side]["dist"]) for side in ("left", "right"))
    t = np.array(calib["t_right_left_mm"], float) / 1000
    return StereoCalibration(
        size, left, right, np.array(calib["R_right_left"], float), t, "raw", camera=name
    )


def _eye(K: list[list[float]], distortion: list[float] | None = None) -> CameraModel:
    return CameraModel((K[0][0], K[1][1]), (K[0][2], K[1][2]), tuple(np.ravel(distortion or ())))


def _screen_from_camera(calib: dict[str, Any], truth: dict[str, Any]) -> F64:
    T_world_camera = np.array(calib["T_world_left"], float)
    if not calib.get("rectified", True):
        T_world_camera[:3, :3] @= np.array(calib["reference_rectification"]["R1"], float).T
    T_screen_camera: F64 = np.linalg.solve(np.array(truth["T_world_screen"], float), T_world_camera)
    T_screen_camera[:3, 3] /= 1000
    return T_screen_camera


def _bar(T_screen_camera: F64, truth: dict[str, Any]) -> BarLine | None:
    """The middle bar, where the truth has their places."""
    middles = truth.get("bar_centres_x_mm")
    if not middles:
        return None
    middle = np.array([middles[len(middles) // 2] / 1000, 0, 0])
    return BarLine(middle, np.array([0.0, 1, 0])).seen_from(T_screen_camera)


def _volume(T_screen_camera: F64, truth: dict[str, Any]) -> Volume:
    """The screen's rectangle, `BELOW_M` under the bar tops to `ABOVE_M` over them."""
    half = np.array(truth["screen_size_mm"], float)[:2] / 2000
    return Volume(T_screen_camera, np.array([*-half, -BELOW_M]), np.array([*half, ABOVE_M]))
