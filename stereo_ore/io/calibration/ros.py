"""ROS ``camera_info`` YAML: a file an eye, as `camera_calibration` writes it or as the message is
echoed.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration.formats import (
    Hints,
    Projection,
    in_metres,
    numbers,
    other_eye,
    read_file,
    size_of,
    tell_unread,
    without_tail,
)
from stereo_ore.io.calibration.geometry import make_calibration
from stereo_ore.io.yaml_io import parse_yaml
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
"""Distortion models and the number of their coefficients; rational_polynomial may have those of
thin prisms behind."""

_UNUSED = ("header", "camera_name", "distortion_model", "binning_x", "binning_y", "roi")
_WINDOW = ("x_offset", "y_offset", "width", "height")


def recognises(text: str) -> bool:
    """Whether the text has the entries of a camera_info."""
    return "distortion_model" in text and (
        "projection_matrix" in text
        or re.search(r"^[ \t]*\"?[Pp]\"?:", text, re.MULTILINE) is not None
    )


def read(path: Path, text: str, hints: Hints) -> StereoCalibration:
    """The calibration in the file of either eye; the other is found by its name.

    Raw images: K, D, and R_right_left = R_rᵀ·R_l, t = R_rᵀ·((P_r[0,3] − P_l[0,3]) / fx, 0, 0).
    Rectified: P alone.
    """
    files = other_eye(path, _EYES)
    left, right = (_eye(file, text if file == path else read_file(file), hints) for file in files)
    return combine_infos(files, left, right, hints)


def combine_infos(
    files: tuple[Path, Path], left: dict[str, Any], right: dict[str, Any], hints: Hints
) -> StereoCalibration:
    """The calibration of two eyes given as K (9,), D, R (9,), P (12,), width, height, model (of the
    distortion).

    Optional: `roi` (x_offset, y_offset, width, height) and `binning` (x, y), as the message has
    them (REP 104).
    """
    left, right = (_windowed(file, eye) for file, eye in zip(files, (left, right), strict=True))
    for file, eye in zip(files, (left, right), strict=True):
        _check(file, eye)
    sizes = [
        size_of(file, [eye["width"], eye["height"]], hints)
        for file, eye in zip(files, (left, right), strict=True)
    ]
    if sizes[0] != sizes[1]:
        raise CalibrationError(
            f"is for images of {sizes[0]}, {files[1].name} for {sizes[1]}", file=files[0]
        )
    P_left, P_right = left["P"].reshape(3, 4), right["P"].reshape(3, 4)
    if P_left[0, 3] == P_right[0, 3]:
        remedy = (
            "Give the file of the right camera, whose P[0,3] is −fx·baseline, or another"
            " calibration"
        )
        raise CalibrationError(
            "P[0,3] of both eyes is the same: there is no baseline", file=files[1], remedy=remedy
        )
    # Each eye's P holds its shift from a common origin, which is the left eye for most but not for
    # KITTI's colours.
    along = P_right[0, 3] / P_right[0, 0] - P_left[0, 3] / P_left[0, 0]
    shift = in_metres(files[0], np.array([along, 0.0, 0.0]), hints)
    common: dict[str, Any] = {
        "image_size": sizes[0],
        "camera": files[0].parent.name or files[0].stem,
    }
    if hints.images == "rectified":
        left_eye, right_eye = _camera(P_left[:, :3]), _camera(P_right[:, :3])
        return make_calibration(
            files[0],
            left=left_eye,
            right=right_eye,
            translation_m=shift,
            images="rectified",
            **common,
        )
    R_left, R_right = left["R"].reshape(3, 3), right["R"].reshape(3, 3)
    return make_calibration(
        files[0],
        left=_lens(files[0], left, hints),
        right=_lens(files[1], right, hints),
        rotation=R_right.T @ R_left,
        translation_m=R_right.T @ shift,
        images="raw",
        **common,
    )


def _check(file: Path, eye: dict[str, Any]) -> None:
    P = eye["P"].reshape(3, 4)
    if not eye["K"].any() or P[0, 0] == 0 or not eye["R"].any():
        raise CalibrationError(
            "all of K, R or P is zero: this camera was never calibrated",
            file=file,
            key="camera_matrix",
        )
    if np.array_equal(P, np.eye(3, 4)) and eye["K"][0] != 1:
        remedy = "Give the two .cameramodel files, which hold it"
        raise CalibrationError(
            "holds no pose: P is [I | 0], as mrcal writes it", file=file, key="P", remedy=remedy
        )
    if P[0, 0] < 0:
        raise CalibrationError(
            f"P[0,0], a focal length, is {P[0, 0]:g}", file=file, key="projection_matrix"
        )


def _windowed(file: Path, eye: dict[str, Any]) -> dict[str, Any]:
    """The eye of the image as it is sent: a window of the sensor, and several pixels as one (REP
    104).

    cx − x_offset, cy − y_offset; then focal lengths, principal points and P[0,3] over the binning.
    """
    x, y, width, height = eye.get("roi") or (0, 0, 0, 0)
    bin_x, bin_y = (max(float(n), 1.0) for n in eye.get("binning") or (1, 1))
    if not (x or y or width or height or bin_x > 1 or bin_y > 1):
        return eye
    full = eye["width"], eye["height"]
    size = (width or full[0], height or full[1])
    if x + size[0] > full[0] or y + size[1] > full[1]:
        x, y = _offset_of_whole(file, eye, (x, y), size)
    window = np.array([[1 / bin_x, 0, -x / bin_x], [0, 1 / bin_y, -y / bin_y], [0, 0, 1]])
    return eye | {
        "K": (window @ eye["K"].reshape(3, 3)).ravel(),
        "P": (window @ eye["P"].reshape(3, 4)).ravel(),
        "width": float(size[0] // bin_x),
        "height": float(size[1] // bin_y),
    }


def _offset_of_whole(
    file: Path, eye: dict[str, Any], offset: tuple[float, float], size: tuple[float, float]
) -> tuple[float, float]:
    """The offset to take off, where the size is that of the window: all if K is that of the whole
    sensor, else none.

    The reading whose principal point lies in the window is taken.

    Raises
    ------
    CalibrationError
        When both readings are possible, or none.
    """
    centre = eye["K"][2], eye["K"][5]
    inside = [
        all(0 < c - o * taken < n for c, o, n in zip(centre, offset, size, strict=True))
        for taken in (True, False)
    ]
    if inside[0] != inside[1]:
        return offset if inside[0] else (0.0, 0.0)
    raise CalibrationError(
        f"the size is that of the window of {size[0]:g}×{size[1]:g} px at {offset[0]:g},"
        f" {offset[1]:g}: either K is that of the whole sensor, or K is that of the window already",
        file=file,
        key="roi",
        remedy="Write the size of the whole sensor, or offsets of 0 where K is that of the window",
    )


def _eye(path: Path, text: str, hints: Hints) -> dict[str, Any]:
    """The entries of one eye by their letter."""
    data = _one_document(path, text)
    known = [spelling for words in SPELLINGS.values() for spelling in words]
    unread = {key: value for key, value in data.items() if key not in (*known, *_UNUSED)}
    if hints.images != "rectified":
        tell_unread(path, unread)
    lengths = {"K": 9, "R": 9, "P": 12, "D": None, "width": 1, "height": 1}
    eye = {name: numbers(path, *_entry(path, data, name), count) for name, count in lengths.items()}
    size = {name: float(eye[name][0]) for name in ("width", "height")}
    window, binning = (
        data.get("roi") or {},
        [data.get(key) or 0 for key in ("binning_x", "binning_y")],
    )
    if not isinstance(window, dict):
        raise CalibrationError("must be a mapping", file=path, key="roi")
    extra = {
        "model": str(data.get("distortion_model", "plumb_bob")),
        "roi": tuple(numbers(path, "roi", [window.get(key) or 0 for key in _WINDOW], 4).tolist()),
        "binning": tuple(numbers(path, "binning", binning, 2).tolist()),
    }
    return eye | size | extra


def _one_document(path: Path, text: str) -> dict[str, Any]:
    """The message in an echo, which ends each with ``---``; several must be the same, their headers
    aside.
    """
    parts = [part for part in re.split(r"^---.*$", text, flags=re.MULTILINE) if part.strip()]
    documents = [parse_yaml(part, path, CalibrationError, aliases=True) for part in parts or [text]]
    contents = [
        {key: value for key, value in document.items() if key != "header"} for document in documents
    ]
    if any(content != contents[0] for content in contents[1:]):
        remedy = "Keep the one that goes with the recording"
        raise CalibrationError("holds several messages that differ", file=path, remedy=remedy)
    return documents[0]


def _entry(path: Path, data: dict[str, Any], name: str) -> tuple[str, Any]:
    for key in SPELLINGS[name]:
        if key in data:
            value = data[key]
            return key, value.get("data") if isinstance(value, dict) else value
    raise CalibrationError(
        f"key is missing (also spelled {', '.join(SPELLINGS[name][1:])})",
        file=path,
        key=SPELLINGS[name][0],
    )


def _lens(file: Path, eye: dict[str, Any], hints: Hints) -> CameraModel:
    """The raw camera; a model without a name or with an unknown one is taken where it has no
    coefficients but zeros.
    """
    model, D = eye["model"], eye["D"]
    if model not in _MODELS and D.any():
        raise CalibrationError(
            f"{model!r} is not one of {', '.join(_MODELS)}", file=file, key="distortion_model"
        )
    if model not in _MODELS or not len(D):
        return _camera(eye["K"].reshape(3, 3))
    count = _MODELS[model]
    if count == 4 and len(D) > 4 and D[4:].any():
        raise CalibrationError(
            f"{model!r} has 4 coefficients, not {len(D)}", file=file, key="distortion_coefficients"
        )
    coefficients = without_tail(D, count) if count > 4 else tuple(D[:4].tolist())
    if model == "plumb_bob" and len(coefficients) > 5:
        problem = f"'plumb_bob' has 4 or 5 coefficients, not {len(coefficients)}"
        raise CalibrationError(
            problem, file=file, key="distortion_model", remedy="Is it rational_polynomial?"
        )
    return _camera(eye["K"].reshape(3, 3), coefficients, "equidistant" if count == 4 else "pinhole")


def _camera(K: F64, D: tuple[float, ...] = (), projection: Projection = "pinhole") -> CameraModel:
    return CameraModel(
        (float(K[0, 0]), float(K[1, 1])), (float(K[0, 2]), float(K[1, 2])), D, projection
    )
