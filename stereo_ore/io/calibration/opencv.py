"""OpenCV FileStorage (YAML, XML, JSON) as `stereoCalibrate` users write it: M1 D1 M2 D2 R T, under many names."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration.formats import Hints, numbers, other_eye, size_of
from stereo_ore.io.calibration.geometry import make_calibration
from stereo_ore.io.yaml_io import parse_yaml, read_text
from stereo_ore.types import F64, CameraModel, StereoCalibration

NAMES = {
    "K1": "m1 k1 cameramatrix1 cammatrix1 cammat1 mtx1 leftk kleft kl leftcameramatrix cameramatrixleft mtxl",
    "K2": "m2 k2 cameramatrix2 cammatrix2 cammat2 mtx2 rightk kright kr rightcameramatrix cameramatrixright mtxr",
    "D1": "d1 distcoeffs1 distcoeff1 dist1 leftd dleft dl leftdistcoeffs distcoeffsleft distl distortion1",
    "D2": "d2 distcoeffs2 distcoeff2 dist2 rightd dright dr rightdistcoeffs distcoeffsright distr distortion2",
    "R": "r rotation rotationmatrix rot stereor",
    "T": "t translation translationvector trans stereot",
    "P1": "p1 leftp pleft pl projectionmatrix1",
    "P2": "p2 rightp pright pr projectionmatrix2",
    "size": "imagesize imgsize size resolution",
    "width": "imagewidth width cols calibwidth leftwidth",
    "height": "imageheight height rows calibheight leftheight",
}
"""Spellings of each entry, in lower case without separators."""

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
        When an entry is missing, with the names it may have.
    """
    found = _entries(path, text)
    if not {"K1", "R"} <= found.keys() and any(word in path.name for word in _HALVES[1]):
        other = next(part for part in other_eye(path, _HALVES) if part != path)
        found = (_entries(other, read_text(other, CalibrationError)) if other.exists() else {}) | found
    width_height = [float(found[key][0]) for key in ("width", "height") if key in found]
    in_file = found["size"].tolist() if "size" in found else width_height or None
    if hints.images == "rectified":
        return _rectified(path, found, size_of(path, in_file, hints), hints)
    K1, K2 = (_matrix(path, found, key) for key in ("K1", "K2"))
    D1, D2 = (found.get(key, np.zeros(0)) for key in ("D1", "D2"))
    rotation, shift = _entry(path, found, "R"), numbers(path, "T", _entry(path, found, "T"), 3)
    if rotation.size not in (3, 9):
        raise CalibrationError(f"must have 3 or 9 numbers, not {rotation.size}", file=path, key="R")
    return make_calibration(
        path,
        image_size=size_of(path, in_file, hints),
        left=_camera(K1, D1),
        right=_camera(K2, D2),
        rotation=rotation if rotation.size == 3 else rotation.reshape(3, 3),
        translation_m=shift * hints.unit_m,
        images="raw",
        camera=path.stem,
    )


def _rectified(path: Path, found: dict[str, F64], size: tuple[int, int], hints: Hints) -> StereoCalibration:
    P1, P2 = (numbers(path, key, _entry(path, found, key), 12).reshape(3, 4) for key in ("P1", "P2"))
    if P2[0, 0] == 0:
        raise CalibrationError("has a focal length of zero", file=path, key="P2")
    return make_calibration(
        path,
        image_size=size,
        left=_camera(P1[:, :3], np.zeros(0)),
        right=_camera(P2[:, :3], np.zeros(0)),
        translation_m=(P2[0, 3] / P2[0, 0] * hints.unit_m, 0.0, 0.0),
        images="rectified",
        camera=path.stem,
    )


def _entries(path: Path, text: str) -> dict[str, F64]:
    """Entries by our name for them, flat."""
    spellings = {spelling: name for name, words in NAMES.items() for spelling in words.split()}
    found = {}
    for key, value in _parse(path, text).items():
        name = spellings.get(re.sub(r"[^a-z0-9]", "", str(key).lower()))
        if name:
            found[name] = numbers(path, key, value.get("data") if isinstance(value, dict) else value)
    return found


def _parse(path: Path, text: str) -> dict[str, Any]:
    """The entries of a storage; ``cv2.FileStorage`` itself may abort the process on a damaged file."""
    text = text.lstrip()
    try:
        if text.startswith("<"):
            return _parse_xml(text)
        if text.startswith("{"):
            return dict(json.loads(text))
    except (ElementTree.ParseError, ValueError, TypeError, RecursionError) as fault:
        raise CalibrationError(f"is not a valid OpenCV FileStorage: {fault}", file=path) from None
    body = "\n".join(line for line in text.splitlines() if not line.startswith("%"))
    return parse_yaml(re.sub(r"!!opencv-(nd-)?matrix", "", body), path, CalibrationError)


def _parse_xml(text: str) -> dict[str, Any]:
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("document types and entities are not read")
    entries = {}
    for entry in ElementTree.fromstring(text):
        data = entry.find("data")
        entries[entry.tag] = ((entry if data is None else data).text or "").split()
    return entries


def _entry(path: Path, found: dict[str, F64], key: str) -> F64:
    if key not in found:
        has = ", ".join(found) or "none that is known"
        raise CalibrationError(f"has no {key} (also called {NAMES[key].replace(' ', ', ')}); found: {has}", file=path)
    return found[key]


def _matrix(path: Path, found: dict[str, F64], key: str) -> F64:
    return numbers(path, key, _entry(path, found, key), 9).reshape(3, 3)


def _camera(K: F64, distortion: F64) -> CameraModel:
    """Zeros behind the coefficients in use (OpenCV writes up to 14) are left out."""
    D = distortion.tolist()
    while len(D) > 8 and D[-1] == 0:
        D.pop()
    return CameraModel((float(K[0, 0]), float(K[1, 1])), (float(K[0, 2]), float(K[1, 2])), tuple(D))
