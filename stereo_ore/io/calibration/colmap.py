"""COLMAP's cameras.txt and rigs.txt beside each other: pixels counted from the corner, quaternions
w first.
"""

from __future__ import annotations

import logging
import re
from pathlib import Path

import numpy as np

from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration.formats import (
    Hints,
    Projection,
    in_metres,
    numbers,
    one_size,
    raw_only,
    read_file,
)
from stereo_ore.io.calibration.geometry import make_calibration
from stereo_ore.transforms import inverse, nearest_rotation
from stereo_ore.types import F64, CameraModel, StereoCalibration

_log = logging.getLogger(__name__)

HALF_PIXEL = 0.5
"""COLMAP's image begins at the corner of the first pixel, OpenCV's at its middle."""

MODELS = {
    "SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8,
    "FULL_OPENCV": 12,
    "OPENCV_FISHEYE": 8,
}  # fmt: skip
"""Numbers of parameters of the models that OpenCV has too."""

_CAMERA = re.compile(r"^\d+ [A-Z_]+ \d+ \d+ [-\d.]", re.MULTILINE)
_RIG = re.compile(r"^\d+ \d+ CAMERA \d+", re.MULTILINE)

Cameras = dict[int, tuple[list[str], CameraModel]]


def recognises(text: str) -> bool:
    """Whether the text is a list of cameras or of rigs."""
    return bool(_CAMERA.search(text)) or bool(_RIG.search(text))


def read(path: Path, text: str, hints: Hints) -> StereoCalibration:
    """The calibration of a rig of two cameras, from either file; `hints.eyes` says which when there
    are more.

    Raises
    ------
    CalibrationError
        When the other file is missing, a camera has no pose in the rig, or its model is none of
        OpenCV's.
    """
    raw_only(path, hints)
    is_rig = bool(_RIG.search(text))
    other = path.with_name("cameras.txt" if is_rig else "rigs.txt")
    rig_text, camera_text = (text, read_file(other)) if is_rig else (read_file(other), text)
    rig_file, camera_file = (path, other) if is_rig else (other, path)
    cameras, poses = _cameras(camera_file, camera_text), _poses(rig_file, rig_text)
    if hints.eyes is None and len(poses) != 2:
        remedy = "Say which are left and right with --eyes L,R"
        raise CalibrationError(
            f"holds a rig of the cameras {sorted(poses)}", file=rig_file, remedy=remedy
        )
    left, right = hints.eyes or tuple(sorted(poses))
    for index in (left, right):
        if index not in poses or index not in cameras:
            raise CalibrationError(f"camera {index} has no pose or no model", file=rig_file)
    T = poses[right] @ inverse(poses[left])
    if hints.unit_m is None:
        _log.warning(
            "%s: the scale of a COLMAP model is free; its unit is taken for a metre (--unit says"
            " otherwise)",
            path,
        )
    return make_calibration(
        path,
        image_size=one_size(path, [cameras[index][0] for index in (left, right)], hints),
        left=cameras[left][1],
        right=cameras[right][1],
        rotation=T[:3, :3],
        translation_m=in_metres(path, T[:3, 3], hints),
        images="raw",
        camera=f"{path.parent.name} {left}, {right}",
    )


def _rows(text: str) -> list[list[str]]:
    return [line.split() for line in text.splitlines() if line.strip() and not line.startswith("#")]


def _cameras(path: Path, text: str) -> Cameras:
    found = {}
    for row in _rows(text):
        index = _index(path, row[0])
        if len(row) < 5 or row[1] not in MODELS:
            problem = f"{' '.join(row[1:2])!r:.40} is none of {', '.join(MODELS)}"
            raise CalibrationError(problem, file=path, key=f"camera {index}")
        values = numbers(path, f"camera {index}", row[4:], MODELS[row[1]])
        found[index] = (row[2:4], _model(row[1], values))
    return found


def _index(path: Path, word: str) -> int:
    if not re.fullmatch(r"\d{1,9}", word):
        raise CalibrationError(f"{word!r:.40} is no number of a camera", file=path)
    return int(word)


def _model(name: str, values: F64) -> CameraModel:
    """One focal length or two, then the principal point, then the coefficients in OpenCV's
    order.
    """
    one = name.startswith("SIMPLE") or name == "RADIAL"
    focal, rest = (values[[0, 0]], values[1:]) if one else (values[:2], values[2:])
    lens = rest[2:].tolist()
    lens = [*lens, *[0.0] * (4 - len(lens))] if lens else lens
    centre = (float(rest[0]) - HALF_PIXEL, float(rest[1]) - HALF_PIXEL)
    projection: Projection = "equidistant" if name == "OPENCV_FISHEYE" else "pinhole"
    return CameraModel((float(focal[0]), float(focal[1])), centre, tuple(lens), projection)


def _poses(path: Path, text: str) -> dict[int, F64]:
    """``T_camera_rig`` of each camera of the only rig: id, count, type, id of the reference, then
    each other sensor.
    """
    rows = _rows(text)
    if len(rows) != 1 or len(rows[0]) < 4:
        raise CalibrationError(f"must hold one rig, not {len(rows)}", file=path)
    row = rows[0]
    poses, rest = {_index(path, row[3]): np.eye(4)}, row[4:]
    while rest:
        if len(rest) < 3 or rest[2] not in ("0", "1") or (rest[2] == "1" and len(rest) < 10):
            raise CalibrationError(f"a sensor can't be read: {' '.join(rest)!r:.60}", file=path)
        if rest[0] == "CAMERA" and rest[2] == "1":
            index = _index(path, rest[1])
            poses[index] = _pose(path, index, numbers(path, f"camera {index}", rest[3:10], 7))
        rest = rest[10 if rest[2] == "1" else 3 :]
    return poses


def _pose(path: Path, index: int, values: F64) -> F64:
    """The transform of qw qx qy qz tx ty tz."""
    length = float(np.linalg.norm(values[:4]))
    if abs(length - 1) > 1e-3:
        raise CalibrationError(
            f"the quaternion has length {length:.3f}, not 1", file=path, key=f"camera {index}"
        )
    w, x, y, z = values[:4] / length
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = (
        nearest_rotation(np.eye(3) + 2 * w * cross + 2 * cross @ cross),
        values[4:],
    )
    return T
