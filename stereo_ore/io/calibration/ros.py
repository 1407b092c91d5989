"""ROS ``camera_info`` YAML: a file an eye, as `camera_calibration` writes it or as the message is echoed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration.formats import Hints, numbers, other_eye, size_of
from stereo_ore.io.calibration.geometry import make_calibration
from stereo_ore.io.yaml_io import parse_yaml, read_text
from stereo_ore.types import F64, CameraModel, StereoCalibration

SPELLINGS = {
    "K": ("camera_matrix", "K", "k"),
    "D": ("distortion_coefficients", "D", "d"),
    "R": ("rectification_matrix", "R", "r"),
    "P": ("projection_matrix", "P", "p"),
    "width": ("image_width", "width"),
    "height": ("image_height", "height"),
}
_EYES = (("left", "right"), ("Left", "Right"), ("LEFT", "RIGHT"), ("cam0", "cam1"))
_MODELS = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4, "fisheye": 4}


def recognises(text: str) -> bool:
    """Whether the text has the entries of a camera_info."""
    return "distortion_model" in text and ("projection_matrix" in text or "\nP:" in text or "\np:" in text)


def read(path: Path, text: str, hints: Hints) -> StereoCalibration:
    """The calibration in the file of either eye; the other is found by its name.

    Raw images: K, D, and R_right_left = R_rᵀ·R_l, t = R_rᵀ·(P_r[0,3] / fx, 0, 0). Rectified images: P alone.
    """
    files = other_eye(path, _EYES)
    left, right = (_eye(file, text if file == path else read_text(file, CalibrationError)) for file in files)
    return combine(files, left, right, hints)


def combine(files: tuple[Path, Path], left: dict[str, Any], right: dict[str, Any], hints: Hints) -> StereoCalibration:
    """The calibration of two eyes given as K (9,), D, R (9,), P (12,), width, height and model (of the distortion)."""
    for file, eye in zip(files, (left, right), strict=True):
        if (model := eye["model"]) not in _MODELS:
            raise CalibrationError(f"{model!r} is not one of {', '.join(_MODELS)}", file=file, key="distortion_model")
        if not eye["K"].any() or eye["P"][0] == 0:
            problem = "all of K or P is zero: this camera was never calibrated"
            raise CalibrationError(problem, file=file, key="camera_matrix")
    sizes = [
        size_of(file, [eye["width"], eye["height"]], hints) for file, eye in zip(files, (left, right), strict=True)
    ]
    if sizes[0] != sizes[1]:
        raise CalibrationError(f"is for images of {sizes[0]}, {files[1].name} for {sizes[1]}", file=files[0])
    P_left, P_right = left["P"].reshape(3, 4), right["P"].reshape(3, 4)
    if P_left[0, 3] != 0:
        raise CalibrationError(
            f"P[0,3] of the left eye must be 0, not {P_left[0, 3]:g}; are the eyes swapped?", file=files[0]
        )
    shift = np.array([P_right[0, 3] / P_right[0, 0], 0.0, 0.0]) * hints.unit_m
    common: dict[str, Any] = {"image_size": sizes[0], "camera": files[0].parent.name or files[0].stem}
    if hints.images == "rectified":
        left_eye, right_eye = _camera(P_left[:, :3]), _camera(P_right[:, :3])
        return make_calibration(
            files[0], left=left_eye, right=right_eye, translation_m=shift, images="rectified", **common
        )
    R_left, R_right = left["R"].reshape(3, 3), right["R"].reshape(3, 3)
    return make_calibration(
        files[0],
        left=_camera(left["K"].reshape(3, 3), left["D"], left["model"]),
        right=_camera(right["K"].reshape(3, 3), right["D"], right["model"]),
        rotation=R_right.T @ R_left,
        translation_m=R_right.T @ shift,
        images="raw",
        **common,
    )


def _eye(path: Path, text: str) -> dict[str, Any]:
    """The entries of one eye by their letter."""
    data = parse_yaml(text, path, CalibrationError)
    model = str(data.get("distortion_model", "plumb_bob"))
    lengths = {"K": 9, "R": 9, "P": 12, "D": None, "width": 1, "height": 1}
    eye = {name: numbers(path, *_entry(path, data, name), count) for name, count in lengths.items()}
    size = {name: float(eye[name][0]) for name in ("width", "height")}
    return eye | size | {"model": model}


def _entry(path: Path, data: dict[str, Any], name: str) -> tuple[str, Any]:
    for key in SPELLINGS[name]:
        if key in data:
            value = data[key]
            return key, value.get("data") if isinstance(value, dict) else value
    raise CalibrationError(
        f"key is missing (also spelled {', '.join(SPELLINGS[name][1:])})", file=path, key=SPELLINGS[name][0]
    )


def _camera(K: F64, D: F64 | None = None, model: str = "plumb_bob") -> CameraModel:
    focal, centre = (float(K[0, 0]), float(K[1, 1])), (float(K[0, 2]), float(K[1, 2]))
    distortion = () if D is None else tuple(D.tolist())
    return CameraModel(focal, centre, distortion, "equidistant" if _MODELS[model] == 4 else "pinhole")
