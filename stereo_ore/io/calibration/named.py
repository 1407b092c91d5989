"""JSON, YAML or NPZ that people write themselves with OpenCV's names (K1, distCoeffs_left, R, T …),
also in groups of an eye: ``{"left": {"camera_matrix": …}}``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration import opencv
from stereo_ore.io.calibration.file_storage import plain_yaml
from stereo_ore.io.calibration.formats import Hints, parse_json
from stereo_ore.io.calibration.opencv_names import EYE_NAMES, SHARED_NAMES, plain_name
from stereo_ore.io.yaml_io import parse_yaml
from stereo_ore.types import StereoCalibration

_KEY = re.compile(
    r"""(?:^|[{,])[ \t]*["']?([A-Za-z][\w.-]*(?: [\w.-]+){0,3})["']?[ \t]{0,3}:""", re.MULTILINE
)
_EYE_GROUP = re.compile(r"(?:cam(?:era)?)?(left|right|l|r|[012])(?:cam(?:era)?|eye)?")
_CENTRE, _LENS = ("fx", "fy", "cx", "cy"), ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_DEEPEST = 4


def recognises(text: str) -> bool:
    """Whether the text has keys for a translation and for a camera or its centre."""
    keys = {plain_name(key) for key in _KEY.findall(text)}
    cameras = {word.rstrip("s") for word in EYE_NAMES["K"].split()} | {"fx"}
    bare = {
        re.sub(r"(left|right|[lr012])$", "", re.sub(r"^(left|right|[lr])", "", key)).rstrip("s")
        for key in keys
    }
    return bool(keys & set(SHARED_NAMES["T"].split())) and bool(bare & cameras)


def read(path: Path, text: str, hints: Hints) -> StereoCalibration:
    """The calibration in the file, whose entries are OpenCV's by name.

    Raises
    ------
    CalibrationError
        As for OpenCV's own files, and when an entry is given twice.
    """
    json = text.lstrip().startswith("{")
    data = (
        parse_json(path, text)
        if json
        else parse_yaml(plain_yaml(text), path, CalibrationError, aliases=True)
    )
    entries = dict[str, Any]()
    for key, value in _flat(data):
        if key in entries:
            raise CalibrationError(
                "is given twice", file=path, key=key, remedy="Leave one of them out"
            )
        entries[key] = value
    return opencv.combine_storages(path, entries, hints)


def _flat(data: Mapping[str, Any], eye: str = "", level: int = 0) -> Iterator[tuple[str, Any]]:
    """Entries with the eye of their group before their names; other groups mean nothing."""
    if set(_CENTRE) <= data.keys():
        fx, fy, cx, cy = (data[key] for key in _CENTRE)
        yield f"{eye}K", [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
        if used := [key for key in _LENS if key in data]:
            last = max(_LENS.index(key) for key in used)
            count = next(count for count in (4, 5, 8) if count > last)
            yield f"{eye}D", [data.get(key, 0.0) for key in _LENS[:count]]
        data = {key: value for key, value in data.items() if key not in (*_CENTRE, *_LENS)}
    for key, value in data.items():
        if not isinstance(value, Mapping) or level >= _DEEPEST:
            yield f"{eye}{key}", value
        elif "data" in value:
            yield f"{eye}{key}", value["data"]
        else:
            group = _EYE_GROUP.fullmatch(plain_name(str(key)))
            yield from _flat(value, f"{group[1]}_" if group else eye, level + 1)
