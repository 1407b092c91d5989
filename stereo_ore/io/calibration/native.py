"""The program's own calibration YAML: metres, pixels, radians."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import yaml
from pydantic import Field

from stereo_ore.config.fields import Number, Positive, Section
from stereo_ore.config.validation import validate
from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration.formats import Hints
from stereo_ore.io.calibration.geometry import Images, make_calibration, rotation_vector
from stereo_ore.io.yaml_io import parse_yaml
from stereo_ore.types import CameraModel, StereoCalibration

_FORMAT = "stereo_ore/stereo-calibration"


class _Eye(Section):
    focal_px: tuple[Positive, Positive]
    principal_point_px: tuple[Number, Number]
    distortion: tuple[Number, ...] = ()
    projection: Literal["pinhole", "equidistant"] = "pinhole"

    def model(self) -> CameraModel:
        return CameraModel(**self.model_dump())


class _Pose(Section):
    rotation_vector_rad: tuple[Number, Number, Number]
    translation_m: tuple[Number, Number, Number]


class _File(Section):
    format: Literal["stereo_ore/stereo-calibration"]
    version: Literal[1]
    camera: str = ""
    image_size: tuple[Annotated[int, Field(gt=0)], Annotated[int, Field(gt=0)]]
    images: Images
    left: _Eye
    right: _Eye
    right_from_left: _Pose
    disparity_offset_px: Number = 0.0


def recognises(text: str) -> bool:
    """Whether the text says that it is this format."""
    return _FORMAT in text


def read(path: Path, text: str, hints: Hints) -> StereoCalibration:
    """The calibration in a native YAML; `hints.images`, if given, stands for the file's word."""
    file = validate(_File, parse_yaml(text, path, CalibrationError), path, CalibrationError)
    return make_calibration(
        path,
        image_size=file.image_size,
        left=file.left.model(),
        right=file.right.model(),
        rotation=file.right_from_left.rotation_vector_rad,
        translation_m=file.right_from_left.translation_m,
        images=hints.images or file.images,
        disparity_offset_px=file.disparity_offset_px,
        camera=file.camera,
    )


def dump(calibration: StereoCalibration) -> str:
    """YAML text that `read` takes back to the same calibration, bit for bit."""
    document = {
        "format": _FORMAT,
        "version": 1,
        "camera": calibration.camera,
        "image_size": list(calibration.image_size),
        "images": calibration.images,
        "left": _eye(calibration.left),
        "right": _eye(calibration.right),
        "right_from_left": {
            "rotation_vector_rad": rotation_vector(calibration.R_right_left).tolist(),
            "translation_m": calibration.t_right_left.tolist(),
        },
        "disparity_offset_px": calibration.disparity_offset_px,
    }
    return yaml.safe_dump(
        document, sort_keys=False, allow_unicode=True, default_flow_style=None, width=120
    )


def _eye(eye: CameraModel) -> dict[str, object]:
    fields: dict[str, object] = {
        "focal_px": [float(f) for f in eye.focal_px],
        "principal_point_px": [float(c) for c in eye.principal_point_px],
    }
    if eye.distortion:
        fields["distortion"] = [float(k) for k in eye.distortion]
    if eye.projection != "pinhole":
        fields["projection"] = eye.projection
    return fields


def save(calibration: StereoCalibration, path: Path) -> None:
    """Write a native YAML."""
    path.write_text(dump(calibration), encoding="utf-8")
