"""Basalt's JSON, as cereal writes it: ``T_imu_cam`` of each camera [m], lenses kb4, pinhole or
pinhole-radtan8.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration.formats import (
    Hints,
    numbers,
    one_size,
    parse_json,
    raw_only,
    section,
    tell_unread,
    two_eyes,
    without_tail,
)
from stereo_ore.io.calibration.geometry import make_calibration
from stereo_ore.io.calibration.readings import from_quaternion
from stereo_ore.transforms import inverse
from stereo_ore.types import F64, CameraModel, StereoCalibration

_CENTRE = ("fx", "fy", "cx", "cy")
_COEFFICIENTS = {
    "pinhole": (),
    "kb4": ("k1", "k2", "k3", "k4"),
    "pinhole-radtan8": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
"""Of the models that OpenCV has too, in its order."""
_RADIUS = "rpmax"
"""Where the polynomial of radtan8 ends; nothing that OpenCV asks for."""


def recognises(text: str) -> bool:
    """Whether the text has Basalt's names."""
    return text.lstrip().startswith("{") and '"T_imu_cam"' in text and '"camera_type"' in text


def read(path: Path, text: str, hints: Hints) -> StereoCalibration:
    """The calibration of two cameras; `hints.eyes` says which when there are more.

    Raises
    ------
    CalibrationError
        When a key is missing, or the lens is of a model that OpenCV does not have (ds, eucm …).
    """
    raw_only(path, hints)
    outer = parse_json(path, text)
    data = section(path, outer, "value0") if "value0" in outer else outer
    cameras, poses, sizes = (
        _list(path, data, key) for key in ("intrinsics", "T_imu_cam", "resolution")
    )
    count = min(len(cameras), len(poses), len(sizes))
    eyes = two_eyes(path, range(count), hints)
    T_left, T_right = (_pose(path, f"T_imu_cam.{index}", poses[index]) for index in eyes)
    T = inverse(T_right) @ T_left
    left, right = (_camera(path, f"intrinsics.{index}", cameras[index]) for index in eyes)
    return make_calibration(
        path,
        image_size=one_size(path, [sizes[index] for index in eyes], hints),
        left=left,
        right=right,
        rotation=T[:3, :3],
        translation_m=T[:3, 3],
        images="raw",
        camera=f"{path.stem} {eyes[0]}, {eyes[1]}",
    )


def _list(path: Path, data: dict[str, Any], key: str) -> list[Any]:
    value = data.get(key)
    if not isinstance(value, list):
        raise CalibrationError("must be a list, an entry a camera", file=path, key=key)
    return value


def _pose(path: Path, key: str, value: Any) -> F64:
    """``T_imu_camera`` of px py pz and a quaternion qx qy qz qw."""
    pose = value if isinstance(value, dict) else {}
    q = numbers(path, key, [pose.get(f"q{axis}") for axis in "xyzw"], 4)
    if abs(length := float(np.linalg.norm(q)) - 1) > 1e-3:
        raise CalibrationError(
            f"the quaternion has length {length + 1:.3f}, not 1", file=path, key=key
        )
    T = np.eye(4)
    T[:3, :3] = from_quaternion(q)
    T[:3, 3] = numbers(path, key, [pose.get(f"p{axis}") for axis in "xyz"], 3)
    return T


def _camera(path: Path, key: str, value: Any) -> CameraModel:
    camera = value if isinstance(value, dict) else {}
    kind, lens = camera.get("camera_type"), section(path, camera, "intrinsics")
    if kind not in _COEFFICIENTS:
        problem = f"{kind!r:.40} is none of {', '.join(_COEFFICIENTS)}"
        remedy = "Calibrate with --cam-types of one of these (basalt_calibrate)"
        raise CalibrationError(problem, file=path, key=f"{key}.camera_type", remedy=remedy)
    known = (*_CENTRE, *_COEFFICIENTS[kind], _RADIUS)
    tell_unread(path, {k: v for k, v in lens.items() if k not in known}, f"{key}: ")
    fx, fy, cx, cy = numbers(path, key, [lens.get(name) for name in _CENTRE], 4).tolist()
    D = numbers(path, key, [lens.get(name) for name in _COEFFICIENTS[kind]]).tolist()
    if kind == "kb4":
        return CameraModel((fx, fy), (cx, cy), tuple(D), "equidistant")
    return CameraModel((fx, fy), (cx, cy), without_tail(D, 5))
