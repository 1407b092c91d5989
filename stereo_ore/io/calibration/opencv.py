"""OpenCV FileStorage (YAML, XML, JSON) as `stereoCalibrate` users write it: M1 D1 M2 D2 R T, under
many names.
"""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import Any

import numpy as np

from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration.file_storage import parse_storage
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
from stereo_ore.io.calibration.opencv_names import also, sort_entries
from stereo_ore.types import F64, CameraModel, StereoCalibration

_log = logging.getLogger(__name__)

_MODEL = re.compile(
    r"(camera|distortion|lens|projection)?_?(model|type)$|fish_?eye(_?model)?$|(is|use)_?fish_?eye$",
    re.I,
)
_EQUIDISTANT = re.compile(r"fish|equidist|kannala|kb[48]?$", re.I)
_PINHOLE = re.compile(
    r"pinhole|plumb|radtan|rad_?tan|brown|rational|opencv|standard|perspective|normal|none|prism",
    re.I,
)
_HALVES = (("intrinsics", "extrinsics"), ("intrinsic", "extrinsic"))


def recognises(text: str) -> bool:
    """Whether the text is a FileStorage."""
    return text.lstrip("\ufeff \n").startswith(("%YAML", "<?xml", "{")) and "opencv" in text


def read(path: Path, text: str, hints: Hints) -> StereoCalibration:
    """The calibration in one file, or in ``…intrinsics…`` and ``…extrinsics…`` beside each other.

    For rectified images the projections P1 and P2 are taken, otherwise the raw cameras.

    Raises
    ------
    CalibrationError
        When an entry is missing, with the names it may have; when a lens model is not understood.
    """
    return combine_storages(path, parse_storage(path, text), hints)


def combine_storages(path: Path, entries: dict[str, Any], hints: Hints) -> StereoCalibration:
    """The calibration in the entries of a file, whatever they are called."""
    found, unread, fisheye = sort_entries(path, entries)
    if not {"K1", "R"} <= found.keys() and any(word in path.name for word in _HALVES[1]):
        other = next(part for part in other_eye(path, _HALVES) if part != path)
        if other.exists():
            half = parse_storage(other, read_file(other))
            rest, more, more_fisheye = sort_entries(other, half)
            found, unread, fisheye = rest | found, unread | more, fisheye or more_fisheye
            entries = half | entries
    if hints.images == "rectified":
        return _rectified(path, found, hints)
    found = _with_pose(path, found, entries)
    K1, K2 = (numbers(path, key, _entry(path, found, key), 9).reshape(3, 3) for key in ("K1", "K2"))
    rotation, shift = _entry(path, found, "R"), numbers(path, "T", _entry(path, found, "T"), 3)
    projection = _projection(path, unread, hints, found, fisheye)
    tell_unread(path, unread)
    if rotation.size not in (3, 9):
        raise CalibrationError(f"must have 3 or 9 numbers, not {rotation.size}", file=path, key="R")
    _check_lenses(path, found, projection)
    return make_calibration(
        path,
        left=_camera(K1, found.get("D1"), projection),
        right=_camera(K2, found.get("D2"), projection),
        image_size=size_of(path, _size(path, found), hints),
        rotation=rotation if rotation.size == 3 else rotation.reshape(3, 3),
        translation_m=in_metres(path, shift, hints),
        images="raw",
        camera=path.stem,
    )


def _with_pose(path: Path, found: dict[str, F64], entries: dict[str, Any]) -> dict[str, F64]:
    """The entries with R and T; where there are none, of the rectification R1, P1, R2, P2, as
    MultiSense keeps it: R = R2ᵀ·R1, T = R2ᵀ·(P2[0,3] − P1[0,3])/f along x.
    """
    if (
        found.keys() & {"R", "T"}
        or not {"R1", "R2"} <= entries.keys()
        or not {"P1", "P2"} <= found.keys()
    ):
        return found
    R1, R2 = (numbers(path, key, entries[key], 9).reshape(3, 3) for key in ("R1", "R2"))
    P1, P2 = (numbers(path, key, found[key], 12) for key in ("P1", "P2"))
    if not (P1[0] and P2[0]):
        raise CalibrationError("has a focal length of zero", file=path, key="P1")
    shift = np.array([P2[3] / P2[0] - P1[3] / P1[0], 0.0, 0.0])
    return found | {"R": (R2.T @ R1).ravel(), "T": R2.T @ shift}


