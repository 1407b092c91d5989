"""KITTI's and DrivingStereo's text files: ``calib_cam_to_cam.txt`` (K_00, D_00, R_00, T_00 of the
raw images, P_rect_00 of the rectified ones; metres) and ``calib.txt`` (P0, P1 … alone).
"""

from __future__ import annotations

import logging
import re
from pathlib import Path

import numpy as np

from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration.formats import (
    Hints,
    in_metres,
    numbers,
    one_size,
    size_of,
    tell_unread,
    two_eyes,
    without_tail,
)
from stereo_ore.io.calibration.geometry import make_calibration
from stereo_ore.transforms import inverse, rotation_fault
from stereo_ore.types import F64, CameraModel, StereoCalibration

_log = logging.getLogger(__name__)

_LINE = re.compile(r"^([A-Za-z]\w*):[ \t]*(.*)$", re.MULTILINE)
_PROJECTION = re.compile(r"P(?:_rect_)?(\d{1,3})")
_KNOWN = re.compile(r"[SKDRT]_\d+|[SRP]_rect_\d+|P\d+|R\d*_rect|Tr(_\w+)?|calib_time|corner_dist")
SAME_BASELINE = 0.02
"""Share by which the baselines of raw and rectified cameras may differ."""

Entries = dict[str, str]


def recognises(text: str) -> bool:
    """Whether the text has the projection of a numbered camera in a line of its own."""
    return bool(re.search(r"^P(_rect_)?\d+:[ \t]*[-+.\d]", text, re.MULTILINE))


def read(path: Path, text: str, hints: Hints) -> StereoCalibration:
    """The calibration of two cameras; `hints.eyes` says which, as KITTI has a grey and a coloured
    pair. Its images are rectified but for those of the raw, unsynchronised recordings.

    Raises
    ------
    CalibrationError
        When a line is missing or is no numbers, or the two baselines in the file differ.
    """
    entries = dict(_LINE.findall(text))
    tell_unread(path, {k: v for k, v in entries.items() if not _KNOWN.fullmatch(k)})
    cameras = {int(m[1]): m[0] for key in entries if (m := _PROJECTION.fullmatch(key))}
    if hints.eyes is None and set(cameras) == {0, 1, 2, 3}:
        remedy = "Say which recorded the images: --eyes 0,1 (grey) or --eyes 2,3 (colour)"
        raise CalibrationError("holds two pairs of cameras", file=path, remedy=remedy)
    eyes = [cameras[index].removeprefix("P") for index in two_eyes(path, cameras, hints)]
    eyes = [eye.removeprefix("_rect") for eye in eyes]
    name = f"{path.stem} {eyes[0].strip('_')}, {eyes[1].strip('_')}"
    if hints.images is None and hints.recorded_size is None and f"S{eyes[0]}" in entries:
        _log.warning(
            "%s: taken for rectified images; of the raw ones say calibrate import --images raw",
            path,
        )
    if hints.images == "raw" or (
        hints.images is None and _has_raw_size(path, entries, eyes, hints)
    ):
        return _raw(path, entries, eyes, hints, name)
    return _rectified(path, entries, eyes, hints, name)


def _has_raw_size(path: Path, entries: Entries, eyes: list[str], hints: Hints) -> bool:
    """Whether the images at hand have the size of the raw ones and not of the rectified ones."""
    keys = f"S{eyes[0]}", f"S_rect{eyes[0]}"
    if hints.recorded_size is None or not set(keys) <= entries.keys():
        return False
    raw, rectified = (tuple(_values(path, entries, key, 2).tolist()) for key in keys)
    return raw != rectified and hints.recorded_size == raw


def _values(path: Path, entries: Entries, key: str, count: int | None) -> F64:
    if key not in entries:
        raise CalibrationError("line is missing", file=path, key=key)
    return numbers(path, key, entries[key].split(), count)


def _projections(path: Path, entries: Entries, eyes: list[str]) -> list[F64]:
    keys = [f"P{eye}" if f"P{eye}" in entries else f"P_rect{eye}" for eye in eyes]
    found = [_values(path, entries, key, 12).reshape(3, 4) for key in keys]
    for key, P in zip(keys, found, strict=True):
        if P[0, 0] <= 0:
            raise CalibrationError(f"has a focal length of {P[0, 0]:g}", file=path, key=key)
    return found


def _rectified(
    path: Path, entries: Entries, eyes: list[str], hints: Hints, name: str
) -> StereoCalibration:
    left, right = _projections(path, entries, eyes)
    along = right[0, 3] / right[0, 0] - left[0, 3] / left[0, 0]
    if {f"T{eye}" for eye in eyes} <= entries.keys():
        between = float(np.linalg.norm(_between(path, entries, eyes)[:3, 3]))
        if abs(abs(along) / between - 1) > SAME_BASELINE:
            raise CalibrationError(
                f"the rectified cameras are {abs(along):.4g} m apart, the raw ones {between:.4g} m",
                file=path,
                key=f"P_rect{eyes[1]}",
                remedy="The file is of images of another scale, or was edited",
            )
    sizes = [f"S_rect{eye}" for eye in eyes]
    known = [_values(path, entries, key, 2).tolist() for key in sizes if key in entries]
    return make_calibration(
        path,
        image_size=one_size(path, known, hints) if len(known) == 2 else size_of(path, None, hints),
        left=_pinhole(left),
        right=_pinhole(right),
        translation_m=in_metres(path, np.array([along, 0.0, 0.0]), hints),
        images="rectified",
        camera=name,
    )


def _raw(
    path: Path, entries: Entries, eyes: list[str], hints: Hints, name: str
) -> StereoCalibration:
    T = _between(path, entries, eyes)
    sizes = [_values(path, entries, f"S{eye}", 2).tolist() for eye in eyes]
    left, right = (
        _pinhole(
            _values(path, entries, f"K{eye}", 9).reshape(3, 3),
            without_tail(_values(path, entries, f"D{eye}", None), 5),
        )
        for eye in eyes
    )
    return make_calibration(
        path,
        image_size=one_size(path, sizes, hints),
        left=left,
        right=right,
        rotation=T[:3, :3],
        translation_m=in_metres(path, T[:3, 3], hints),
        images="raw",
        camera=name,
    )


def _between(path: Path, entries: Entries, eyes: list[str]) -> F64:
    """``T_right_left`` of the raw cameras, each of which is posed from the first of the rig."""
    poses = []
    for eye in eyes:
        T = np.eye(4)
        T[:3, :3] = _values(path, entries, f"R{eye}", 9).reshape(3, 3)
        T[:3, 3] = _values(path, entries, f"T{eye}", 3)
        if fault := rotation_fault(T[:3, :3]):
            raise CalibrationError(f"the rotation {fault}", file=path, key=f"R{eye}")
        poses.append(T)
    return poses[1] @ inverse(poses[0])


def _pinhole(K: F64, lens: tuple[float, ...] = ()) -> CameraModel:
    return CameraModel((float(K[0, 0]), float(K[1, 1])), (float(K[0, 2]), float(K[1, 2])), lens)
