"""Rows of a table of poses and pairs of a recording, put together by name."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

from stereo_ore.errors import CalibrationError

_MARKS = re.compile(
    r"left|right|\.(png|jpe?g|tiff?|bmp|pgm|ppm|webp)$|(?<![a-z])[lr](?![a-z])", re.IGNORECASE
)


def match_names(rows: Sequence[str], frames: Sequence[str]) -> dict[str, int]:
    """The row of each frame: equal names or, where that is the only possible match, equal numbers
    in them.

    A spreadsheet makes 1 of 0001, and a name may carry the mark of an eye or the ending of a file.

    Raises
    ------
    CalibrationError
        When nothing matches, or in several ways; with a name of either.
    """
    ways: tuple[Callable[[str], str], ...] = (str, _bare, _number)
    for way in ways:
        keys = [way(row) for row in rows]
        found = {frame: keys.index(way(frame)) for frame in frames if way(frame) in keys}
        alone = len(set(keys)) == len(keys) and len({way(frame) for frame in frames}) == len(frames)
        if found and (alone or way is str):
            return found
    if not rows or not frames:
        raise CalibrationError(
            f"{len(rows)} poses in the table, {len(frames)} pairs that show the board", key="poses"
        )
    raise CalibrationError(
        f"no name of the table is one of the recording: the table has {rows[0]!r:.60}, the"
        f" recording {frames[0]!r:.60}",
        key="poses",
        remedy="Give each pose the name of its pair",
    )


def _bare(name: str) -> str:
    """The name without file ending and mark of an eye."""
    return re.sub(r"[^a-z0-9]", "", _MARKS.sub("", name.strip().lower()))


def _number(name: str) -> str:
    """The number in a name that has one, without the zeros before it; the name itself where it has
    several or none.
    """
    numbers = re.findall(r"\d+", re.sub(r"\.0+$", "", _MARKS.sub("", name.strip())))
    return str(int(numbers[0])) if len(numbers) == 1 and len(numbers[0]) < 20 else name
