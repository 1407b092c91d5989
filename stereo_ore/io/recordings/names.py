"""What file names say: which eye, which frame, when."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Literal

Side = Literal["left", "right"]

LONGEST_NAME = 100
"""Characters of a frame's name: results add suffixes, and file systems stop at 255 bytes."""

_WORD = re.compile(r"(?:(?<![A-Za-z])(?:left|right|LEFT|RIGHT)|Left|Right)(?![a-z])")
_LETTER = re.compile(r"(?<![A-Z])[LR](?![A-Za-z])")
_MIDDLEBURY = re.compile(r"(?<=^im)[01]$")
_STAMP = re.compile(
    r"(?P<digits>\d{10}(?=[._])|\d{13}|\d{16}|\d{19})(?:(?<=^.{10})[._](?P<fraction>\d{1,9}))?",
    re.ASCII,
)
STAMPS_FROM_NS, STAMPS_TO_NS = 946_684_800 * 10**9, 2_000_000_000 * 10**9
"""2000 and 2033: smaller numbers of so many digits count something else, larger ones may be a
date's digits."""
_SIDES: dict[str, Side] = {
    "left": "left",
    "l": "left",
    "0": "left",
    "right": "right",
    "r": "right",
    "1": "right",
}


def split_name(stem: str) -> tuple[Side | None, str]:
    """Side and frame key of a file's stem.

    The mark is the word left or right, the capital letter L or R, or Middlebury's ``im0``, ``im1``;
    it may stand anywhere, and what is left over is the key: ``left000007`` → ("left", "000007"),
    ``cam_R_7`` → ("right", "cam_7").
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
    return [
        *((0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts),
        (2, 0, text),
    ]


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
    """The stamp [ns since 1970, UTC] that a frame's name is; None for names that say nothing about
    time.

    Read are 19 digits (ns, 64 bit) and, from 2000 to 2033, 16 digits (µs), 13 (ms), and seconds
    with a fraction (``1764150000.104512``, ``1764150000_104512000``).
    """
    match = _STAMP.fullmatch(name)
    if match is None:
        return None
    digits, fraction = match["digits"], match["fraction"]
    if fraction is None and len(digits) == 19:
        return int(digits) if int(digits) < 2**63 else None
    stamp_ns = int(digits) * 10 ** (19 - len(digits)) + int((fraction or "").ljust(9, "0"))
    return stamp_ns if STAMPS_FROM_NS <= stamp_ns < STAMPS_TO_NS else None
