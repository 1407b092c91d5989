"""Which two topics of a bag are the eyes."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from stereo_ore.errors import SourceError
from stereo_ore.io.recordings.names import split_name

COMPRESSED, DEPTH = "/compressed", "/compressedDepth"


def choose_topics(topics: Collection[str], wanted: tuple[str, str] | None, path: Path) -> tuple[str, str]:
    """The left and the right image topic: those wanted, or the only two that differ in left and right alone.

    Of an image that is there both plain and compressed, the plain one is taken.

    Raises
    ------
    SourceError
        When a wanted topic is missing, or when no pair or more than one is there: the wrong one would be a guess.
    """
    listing = ", ".join(sorted(topics)) or "none"
    if wanted:
        if missing := [topic for topic in wanted if topic not in topics]:
            raise SourceError(
                f"has no image topic {missing[0]}", file=path, key="topics", remedy=f"Image topics: {listing}"
            )
        return wanted
    pairs = _pairs([topic for topic in topics if not topic.endswith(DEPTH)])
    pairs = [pair for pair in pairs if (_plain(pair[0]), _plain(pair[1])) not in pairs or _plain(pair[0]) == pair[0]]
    if len(pairs) != 1:
        found = f"has {len(pairs)} pairs of left and right image topics"
        choices = " or ".join(f"--left-topic {left} --right-topic {right}" for left, right in pairs)
        remedy = f"Give {choices or f'--left-topic and --right-topic; image topics: {listing}'}"
        raise SourceError(found, file=path, key="topics", remedy=remedy)
    return pairs[0]


def camera_info_topic(image_topic: str) -> str:
    """Where ROS publishes the calibration of an image topic: beside it."""
    return _plain(image_topic).rpartition("/")[0] + "/camera_info"


def is_rectified(image_topic: str) -> bool:
    """ROS's convention: image_rect, image_rect_color against image_raw, image, image_mono."""
    return "rect" in _plain(image_topic).rpartition("/")[2]


def _pairs(topics: Collection[str]) -> list[tuple[str, str]]:
    sides: dict[str, dict[tuple[str, ...], str]] = {"left": {}, "right": {}}
    for topic in sorted(topics):
        marks = [split_name(part) for part in topic.split("/")]
        side = next((side for side, _ in marks if side), None)
        if side:
            sides[side][tuple(key for _, key in marks)] = topic
    return [(topic, sides["right"][key]) for key, topic in sides["left"].items() if key in sides["right"]]


def _plain(topic: str) -> str:
    return topic.removesuffix(COMPRESSED)
