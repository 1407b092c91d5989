"""Settings of stella_vslam and OpenVSLAM: a rectified camera with ``focal_x_baseline`` [px m] and,
for raw images, ``StereoRectifier`` with K, D, R of each eye.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration import ros
from stereo_ore.io.calibration.file_storage import plain_yaml
from stereo_ore.io.calibration.formats import Hints, numbers, tell_unread
from stereo_ore.io.yaml_io import parse_yaml
from stereo_ore.types import F64, StereoCalibration

_CAMERA = ("fx", "fy", "cx", "cy", "cols", "rows", "focal_x_baseline")
_UNUSED = ("name", "setup", "model", "fps", "depth_threshold", "color_order", "num_grid_cols")
_EYE = ("K", "D", "R")
_MODELS = {"perspective": "rational_polynomial", "fisheye": "equidistant"}


def recognises(text: str) -> bool:
    """Whether the text has the baseline as these programs have it."""
    return bool(re.search(r"^[ \t]*(Camera\.)?focal_x_baseline:", text, re.MULTILINE))


def read(path: Path, text: str, hints: Hints) -> StereoCalibration:
    """The calibration in the settings: of raw images where the rectifier is there.

    Raises
    ------
    CalibrationError
        When a key is missing or the lens model is unknown.
    """
    data = parse_yaml(plain_yaml(text), path, CalibrationError, aliases=True)
    camera, rectifier = _group(data, "Camera"), _group(data, "StereoRectifier")
    lens = {key: value for key, value in camera.items() if key not in (*_CAMERA, *_UNUSED)}
    tell_unread(path, lens, "Camera: ")
    fx, fy, cx, cy, *size, shift = numbers(path, "Camera", [camera.get(key) for key in _CAMERA], 7)
    P = np.array([[fx, 0, cx, 0], [0, fy, cy, 0], [0, 0, 1, 0]])
    eyes = []
    for side, along in (("left", 0.0), ("right", -float(shift))):
        P[0, 3] = along
        common = {"width": float(size[0]), "height": float(size[1]), "P": P.ravel().copy()}
        eyes.append(common | _raw(path, rectifier, side, P))
    known = ("model", *(f"{letter}_{side}" for letter in _EYE for side in ("left", "right")))
    unread = {key: value for key, value in rectifier.items() if key not in known}
    tell_unread(path, unread, "StereoRectifier: ")
    if not rectifier:
        hints = Hints("rectified", hints.image_size, hints.unit_m)
    return ros.combine_infos((path, path), eyes[0], eyes[1], hints)


def _group(data: dict[str, Any], name: str) -> dict[str, Any]:
    """The entries of a group, nested or with dots in their names as in old files."""
    nested = data.get(name)
    dotted = {
        key.removeprefix(f"{name}."): value
        for key, value in data.items()
        if key.startswith(f"{name}.")
    }
    return nested if isinstance(nested, dict) else dotted


def _raw(path: Path, rectifier: dict[str, Any], side: str, P: F64) -> dict[str, Any]:
    """K, D, R and the model of an eye; without a rectifier those of the rectified camera."""
    if not rectifier:
        return {"K": P[:, :3].ravel(), "D": np.zeros(0), "R": np.eye(3).ravel(), "model": ""}
    model = rectifier.get("model", "perspective")
    if model not in _MODELS:
        problem = f"{model!r:.40} is none of {', '.join(_MODELS)}"
        raise CalibrationError(problem, file=path, key="StereoRectifier.model")
    counts = {"K": 9, "D": None, "R": 9}
    values: dict[str, Any] = {
        letter: numbers(path, f"{letter}_{side}", rectifier.get(f"{letter}_{side}"), count)
        for letter, count in counts.items()
    }
    few = model == "perspective" and len(values["D"]) <= 5
    return values | {"model": "plumb_bob" if few else _MODELS[model]}
