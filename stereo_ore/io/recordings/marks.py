"""Words and letters in names that tell an eye, and which of them counts where a name has
several.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from stereo_ore.io.recordings.names import Side

_log = logging.getLogger(__name__)


class Mark(NamedTuple):
    """A word or letter in a name that tells an eye: what kind, which eye, from where to where."""

    kind: str
    side: Side
    start: int
    end: int


_MARKS = re.compile(
    r"(?P<word>(?:(?<![A-Za-z])(?:left|right|LEFT|RIGHT)|Left|Right)(?![a-z]))"
    r"|(?P<letter>(?<![A-Z])[LR](?![A-Za-z]))"
    r"|(?P<small>(?<![A-Za-z])[lr](?![A-Za-z]))"
)
_KINDS = ("word", "letter", "small")
SEPARATORS = "_-. "
"""What may stand between a mark and the rest of a name."""


def marks(text: str) -> list[Mark]:
    """The marks in a name, from the first to the last."""
    found = []
    for match in _MARKS.finditer(text):
        side: Side = "left" if match[0][0] in "lL" else "right"
        found.append(Mark(str(match.lastgroup), side, match.start(), match.end()))
    return found


def read_marks(texts: Sequence[str], groups: Sequence[str] = ()) -> list[tuple[Side | None, str]]:
    """Eye and rest of each name, read alike for all of them; partners are in the same group (one,
    by default).

    Of the ways to read them (which kind of mark, and the how manieth where a name has several) the
    one is taken by which most find their partner; of equals the last mark, and words before
    letters.
    """
    found = [marks(text) for text in texts]
    ways = [(kind, place) for kind in _KINDS for place in range(-1, -1 - _most(found, kind), -1)]
    ways += [(kind, 0) for kind in _KINDS if _most(found, kind) > 1]
    if not ways:
        return [(None, text) for text in texts]
    if len(ways) == 1 and ways[0][0] != "small":
        return _read(texts, found, *ways[0])
    readings = [_read(texts, found, kind, place) for kind, place in ways]
    pairs = [_pairs(reading, groups or [""] * len(texts)) for reading in readings]
    best = max(range(len(ways)), key=lambda number: (len(pairs[number]), -number))
    if not pairs[best]:  # a small l or r alone is no mark: it must have its partner
        best = next((number for number, (kind, _) in enumerate(ways) if kind != "small"), -1)
        return readings[best] if best >= 0 else [(None, text) for text in texts]
    _say_doubt(pairs[best], [other for other in pairs if len(other) == len(pairs[best])])
    return readings[best]


def _most(found: Sequence[Sequence[Mark]], kind: str) -> int:
    """The most marks of a kind in one name."""
    return max((sum(mark.kind == kind for mark in each) for each in found), default=0)


def _read(
    texts: Sequence[str], found: Sequence[Sequence[Mark]], kind: str, place: int
) -> list[tuple[Side | None, str]]:
    """Eye and rest by the mark of a kind at a `place` from the end (-1 the last); 0: by all, which
    must agree.

    A name without such a mark is read by the last of its words or else letters, so that no eye is
    lost.
    """
    result: list[tuple[Side | None, str]] = []
    for text, each in zip(texts, found, strict=True):
        own = [mark for mark in each if mark.kind == kind]
        used = own if place == 0 else own[place:][:1] if len(own) >= -place else []
        for other in _KINDS[:2]:
            used = used or [mark for mark in each if mark.kind == other][-1:]
        sides = {mark.side for mark in used}
        result.append((used[0].side, without(text, used)) if len(sides) == 1 else (None, text))
    return result


def without(text: str, used: Sequence[Mark]) -> str:
    """What is left of a name without some of its marks."""
    for mark in reversed(used):
        text = joined(text[: mark.start].rstrip(SEPARATORS), text[mark.end :].lstrip(SEPARATORS))
    return text


def joined(*parts: str) -> str:
    """Parts of a key, empty ones left out."""
    return "_".join(filter(None, parts))


def _pairs(
    reading: Iterable[tuple[Side | None, str]], groups: Sequence[str]
) -> frozenset[tuple[int, int]]:
    """Numbers of the left and right name of each pair."""
    sides: dict[Side, dict[tuple[str, str], int]] = {"left": {}, "right": {}}
    for number, (side, key) in enumerate(reading):
        if side:
            sides[side][groups[number], key] = number
    return frozenset(
        (number, sides["right"][key])
        for key, number in sides["left"].items()
        if key in sides["right"]
    )


def _say_doubt(
    taken: frozenset[tuple[int, int]], equals: Sequence[frozenset[tuple[int, int]]]
) -> None:
    if any(other != taken for other in equals):
        _log.warning(
            "names can be read in more than one way; the last mark in a name is taken for the eye's"
        )
