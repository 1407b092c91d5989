"""The names under which people write K, D, R, T and P of a stereo pair."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration.formats import numbers
from stereo_ore.types import F64

EYE_NAMES = {
    "K": (
        "m k cameramatrix cammatrix cammat mtx intrinsic intrinsics intrinsicmatrix"
        " intrinsicsmatrix matrix"
    ),
    "D": (
        "d dist distcoeffs distcoeff distcoefs distcoef distortioncoefficients"
        " distortioncoefficient distortioncoeffs distortioncoeff distortioncoefs distortion"
        " distortionvector distortions disto coeffs kc distcoefficients distcoefficient distparams"
        " lensdistortion"
    ),
    "P": "p projection projectionmatrix proj",
    "size": "size imagesize imgsize resolution res",
}
"""Names of what each eye has, in lower case without separators and without the mark of the eye."""

SHARED_NAMES = {
    "R": "r rotation rotationmatrix rot stereor rotationvector",
    "T": "t translation translationvector trans stereot",
    "size": "imagesize imgsize size resolution imageresolution framesize",
    "width": "imagewidth width cols calibwidth leftwidth",
    "height": "imageheight height rows calibheight leftheight",
}
"""Names of what both eyes have together."""

MARKS = {"left": "1", "l": "1", "right": "2", "r": "2", "0": "1", "1": "1", "2": "2"}
"""Marks of an eye before or behind a name; a file that counts from 0 is known by its 0."""

_SIDE = "left|right|l|r|[012]"
_WORDS = "|".join(
    sorted((word for words in EYE_NAMES.values() for word in words.split()), key=len, reverse=True)
)
_EYE = re.compile(rf"(?:cam(?:era)?)?({_SIDE})?({_WORDS})({_SIDE})?")
_FISHEYE = re.compile(r"fish_?eye|(?<![a-z])fe(?![a-z])", re.IGNORECASE)

_KNOWN = re.compile(
    r"[efqh]|(left|right)?r(ect|ectification)?(left|right|[12lr])|(valid)?roi.*|map[12lr].*|rms.*|.*error.*|retval|"
    r"flags|calibration(time|date)|time|date|n(r|um|b)?(of)?(frames|views|images|pairs)|frames?count|"
    r"(board|square|pattern|marker|grid).*|aspectratio|alpha|unit|(essential|fundamental)(matrix)?|disparitytodepth.*|"
    r"name|camera(name|id)|serial.*|version|imagepoints.*|extrinsicparameters|[rt]vecs?[12lr]?|[hvd]?fov"
)
"""Entries that mean nothing for the geometry of the recorded images."""


def sort_entries(
    path: Path, entries: dict[str, Any]
) -> tuple[dict[str, F64], dict[str, Any], bool]:
    """The entries by our name for them, those that are not known, and whether a name says
    "fisheye".

    Raises
    ------
    CalibrationError
        When an entry is no numbers, or given twice with different ones.
    """
    found, unread, fisheye = dict[str, F64](), dict[str, Any](), False
    named = {key: _name(key) for key in entries}
    counts_from_0 = any(name and name[1] == "0" for name in named.values())
    for key, value in entries.items():
        name = named[key]
        if name is None:
            unread |= {} if _KNOWN.fullmatch(plain_name(key)) else {key: value}
            continue
        word, mark = name
        eye = "2" if mark == "1" and counts_from_0 else MARKS.get(mark, "")
        ours, array = word + eye, numbers(path, key, value)
        if ours in found and not np.array_equal(found[ours], array):
            raise CalibrationError(
                f"has two {ours} that differ", file=path, key=key, remedy="Leave one of them out"
            )
        found[ours] = array
        fisheye |= word == "D" and bool(_FISHEYE.search(key)) and bool(array.any())
    return found, unread, fisheye


def plain_name(key: str) -> str:
    """A name in small letters, without separators."""
    return re.sub(r"[^a-z0-9]", "", key.lower())


def _name(key: str) -> tuple[str, str] | None:
    """Our name of an entry and the mark of its eye."""
    plain = plain_name(key)
    for name, words in SHARED_NAMES.items():
        if plain in words.split():
            return name, ""
    match = _EYE.fullmatch(plain_name(_FISHEYE.sub("", key)))
    if match is None or bool(match[1]) == bool(match[3]):
        return None
    return (
        next(name for name, words in EYE_NAMES.items() if match[2] in words.split()),
        match[1] or match[3],
    )


def also(key: str) -> str:
    """Some of the names that an entry may have."""
    if key[:-1] in EYE_NAMES:
        side = {"1": "left", "2": "right"}[key[-1]]
        words = EYE_NAMES[key[:-1]].split()[:4]
        return ", ".join(
            [*(word + key[-1] for word in words), *(f"{side}_{word}" for word in words)]
        )
    return SHARED_NAMES[key].replace(" ", ", ")
