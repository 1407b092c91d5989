"""Which two topics of a bag are the eyes."""

from __future__ import annotations

import re
from collections.abc import Collection
from itertools import takewhile
from pathlib import Path

from stereo_ore.errors import CalibrationError, SourceError
from stereo_ore.io.recordings.names import split_name
from stereo_ore.types import StereoCalibration

_TRANSPORTS, _DEPTH = ("/compressed", "/video", "/ffmpeg", "/zstd"), "/compressedDepth"
NUMBERED: tuple[tuple[str, str], ...] = (
    ("infra1", "infra2"),
    ("infrared1", "infrared2"),
    ("infrared_1", "infrared_2"),
    ("cam0", "cam1"),
    ("cam_0", "cam_1"),
    ("camera0", "camera1"),
    ("camera_0", "camera_1"),
)
"""Parts of topics that tell the eyes by numbers, in small letters: RealSense's drivers and
recorders, camera rigs."""

PREFERRED: tuple[tuple[str, str], ...] = (
    ("zed-ros2-wrapper", "/left/color/rect/image"),  # from 5.0 on
    ("zed-ros2-wrapper", "/left/image_rect_color"),
    ("realsense-ros", "/infra1/image_rect_raw"),
    ("image_pipeline, depthai-ros", "/left/image_rect"),
    ("zed-ros2-wrapper", "/left/gray/rect/image"),
    ("zed-ros2-wrapper", "/left_gray/image_rect_gray"),
    ("zed-ros2-wrapper", "/left/color/raw/image"),
    ("zed-ros2-wrapper", "/left_raw/image_raw_color"),
    ("image_pipeline, depthai-ros", "/left/image_raw"),
    ("image_pipeline", "/left/image_color"),
    ("image_pipeline", "/left/image_mono"),
)
"""Drivers and the ends of their left eyes' topics, best first: of one camera that offers several
pairs the first is taken. The images are the same, so that this is no guess."""


_SMALL = re.compile(r"(?<![A-Za-z])[lr](?![A-Za-z])")


def choose_topics(
    topics: Collection[str], wanted: tuple[str, str] | None, path: Path | str
) -> tuple[str, str]:
    """The left and the right image topic: those wanted, or the only two that differ in left and
    right alone.

    Of several pairs of one camera that is known the best is taken (`PREFERRED`); of an image that
    is there both plain and compressed, the plain one.

    Raises
    ------
    SourceError
        When a wanted topic is missing, or when no pair or more than one is there: the wrong one
        would be a guess.
    """
    listing = ", ".join(sorted(topics)) or "none"
    if wanted:
        if missing := [topic for topic in wanted if topic not in topics]:
            raise SourceError(
                f"has no image topic {missing[0]}",
                file=path,
                key="topics",
                remedy=f"Image topics: {listing}",
            )
        return wanted
    pairs = _pairs([topic for topic in topics if not topic.endswith(_DEPTH)])
    pairs = [
        pair
        for pair in pairs
        if (_plain(pair[0]), _plain(pair[1])) not in pairs or _plain(pair[0]) == pair[0]
    ]
    pairs = _preferred(pairs)
    if len(pairs) != 1:
        found = f"has {len(pairs)} pairs of left and right image topics"
        choices = " or ".join(f"--left-topic {left} --right-topic {right}" for left, right in pairs)
        remedy = f"Give {choices or f'--left-topic and --right-topic; image topics: {listing}'}"
        raise SourceError(found, file=path, key="topics", remedy=remedy)
    return pairs[0]


def camera_info_topics(image_topic: str) -> tuple[str, ...]:
    """Where the calibration of an image topic may be: beside it, beside the image that it is made
    of, in ``info``, below it.
    """
    parent = _plain(image_topic).rpartition("/")[0]
    above = parent.rpartition("/")[0]
    recorded = image_topic.partition("/image/data")[0] + "/info"
    places = (parent, above, recorded, _plain(image_topic))
    return tuple(f"{place}/camera_info" for place in places if place.count("/") > 0)


def is_rectified(image_topic: str) -> bool:
    """ROS's convention: image_rect, image_rect_color, rect/image against image_raw, image,
    image_mono.
    """
    parts = _plain(image_topic).split("/")
    return "rect" in parts[-1] or "rect" in parts or "rectified" in parts


def check_images(image_topic: str, calibration: StereoCalibration, file: Path) -> None:
    """CalibrationError when a calibration of raw images is to be used for a topic of rectified
    ones, which would be rectified twice.
    """
    if is_rectified(image_topic) and calibration.images == "raw":
        raise CalibrationError(
            f"is for raw images, {image_topic} has rectified ones",
            file=file,
            key="images",
            remedy="Name the topics of the raw images with --left-topic and --right-topic",
        )


def _pairs(topics: Collection[str]) -> list[tuple[str, str]]:
    """Topics that differ in left and right alone: in one of their parts, the last that will do
    (``/left_arm/camera/right/image`` is a right eye), or else in all that tell an eye.
    """
    pairs = dict[str, str]()
    longest = max((topic.count("/") for topic in topics), default=0)
    for place in (*range(-1, -2 - longest, -1), None):
        sides: dict[str, dict[tuple[str, ...], str]] = {"left": {}, "right": {}}
        for topic in sorted(set(topics) - pairs.keys() - set(pairs.values())):
            side, key = _eye_of(topic.split("/"), place)
            if side:
                sides[side][key] = topic
        both = sides["left"].keys() & sides["right"].keys()
        pairs |= {sides["left"][key]: sides["right"][key] for key in both}
    return sorted(pairs.items())


def _eye_of(parts: list[str], place: int | None) -> tuple[str | None, tuple[str, ...]]:
    """The eye that the part of a topic at a `place` tells (None: all parts, which must agree), and
    the topic without it.
    """
    whole = range(-len(parts), 0)
    used = whole if place is None else {place} & set(whole)
    split = {i: _split(parts[i]) for i in used}
    sides = {side for side, _ in split.values() if side}
    key = tuple(split[i][1] if i in split else parts[i] for i in whole)
    return (sides.pop() if len(sides) == 1 else None), key


def _preferred(pairs: list[tuple[str, str]]) -> list[tuple[str, str]]:
    """The best of several pairs of one camera; all of them where that can't be told."""
    if len({_camera(pair) for pair in pairs}) == 1:
        for _, end in PREFERRED:
            if best := [pair for pair in pairs if _plain(pair[0]).endswith(end)]:
                return best
    return pairs


def _camera(pair: tuple[str, str]) -> str:
    """What comes before the part of the topics that tells the eyes."""
    parts = zip(pair[0].split("/"), pair[1].split("/"), strict=True)
    return "/".join(left for left, _ in takewhile(lambda part: part[0] == part[1], parts))


def _split(part: str) -> tuple[str | None, str]:
    """Eye and rest of one part of a topic."""
    for pair in NUMBERED:
        if part.lower() in pair:
            return ("left", "right")[pair.index(part.lower())], pair[0]
    side, key = split_name(part)
    if side is None and (small := _SMALL.search(part)):
        return ("left" if small[0] == "l" else "right"), part[: small.start()] + part[small.end() :]
    return side, key


def _plain(topic: str) -> str:
    for suffix in _TRANSPORTS:
        topic = topic.removesuffix(suffix)
    return topic
