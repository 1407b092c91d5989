"""YAML of the package *calibrating*: cam1, cam2 (fx fy cx cy D xy), R and t at the top; X_2 = R·X_1
+ t, metres.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration.formats import (
    Hints,
    in_metres,
    numbers,
    one_size,
    raw_only,
    section,
    tell_unread,
    without_tail,
)
from stereo_ore.io.calibration.geometry import make_calibration
from stereo_ore.io.yaml_io import parse_yaml
from stereo_ore.types import CameraModel, StereoCalibration

_EYE = ("fx", "fy", "cx", "cy", "D", "xy", "name")
_TOP = ("R", "t", "cam1", "cam2", "_calibrating_version", "retval")


def recognises(text: str) -> bool:
    """Whether the text says that it is this format."""
    return "_calibrating_version" in text


def read(path: Path, text: str, hints: Hints) -> StereoCalibration:
    """The calibration in the file.

    Raises
    ------
    CalibrationError
        When a key is missing or is no number.
    """
    data = parse_yaml(text, path, CalibrationError, aliases=True)
    raw_only(path, hints)
    tell_unread(path, {key: value for key, value in data.items() if key not in _TOP})
    eyes = [section(path, data, key) for key in ("cam1", "cam2")]
    return make_calibration(
        path,
        image_size=one_size(path, [eye.get("xy") for eye in eyes], hints),
        left=_camera(path, "cam1", eyes[0]),
        right=_camera(path, "cam2", eyes[1]),
        rotation=numbers(path, "R", data.get("R"), 9).reshape(3, 3),
        translation_m=in_metres(path, numbers(path, "t", data.get("t"), 3), hints),
        images="raw",
        camera=path.stem,
    )


def _camera(path: Path, name: str, eye: dict[str, Any]) -> CameraModel:
    tell_unread(path, {key: value for key, value in eye.items() if key not in _EYE}, f"{name}: ")
    fx, fy, cx, cy = (float(numbers(path, f"{name}.{key}", eye.get(key), 1)[0]) for key in _EYE[:4])
    D = numbers(path, f"{name}.D", eye.get("D"))
    return CameraModel((fx, fy), (cx, cy), without_tail(D, 8))