def _rectified(path: Path, found: dict[str, F64], hints: Hints) -> StereoCalibration:
    P1, P2 = (
        numbers(path, key, _entry(path, found, key), 12).reshape(3, 4) for key in ("P1", "P2")
    )
    if P2[0, 0] == 0:
        raise CalibrationError("has a focal length of zero", file=path, key="P2")
    return make_calibration(
        path,
        image_size=size_of(path, _size(path, found), hints),
        left=_camera(P1[:, :3], None, "pinhole"),
        right=_camera(P2[:, :3], None, "pinhole"),
        translation_m=in_metres(path, np.array([P2[0, 3] / P2[0, 0], 0.0, 0.0]), hints),
        images="rectified",
        camera=path.stem,
    )


def _size(path: Path, found: dict[str, F64]) -> list[float] | None:
    sizes = [found[key].tolist() for key in ("size", "size1", "size2") if key in found]
    sizes += (
        [[float(found["width"][0]), float(found["height"][0])]]
        if {"width", "height"} <= found.keys()
        else []
    )
    if any(size != sizes[0] for size in sizes):
        raise CalibrationError(f"gives several image sizes: {sizes}", file=path, key="size")
    return sizes[0] if sizes else None


def _projection(
    path: Path, unread: dict[str, Any], hints: Hints, found: dict[str, F64], fisheye: bool
) -> Projection:
    """What the file or, where it is silent, the user says; its entries about that are taken out of
    `unread`.
    """
    said = set[Projection](["equidistant"] if fisheye else [])
    for key in [key for key in unread if _MODEL.search(key)]:
        text = str(unread.pop(key))
        if _EQUIDISTANT.search(text) or (
            "fish" in key.lower() and text.lower() not in ("0", "0.0", "false")
        ):
            said.add("equidistant")
        elif _PINHOLE.search(text) or "fish" in key.lower():
            said.add("pinhole")
        else:
            raise CalibrationError(
                f"{text!r:.40} is no lens model that is known here", file=path, key=key
            )
    if len(said) > 1 or (said and hints.projection not in (None, *said)):
        raise CalibrationError(
            "says of its lenses that they are pinhole and fisheye", file=path, key="--projection"
        )
    four = any(len(found.get(key, ())) == 4 and found[key].any() for key in ("D1", "D2"))
    if four and not said and hints.projection is None:
        _log.warning(
            "%s: four distortion coefficients, read as k1 k2 p1 p2 of a pinhole camera; "
            "if they are those of cv2.fisheye, say --projection equidistant",
            path,
        )
    return hints.projection or ("equidistant" if "equidistant" in said else "pinhole")


def _check_lenses(path: Path, found: dict[str, F64], projection: Projection) -> None:
    """One eye with distortion and the other without is a name that is not understood."""
    missing = [key for key in ("D1", "D2") if key not in found]
    if len(missing) == 1:
        problem = (
            f"has no {missing[0]} (also called {also(missing[0])}), but the other eye's distortion"
        )
        raise CalibrationError(problem, file=path, remedy="A lens without distortion has zeros")
    if missing:
        _log.warning("%s: no distortion found; the lenses are taken for ideal ones", path)
    elif projection == "equidistant" and any(len(found[key]) != 4 for key in ("D1", "D2")):
        raise CalibrationError("a fisheye lens has 4 coefficients", file=path, key="D1")


def _entry(path: Path, found: dict[str, F64], key: str) -> F64:
    if key not in found:
        has = ", ".join(found) or "none that is known"
        raise CalibrationError(f"has no {key} (also called {also(key)}); found: {has}", file=path)
    return found[key]


def _camera(K: F64, distortion: F64 | None, projection: Projection) -> CameraModel:
    """Zeros behind the coefficients in use (OpenCV writes up to 14) are left out."""
    D = () if distortion is None else tuple(distortion.tolist())
    D = without_tail(D, 8) if projection == "pinhole" else D
    return CameraModel(
        (float(K[0, 0]), float(K[1, 1])), (float(K[0, 2]), float(K[1, 2])), D, projection
    )
