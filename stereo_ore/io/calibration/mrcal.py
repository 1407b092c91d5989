"""mrcal's ``.cameramodel``: a Python literal an eye; rt_cam_ref takes points of a common frame to
the camera.
"""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

import numpy as np

from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration.formats import (
    Hints,
    numbers,
    one_size,
    other_eye,
    raw_only,
    read_file,
    tell_unread,
    without_tail,
)
from stereo_ore.io.calibration.geometry import from_vector, make_calibration
from stereo_ore.transforms import inverse
from stereo_ore.types import F64, CameraModel, StereoCalibration

_EYES = (
    ("left", "right"),
    ("Left", "Right"),
    ("LEFT", "RIGHT"),
    ("camera-0", "camera-1"),
    ("camera0", "camera1"),
    ("cam0", "cam1"),
)
LENSES = {f"LENSMODEL_OPENCV{n}": n for n in (4, 5, 8, 12)} | {"LENSMODEL_PINHOLE": 0}
_KNOWN = (
    "lensmodel",
    "intrinsics",
    "extrinsics",
    "rt_cam_ref",
    "imagersize",
    "valid_intrinsics_region",
    "icam_intrinsics",
    "optimization_inputs",
)


def recognises(text: str) -> bool:
    """Whether the text is a dict with a lensmodel."""
    return "'lensmodel'" in text or ('"lensmodel"' in text and '"imagersize"' in text)


def read(path: Path, text: str, hints: Hints) -> StereoCalibration:
    """The calibration in the file of either eye; the other is found by its name.

    Raises
    ------
    CalibrationError
        When a lens is of a model that OpenCV does not have, or the files are no literals.
    """
    raw_only(path, hints)
    files = other_eye(path, _EYES)
    models = [_parse(file, text if file == path else read_file(file)) for file in files]
    T_left, T_right = (_pose(file, model) for file, model in zip(files, models, strict=True))
    T = T_right @ inverse(T_left)
    left, right = (_camera(file, model) for file, model in zip(files, models, strict=True))
    return make_calibration(
        path,
        image_size=one_size(path, [model.get("imagersize") for model in models], hints),
        left=left,
        right=right,
        rotation=T[:3, :3],
        translation_m=T[:3, 3],
        images="raw",
        camera=files[0].stem,
    )


def _parse(path: Path, text: str) -> dict[str, Any]:
    try:
        model = ast.literal_eval(text.strip())
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError) as fault:
        raise CalibrationError(f"is no dictionary as mrcal writes it: {fault}", file=path) from None
    if not isinstance(model, dict):
        raise CalibrationError(f"must hold a dictionary, not {type(model).__name__}", file=path)
    tell_unread(path, {str(key): value for key, value in model.items() if key not in _KNOWN})
    return model


def _pose(path: Path, model: dict[str, Any]) -> F64:
    """``T_camera_reference``; files before mrcal 2.5 call it extrinsics, later ones have both."""
    key = "rt_cam_ref" if "rt_cam_ref" in model else "extrinsics"
    rt = numbers(path, key, model.get(key), 6)
    if "extrinsics" in model and not np.array_equal(
        numbers(path, "extrinsics", model["extrinsics"], 6), rt
    ):
        raise CalibrationError("rt_cam_ref and extrinsics differ", file=path, key=key)
    return from_vector(rt)


def _camera(path: Path, model: dict[str, Any]) -> CameraModel:
    lens = str(model.get("lensmodel"))
    if lens not in LENSES:
        problem = f"{lens!r:.60} is none of {', '.join(LENSES)}"
        remedy = "Convert it: mrcal-convert-lensmodel LENSMODEL_OPENCV8 …"
        raise CalibrationError(problem, file=path, key="lensmodel", remedy=remedy)
    fx, fy, cx, cy, *D = numbers(
        path, "intrinsics", model.get("intrinsics"), 4 + LENSES[lens]
    ).tolist()
    return CameraModel((fx, fy), (cx, cy), without_tail(D, 8))
