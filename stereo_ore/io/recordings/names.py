"""What file names say: which eye, which frame, when."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Literal

Side = Literal["left", "right"]

LONGEST_NAME = 100
"""Characters of a frame's name: results add suffixes, and file systems stop at 255 bytes."""

_WORD = re.compile(r"(?:(?<![A-Za-z])(?:left|right|LEFT|RIGHT)|Left|Right)(?![a-z])")
_LETTER = re.compile(r"(?<![A-Za-z])[LR](?![A-Za-z])")
_MIDDLEBURY = re.compile(r"(?<=^im)[01]$")
_SIDES: dict[str, Side] = {"left": "left", "l": "left", "0": "left", "right": "right", "r": "right", "1": "right"}


def split_name(stem: str) -> tuple[Side | None, str]:
    """Side and frame key of a file's stem.

    The mark is the word left or right, the capital letter L or R, or Middlebury's ``im0``, ``im1``; it may stand
    anywhere, and what is left over is the key: ``left000007`` → ("left", "000007"), ``cam_R_7`` → ("right", "cam_7").
    """
    for mark in (_WORD, _LETTER):
        if match := mark.search(stem):
            before, after = stem[: match.start()].rstrip("_-. "), stem[match.end() :].lstrip("_-. ")
            return _SIDES[match[0].lower()], "_".join(filter(None, (before, after)))
    if match := _MIDDLEBURY.search(stem):
        return _SIDES[match[0]], ""
    return None, stem


def natural_key(text: str) -> list[tuple[int, int, str]]:
    """Sort key by which frame 9 comes before frame 10; ties between 9 and 09 go by the text."""
    parts = [part for part in re.split(r"(\d+)", text) if part]
    return [*((0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts), (2, 0, text)]


def frame_names(keys: Iterable[str]) -> tuple[str, ...]:
    """Names that are safe as file names, made unique by a counter."""
    names: dict[str, None] = {}
    for key in keys:
        name = re.sub(r"[^\w.-]+", "_", key, flags=re.ASCII).strip("._")[:LONGEST_NAME] or "frame"
        unique, count = name, 2
        while unique in names:
            unique, count = f"{name}_{count}", count + 1
        names[unique] = None
    return tuple(names)


def stamp_name(stamp_ns: int) -> str:
    """The name of a frame whose stamp is known: 19 digits, so that names sort as stamps do."""
    return f"{stamp_ns:019d}"


def name_stamp(name: str) -> int | None:
    """The stamp [ns] of a frame whose name is one (19 digits, 64 bit); other names say nothing about time."""
    return int(name) if re.fullmatch(r"\d{19}", name, re.ASCII) and int(name) < 2**63 else None
