"""EuRoC's and TUM-VI's ``sensor.yaml``, one in the folder of each camera: ``T_BS`` takes camera
coordinates to those of the body [m].
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration.file_storage import plain_yaml
from stereo_ore.io.calibration.formats import (
    Hints,
    numbers,
    one_size,
    other_eye,
    raw_only,
    read_file,
    rigid_transform,
    tell_unread,
)
from stereo_ore.io.calibration.geometry import make_calibration
from stereo_ore.io.yaml_io import parse_yaml
from stereo_ore.transforms import inverse
from stereo_ore.types import F64, CameraModel, StereoCalibration

_EYES = (("cam0", "cam1"), ("left", "right"))
_KNOWN = ("T_BS", "resolution", "camera_model", "intrinsics", "distortion_model")
_COEFFICIENTS = ("distortion_coefficients", "distortion_coeffs")
_UNUSED = ("sensor_type", "comment", "rate_hz")
_PINHOLE, _EQUIDISTANT = ("radial-tangential", "radtan", "plumb_bob", "none"), ("equidistant",)


def recognises(text: str) -> bool:
    """Whether the text describes one sensor and its pose on the body."""
    return "\nT_BS:" in f"\n{text}" and "camera_model" in text


def read(path: Path, text: str, hints: Hints) -> StereoCalibration:
    """The calibration in the file of either camera; the other's is in the folder (or the file) of
    the same name but for cam0, cam1 or left, right.

    Raises
    ------
    CalibrationError
        When the other file or a key is missing, or OpenCV does not have the model of the lens.
    """
    raw_only(path, hints)
    files = _both_files(path)
    eyes = [_parse(file, text if file == path else read_file(file)) for file in files]
    T_left, T_right = (_pose(file, eye) for file, eye in zip(files, eyes, strict=True))
    T = inverse(T_right) @ T_left
    left, right = (_camera(file, eye) for file, eye in zip(files, eyes, strict=True))
    return make_calibration(
        path,
        image_size=one_size(path, [eye.get("resolution") for eye in eyes], hints),
        left=left,
        right=right,
        rotation=T[:3, :3],
        translation_m=T[:3, 3],
        images="raw",
        camera=f"{files[0].parent.name}, {files[1].parent.name}",
    )


def _both_files(path: Path) -> tuple[Path, Path]:
    """The files of both cameras: beside each other, or each in a folder of its own."""
    if any(word in path.name for pair in _EYES for word in pair):
        return other_eye(path, _EYES)
    left, right = other_eye(path.resolve().parent, _EYES)
    return left / path.name, right / path.name


def _parse(path: Path, text: str) -> dict[str, Any]:
    data = parse_yaml(plain_yaml(text), path, CalibrationError, aliases=True)
    known = (*_KNOWN, *_COEFFICIENTS, *_UNUSED)
    tell_unread(path, {key: value for key, value in data.items() if key not in known})
    return data


def _pose(path: Path, eye: dict[str, Any]) -> F64:
    """``T_body_camera``."""
    value = eye.get("T_BS")
    return rigid_transform(path, "T_BS", value.get("data") if isinstance(value, dict) else value)


def _camera(path: Path, eye: dict[str, Any]) -> CameraModel:
    if eye.get("camera_model") != "pinhole":
        problem = f"{eye.get('camera_model')!r:.40} is not supported, only pinhole"
        raise CalibrationError(problem, file=path, key="camera_model")
    model = eye.get("distortion_model", "none")
    if model not in (*_PINHOLE, *_EQUIDISTANT):
        problem = f"{model!r:.40} is none of {', '.join((*_PINHOLE, *_EQUIDISTANT))}"
        raise CalibrationError(problem, file=path, key="distortion_model")
    fx, fy, cx, cy = numbers(path, "intrinsics", eye.get("intrinsics"), 4).tolist()
    D = next((eye[key] for key in _COEFFICIENTS if key in eye), ())
    lens = tuple(numbers(path, _COEFFICIENTS[0], D, 0 if model == "none" else 4).tolist())
    return CameraModel(
        (fx, fy), (cx, cy), lens, "equidistant" if model in _EQUIDISTANT else "pinhole"
    )
