"""VINS-Fusion: settings with ``body_T_cam0``, ``body_T_cam1`` [m], which name a camodocal file an
eye (PINHOLE or KANNALA_BRANDT).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration.file_storage import parse_storage
from stereo_ore.io.calibration.formats import (
    Hints,
    numbers,
    one_size,
    raw_only,
    read_file,
    rigid_transform,
    section,
    tell_unread,
)
from stereo_ore.io.calibration.geometry import make_calibration
from stereo_ore.transforms import inverse
from stereo_ore.types import CameraModel, StereoCalibration

_Names = dict[str, tuple[str, ...]]
_PINHOLE: _Names = {
    "projection_parameters": ("fx", "fy", "cx", "cy"),
    "distortion_parameters": ("k1", "k2", "p1", "p2"),
}
_FISHEYE: _Names = {"projection_parameters": ("mu", "mv", "u0", "v0", "k2", "k3", "k4", "k5")}
_MODELS = {"PINHOLE": _PINHOLE, "KANNALA_BRANDT": _FISHEYE}
_UNUSED = ("model_type", "camera_name", "image_width", "image_height")


def recognises(text: str) -> bool:
    """Whether the text is such settings, or the camodocal file of an eye."""
    return "body_T_cam0" in text or ("model_type" in text and "projection_parameters" in text)


def read(path: Path, text: str, hints: Hints) -> StereoCalibration:
    """The calibration in the settings and the two files that they name.

    Raises
    ------
    CalibrationError
        When a file or a key is missing, or a lens is of a model that OpenCV does not have (MEI …).
    """
    raw_only(path, hints)
    data = parse_storage(path, text)
    if "body_T_cam0" not in data:
        remedy = "Name the settings that hold body_T_cam0, body_T_cam1 and this file's name"
        raise CalibrationError("describes one eye alone", file=path, remedy=remedy)
    T_left, T_right = (
        rigid_transform(path, key, data.get(key)) for key in ("body_T_cam0", "body_T_cam1")
    )
    T = inverse(T_right) @ T_left
    files = [path.with_name(str(data.get(key))) for key in ("cam0_calib", "cam1_calib")]
    eyes = [parse_storage(file, read_file(file)) for file in files]
    left, right = (_camera(file, eye) for file, eye in zip(files, eyes, strict=True))
    sizes = [[eye.get("image_width"), eye.get("image_height")] for eye in eyes]
    return make_calibration(
        path,
        image_size=one_size(path, sizes, hints),
        left=left,
        right=right,
        rotation=T[:3, :3],
        translation_m=T[:3, 3],
        images="raw",
        camera=path.stem,
    )


def _camera(path: Path, eye: dict[str, Any]) -> CameraModel:
    kind = str(eye.get("model_type"))
    if kind not in _MODELS:
        problem = f"{kind!r:.40} is none of {', '.join(_MODELS)}"
        raise CalibrationError(problem, file=path, key="model_type")
    model, values = _MODELS[kind], list[float]()
    tell_unread(path, {key: value for key, value in eye.items() if key not in (*model, *_UNUSED)})
    for key, names in model.items():
        part = section(path, eye, key)
        tell_unread(path, {k: v for k, v in part.items() if k not in names}, f"{key}: ")
        values += numbers(path, key, [part.get(name) for name in names], len(names)).tolist()
    fx, fy, cx, cy, *lens = values
    return CameraModel(
        (fx, fy), (cx, cy), tuple(lens), "equidistant" if model is _FISHEYE else "pinhole"
    )
