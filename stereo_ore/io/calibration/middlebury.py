"""Middlebury and ETH3D ``calib.txt``: rectified, millimetres, Z = f·B / (d + doffs)."""

from __future__ import annotations

import re
from pathlib import Path

from stereo_ore.config.validation import nearest_word
from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration.formats import Hints, numbers, size_of, tell_unread
from stereo_ore.io.calibration.geometry import make_calibration
from stereo_ore.types import F64, CameraModel, StereoCalibration

_CAMERA = re.compile(r"^[ \t]*cam0[ \t]*=[ \t]*\[", re.MULTILINE)
_KNOWN = (
    "cam0",
    "cam1",
    "doffs",
    "baseline",
    "width",
    "height",
    "ndisp",
    "isint",
    "vmin",
    "vmax",
    "dyavg",
    "dymax",
    "rotation",
)
DOFFS_TOLERANCE_PX = 0.01


def recognises(text: str) -> bool:
    """Whether the text has ``cam0=[…``."""
    return bool(_CAMERA.search(text))


def read(path: Path, text: str, hints: Hints) -> StereoCalibration:
    """The calibration; doffs is the difference of the principal points and must agree with the
    file's own entry.
    """
    entries = {
        key.strip(): value.strip()
        for key, _, value in (line.partition("=") for line in text.splitlines())
    }
    if hints.images == "raw":
        raise CalibrationError(
            "a Middlebury calibration describes rectified images, not raw ones", file=path
        )
    tell_unread(path, {key: value for key, value in entries.items() if value and key not in _KNOWN})
    left, right = (_matrix(path, entries, key) for key in ("cam0", "cam1"))
    doffs = right[0, 2] - left[0, 2]
    if (
        "doffs" in entries
        and not abs(_number(path, entries, "doffs") - doffs) <= DOFFS_TOLERANCE_PX
    ):
        raise CalibrationError(
            f"is {entries['doffs']}, but cx of cam1 − cam0 is {doffs:g}", file=path, key="doffs"
        )
    size = (
        [_number(path, entries, key) for key in ("width", "height")] if "width" in entries else None
    )
    return make_calibration(
        path,
        image_size=size_of(path, size, hints),
        left=_camera(left),
        right=_camera(right),
        translation_m=(-round(_number(path, entries, "baseline") / 1000, 12), 0.0, 0.0),
        images="rectified",
        camera=path.parent.name or path.stem,
    )


def _text(path: Path, entries: dict[str, str], key: str) -> str:
    if key not in entries:
        raise CalibrationError(
            f"key is missing{nearest_word(key, filter(None, entries))}", file=path, key=key
        )
    return entries[key]


def _number(path: Path, entries: dict[str, str], key: str) -> float:
    return float(numbers(path, key, [_text(path, entries, key)], 1)[0])


def _matrix(path: Path, entries: dict[str, str], key: str) -> F64:
    words = _text(path, entries, key).strip("[]").replace(";", " ").split()
    return numbers(path, key, words, 9).reshape(3, 3)


def _camera(K: F64) -> CameraModel:
    return CameraModel((float(K[0, 0]), float(K[1, 1])), (float(K[0, 2]), float(K[1, 2])))
