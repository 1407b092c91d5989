"""Settings of ORB-SLAM2 (LEFT.K, LEFT.D, LEFT.R, LEFT.P …) and ORB-SLAM3 (Camera1.fx …
Stereo.T_c1_c2); of rectified images Camera1.fx … Stereo.b [m], in older ones Camera.fx … Camera.bf.
"""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import Any

import numpy as np

from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration import ros
from stereo_ore.io.calibration.file_storage import parse_storage
from stereo_ore.io.calibration.formats import (
    Hints,
    numbers,
    raw_only,
    rigid_transform,
    size_of,
    tell_unread,
    without_tail,
)
from stereo_ore.io.calibration.geometry import make_calibration
from stereo_ore.transforms import inverse
from stereo_ore.types import CameraModel, StereoCalibration

_log = logging.getLogger(__name__)

_KNOWN = re.compile(
    r"(LEFT|RIGHT)\.(K|D|R|P|width|height)|Camera[12]\..*|Camera\.(type|fx|fy|cx|cy|bf|bFishEye|width|height|newWidth|"
    r"newHeight|fps|RGB|imageScale|nFeatures)|(ORBextractor|Viewer|IMU|Stereo|System|Atlas|loopClosing)\..*|"
    r"ThDepth|DepthMapFactor|File\..*|Camera\.[kp][1-6]"
)
"""Entries that are read, or that mean nothing for the recorded images."""

_COEFFICIENTS = {
    "PinHole": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "KannalaBrandt8": ("k1", "k2", "k3", "k4"),
}

_OF_EYE = {
    name: tuple(f"{name}.{key}" for key in ("fx", "fy", "cx", "cy", *_COEFFICIENTS["PinHole"]))
    for name in ("Camera", "Camera1")
}


def recognises(text: str) -> bool:
    """Whether the text has the dotted names of either version."""
    return bool(re.search(r"^(LEFT\.K|Camera1\.fx|Camera\.bf):", text, re.MULTILINE))


def read(path: Path, text: str, hints: Hints) -> StereoCalibration:
    """The calibration in the settings.

    Raises
    ------
    CalibrationError
        When a key is missing, or the lens model is unknown.
    """
    data = parse_storage(path, text)
    tell_unread(path, {key: value for key, value in data.items() if not _KNOWN.fullmatch(key)})
    if "LEFT.K" in data:
        return _version_2(path, data, hints)
    if data.get("Camera.type") == "Rectified" or "Camera1.fx" not in data:
        return _rectified(path, data, hints)
    return _version_3(path, data, hints)


def _rectified(path: Path, data: dict[str, Any], hints: Hints) -> StereoCalibration:
    """One camera for both eyes, of images that were rectified; distortion would say otherwise."""
    if hints.images == "raw":
        raise CalibrationError("describes rectified images, not raw ones", file=path)
    name = "Camera1" if "Camera1.fx" in data else "Camera"
    eye = _camera(path, {k: v for k, v in data.items() if k in _OF_EYE[name]}, name, "PinHole")
    key = "Stereo.b" if "Stereo.b" in data else "Camera.bf"
    shift = float(numbers(path, key, data.get(key), 1)[0])
    baseline_m = shift if key == "Stereo.b" else shift / eye.focal_px[0]
    return make_calibration(
        path,
        image_size=size_of(path, _size(data), hints),
        left=eye,
        right=eye,
        translation_m=(-baseline_m, 0.0, 0.0),
        images="rectified",
        camera=path.stem,
    )


def _size(data: dict[str, Any]) -> list[Any] | None:
    keys = ["Camera.width", "Camera.height"]
    return [data[key] for key in keys] if set(keys) <= data.keys() else None


def _version_2(path: Path, data: dict[str, Any], hints: Hints) -> StereoCalibration:
    eyes = []
    for side in ("LEFT", "RIGHT"):
        eye: dict[str, Any] = {
            letter: numbers(path, f"{side}.{letter}", data.get(f"{side}.{letter}"), count)
            for letter, count in (("K", 9), ("D", None), ("R", 9), ("P", 12))
        }
        size = {
            key: float(numbers(path, f"{side}.{key}", data.get(f"{side}.{key}"), 1)[0])
            for key in ("width", "height")
        }
        eyes.append(
            eye | size | {"model": "plumb_bob" if len(eye["D"]) <= 5 else "rational_polynomial"}
        )
    return ros.combine_infos((path, path), eyes[0], eyes[1], hints)


def _version_3(path: Path, data: dict[str, Any], hints: Hints) -> StereoCalibration:
    raw_only(path, hints)
    kind = data.get("Camera.type")
    if kind not in _COEFFICIENTS:
        problem = f"{kind!r:.40} is none of {', '.join(_COEFFICIENTS)}"
        raise CalibrationError(problem, file=path, key="Camera.type")
    T = inverse(rigid_transform(path, "Stereo.T_c1_c2", data.get("Stereo.T_c1_c2")))
    left, right = (_camera(path, data, name, kind) for name in ("Camera1", "Camera2"))
    if any(left.distortion) != any(right.distortion):
        _log.warning("%s: only one eye has distortion; the other is taken for an ideal lens", path)
    return make_calibration(
        path,
        image_size=size_of(path, _size(data), hints),
        left=left,
        right=right,
        rotation=T[:3, :3],
        translation_m=T[:3, 3],
        images="raw",
        camera=path.stem,
    )


def _camera(path: Path, data: dict[str, Any], name: str, kind: str) -> CameraModel:
    values = {
        key.partition(".")[2]: value for key, value in data.items() if key.startswith(f"{name}.")
    }
    known = ("fx", "fy", "cx", "cy", *_COEFFICIENTS[kind], "overlappingBegin", "overlappingEnd")
    tell_unread(
        path, {key: value for key, value in values.items() if key not in known}, f"{name}: "
    )
    fx, fy, cx, cy = (
        float(numbers(path, f"{name}.{key}", values.get(key), 1)[0]) for key in known[:4]
    )
    D = numbers(path, f"{name}.k1", [values.get(key, 0.0) for key in _COEFFICIENTS[kind]]).tolist()
    if kind == "KannalaBrandt8":
        return CameraModel((fx, fy), (cx, cy), tuple(D), "equidistant")
    return CameraModel((fx, fy), (cx, cy), without_tail(D, 5) if np.any(D) else ())
