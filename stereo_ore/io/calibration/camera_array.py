"""TOML of caliscope, stereo-charuco-pipeline and aniposelib: cameras posed from the world, X_camera
= R·X_world + t.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration.formats import (
    Hints,
    in_metres,
    numbers,
    one_size,
    raw_only,
    tell_unread,
    two_eyes,
    without_tail,
)
from stereo_ore.io.calibration.geometry import from_vector, make_calibration
from stereo_ore.transforms import inverse, rotation_fault
from stereo_ore.types import F64, CameraModel, StereoCalibration

_SECTION = re.compile(r"^\[(?:cameras\.|cam_)(\d{1,6})\]", re.MULTILINE)
_LENS = ("matrix", "distortions", "fisheye", "size", "rotation", "translation")
_UNUSED = (
    "name",
    "cam_id",
    "rotation_count",
    "error",
    "exposure",
    "grid_count",
    "ignore",
    "verified_resolutions",
    "port",
    "index",
    "camera_id",
    "serial",
)


def recognises(text: str) -> bool:
    """Whether the text has sections of numbered cameras."""
    return bool(_SECTION.search(text)) and "distortions" in text and "matrix" in text


def read(path: Path, text: str, hints: Hints) -> StereoCalibration:
    """Two cameras of an array; `hints.eyes` says which when there are more.

    Raises
    ------
    CalibrationError
        When the text is no TOML, a key is missing, or the two cameras are not said.
    """
    cameras = _cameras(path, text)
    raw_only(path, hints)
    left, right = two_eyes(path, cameras, hints)
    T = _pose(path, right, cameras[right]) @ inverse(_pose(path, left, cameras[left]))
    return make_calibration(
        path,
        image_size=one_size(path, [cameras[index].get("size") for index in (left, right)], hints),
        left=_camera(path, left, cameras[left]),
        right=_camera(path, right, cameras[right]),
        rotation=T[:3, :3],
        translation_m=in_metres(path, T[:3, 3], hints),
        images="raw",
        camera=f"{path.stem} {left}, {right}",
    )


def _cameras(path: Path, text: str) -> dict[int, dict[str, Any]]:
    """The sections by number."""
    try:
        data = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError, ValueError) as fault:
        raise CalibrationError(f"is not valid TOML: {fault}", file=path) from None
    inner = data.get("cameras")
    entries = (
        inner
        if isinstance(inner, dict)
        else {k.removeprefix("cam_"): v for k, v in data.items() if k != "metadata"}
    )
    unread = {
        k: v
        for k, v in data.items()
        if k not in ("cameras", "metadata") and not k.startswith("cam_")
    }
    tell_unread(path, unread)
    found = {
        int(k): v for k, v in entries.items() if re.fullmatch(r"\d{1,6}", k) and isinstance(v, dict)
    }
    if not found:
        raise CalibrationError("has no section of a camera", file=path)
    return dict(sorted(found.items()))


def _pose(path: Path, index: int, camera: dict[str, Any]) -> F64:
    """``T_camera_world`` in the file's unit; the rotation is a vector, in old files a matrix."""
    key = f"camera {index}"
    rotation = numbers(path, f"{key}.rotation", camera.get("rotation"))
    shift = numbers(path, f"{key}.translation", camera.get("translation"), 3)
    if rotation.size == 3:
        return from_vector(np.concatenate([rotation, shift]))
    if rotation.size != 9:
        raise CalibrationError(
            f"must have 3 or 9 numbers, not {rotation.size}", file=path, key=f"{key}.rotation"
        )
    if fault := rotation_fault(rotation.reshape(3, 3)):
        raise CalibrationError(f"the rotation {fault}", file=path, key=f"{key}.rotation")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation.reshape(3, 3), shift
    return T


def _camera(path: Path, index: int, camera: dict[str, Any]) -> CameraModel:
    key = f"camera {index}"
    tell_unread(path, {k: v for k, v in camera.items() if k not in (*_LENS, *_UNUSED)}, f"{key}: ")
    K = numbers(path, f"{key}.matrix", camera.get("matrix"), 9).reshape(3, 3)
    D = numbers(path, f"{key}.distortions", camera.get("distortions"))
    fisheye = camera.get("fisheye", False) is not False and camera.get("fisheye") != 0
    lens = tuple(D.tolist()) if fisheye else without_tail(D, 8)
    centre = (float(K[0, 2]), float(K[1, 2]))
    return CameraModel(
        (float(K[0, 0]), float(K[1, 1])), centre, lens, "equidistant" if fisheye else "pinhole"
    )
