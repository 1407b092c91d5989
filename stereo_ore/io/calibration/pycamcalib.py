"""pyCamCalib's three JSON: one an eye, and ``…_TransformationMatrix.json`` with X_2 = H·X_1 in
millimetres.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np

from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration.formats import (
    Hints,
    numbers,
    one_size,
    parse_json,
    raw_only,
    read_file,
    tell_unread,
)
from stereo_ore.io.calibration.geometry import UNITS_M, make_calibration
from stereo_ore.types import CameraModel, StereoCalibration

_log = logging.getLogger(__name__)

POSE = "_TransformationMatrix.json"
_EYES = ("camera_1_parameters.json", "camera_2_parameters.json")
_KNOWN = (
    "f",
    "c",
    "s",
    "radial_dist_coeffs",
    "tangential_dist_coeffs",
    "sensor_dimensions",
    "f_std",
    "c_std",
    "s_std",
    "radial_dist_coeffs_std",
    "tangential_dist_coeffs_std",
    "rms_reproj_error",
    "pixel_size",
    "info",
)


def text_of(path: Path) -> Path:
    """The JSON that stands beside an HDF5 file of the same calibration, else the file itself."""
    beside = path.with_name(path.stem + POSE)
    if path.suffix.lower() not in (".h5", ".hdf5") or not beside.is_file():
        return path
    _log.info("%s: read from %s beside it", path, beside.name)
    return beside


def recognises(text: str) -> bool:
    """Whether the text is one of the three."""
    return '"radial_dist_coeffs"' in text or (
        '"H"' in text and '"units"' in text and text.lstrip().startswith("{")
    )


def read(path: Path, text: str, hints: Hints) -> StereoCalibration:
    """The calibration in three files of one folder, from any of them.

    Raises
    ------
    CalibrationError
        When one of them is missing, or there are several transforms.
    """
    raw_only(path, hints)
    pose = _pose_file(path)
    H = parse_json(pose, read_file(pose))
    eyes = [parse_json(file, read_file(file)) for file in (pose.with_name(name) for name in _EYES)]
    T = numbers(pose, "H", H.get("H"), 16).reshape(4, 4)
    unit = H.get("units", "mm")
    if unit not in UNITS_M:
        raise CalibrationError(
            f"{unit!r:.20} is none of {', '.join(UNITS_M)}", file=pose, key="units"
        )
    left, right = (
        _camera(pose.with_name(name), eye) for name, eye in zip(_EYES, eyes, strict=True)
    )
    return make_calibration(
        path,
        image_size=one_size(path, [eye.get("sensor_dimensions") for eye in eyes], hints),
        left=left,
        right=right,
        rotation=T[:3, :3],
        translation_m=np.round(T[:3, 3] * UNITS_M[unit], 15),
        images="raw",
        camera=pose.name.removesuffix(POSE),
    )


def _pose_file(path: Path) -> Path:
    if path.name.endswith(POSE):
        return path
    found = sorted(path.parent.glob(f"*{POSE}"))
    if len(found) != 1:
        names = ", ".join(file.name for file in found) or "none"
        problem = f"needs one …{POSE} beside it; there is {names}"
        raise CalibrationError(
            problem, file=path, remedy=f"Name that file instead, beside {' and '.join(_EYES)}"
        )
    return found[0]


def _camera(path: Path, eye: dict[str, Any]) -> CameraModel:
    """k1 k2 k3 stand apart from p1 p2; a skew is none of OpenCV's."""
    tell_unread(path, {key: value for key, value in eye.items() if key not in _KNOWN})
    fx, fy = numbers(path, "f", eye.get("f"), 2).tolist()
    cx, cy = numbers(path, "c", eye.get("c"), 2).tolist()
    radial = numbers(path, "radial_dist_coeffs", eye.get("radial_dist_coeffs")).tolist()
    tangential = numbers(path, "tangential_dist_coeffs", eye.get("tangential_dist_coeffs")).tolist()
    if eye.get("s"):
        raise CalibrationError(f"a skew of {eye['s']!r:.20} is not supported", file=path, key="s")
    if len(radial) > 3 or len(tangential) > 2:
        problem = (
            f"has {len(radial)} radial and {len(tangential)} tangential coefficients; 3 and 2 are"
            " the most"
        )
        raise CalibrationError(problem, file=path, key="radial_dist_coeffs")
    (k1, k2, k3), (p1, p2) = (*radial, 0.0, 0.0, 0.0)[:3], (*tangential, 0.0, 0.0)[:2]
    return CameraModel((fx, fy), (cx, cy), (k1, k2, p1, p2, k3))
