"""MATLAB's stereoParameters as JSON, by ``jsonencode(toStruct(stereoParams))`` or of the object:
pixels counted from 1, sizes as rows and columns, lengths in the file's own unit.

Matrices that MATLAB multiplies from the right (IntrinsicMatrix, RotationOfCamera2) are transposed.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration.formats import (
    Hints,
    numbers,
    one_size,
    parse_json,
    raw_only,
    section,
    tell_unread,
)
from stereo_ore.io.calibration.geometry import UNITS_M, make_calibration
from stereo_ore.types import F64, CameraModel, StereoCalibration

_UNITS = {
    "millimeters": "mm",
    "centimeters": "cm",
    "meters": "m",
    "inches": "inch",
    "feet": "ft",
} | {unit: unit for unit in UNITS_M}
_LENS = (
    "RadialDistortion",
    "TangentialDistortion",
    "K",
    "IntrinsicMatrix",
    "ImageSize",
    "WorldUnits",
)
_UNUSED = (
    "FocalLength", "PrincipalPoint", "Skew", "Version", "WorldPoints", "EstimateSkew",
    "NumRadialDistortionCoefficients", "EstimateTangentialDistortion", "NumPatterns",
    "RotationVectors", "TranslationVectors", "RotationMatrices", "PatternExtrinsics",
    "ReprojectionErrors", "MeanReprojectionError", "ReprojectedPoints", "DetectedKeypoints",
)  # fmt: skip
"""Entries of an eye that repeat others, or say how it was calibrated."""


def recognises(text: str) -> bool:
    """Whether the text has the names of both cameras."""
    return '"CameraParameters1"' in text and '"CameraParameters2"' in text


def read(path: Path, text: str, hints: Hints) -> StereoCalibration:
    """The calibration in the file.

    Raises
    ------
    CalibrationError
        When a key is missing, the pixels are skewed, or the unit is none that is known.
    """
    raw_only(path, hints)
    data = parse_json(path, text)
    eyes = [section(path, data, f"CameraParameters{number}") for number in (1, 2)]
    rotation, shift = _pose(path, data)
    left, right = (_camera(path, f"CameraParameters{i + 1}", eye) for i, eye in enumerate(eyes))
    sizes = [
        list(reversed(numbers(path, "ImageSize", eye.get("ImageSize"), 2).tolist()))
        if eye.get("ImageSize")
        else None
        for eye in eyes
    ]
    return make_calibration(
        path,
        image_size=one_size(path, sizes, hints),
        left=left,
        right=right,
        rotation=rotation,
        translation_m=shift * _unit_m(path, eyes[0], hints),
        images="raw",
        camera=path.stem,
    )


def _pose(path: Path, data: dict[str, Any]) -> tuple[F64, F64]:
    """R and t of X_2 = R·X_1 + t, t in the file's unit."""
    if "RotationOfCamera2" in data:
        R = numbers(path, "RotationOfCamera2", data["RotationOfCamera2"], 9).reshape(3, 3).T
        return R, numbers(path, "TranslationOfCamera2", data.get("TranslationOfCamera2"), 3)
    pose = section(path, data, "PoseCamera2")
    R = numbers(path, "PoseCamera2.R", pose.get("R"), 9).reshape(3, 3)
    return R, numbers(path, "PoseCamera2.Translation", pose.get("Translation"), 3)


def _unit_m(path: Path, eye: dict[str, Any], hints: Hints) -> float:
    unit = str(eye.get("WorldUnits", ""))
    if hints.unit_m is not None:
        return hints.unit_m
    if unit not in _UNITS:
        raise CalibrationError(
            f"{unit!r:.40} is no unit that is known",
            file=path,
            key="WorldUnits",
            remedy="Say --unit",
        )
    return UNITS_M[_UNITS[unit]]


def _camera(path: Path, name: str, eye: dict[str, Any]) -> CameraModel:
    known = (*_LENS, *_UNUSED)
    tell_unread(path, {k: v for k, v in eye.items() if k not in known}, f"{name}: ")
    key = "K" if "K" in eye else "IntrinsicMatrix"
    K = numbers(path, f"{name}.{key}", eye.get(key), 9).reshape(3, 3)
    K = K if key == "K" else K.T
    if K[0, 1] or eye.get("Skew"):
        problem = f"its pixels are skewed (by {K[0, 1]:g}), which OpenCV's cameras can't be"
        raise CalibrationError(
            problem, file=path, key=name, remedy="Calibrate with EstimateSkew off"
        )
    radial = numbers(path, f"{name}.RadialDistortion", eye.get("RadialDistortion")).tolist()
    tangential = numbers(
        path, f"{name}.TangentialDistortion", eye.get("TangentialDistortion", [0, 0]), 2
    )
    if len(radial) not in (2, 3):
        raise CalibrationError(
            f"must have 2 or 3 numbers, not {len(radial)}",
            file=path,
            key=f"{name}.RadialDistortion",
        )
    centre = (float(K[0, 2]) - 1, float(K[1, 2]) - 1)
    lens = (*radial[:2], *tangential.tolist(), *radial[2:])
    return CameraModel((float(K[0, 0]), float(K[1, 1])), centre, lens)
