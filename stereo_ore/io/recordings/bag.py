"""Bags as recordings: ROS 1 and ROS 2 bags, MCAP files of ROS and of Foxglove, recordings of
RealSense.
"""

from __future__ import annotations

import logging
import re
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from stereo_ore.config.models import MAX_PIXELS
from stereo_ore.errors import FrameError, SourceError, StereoOreError
from stereo_ore.io.recordings import ros_messages
from stereo_ore.io.recordings.access_units import UnitDecoder, is_key
from stereo_ore.io.recordings.bag_files import BAG_SUFFIXES, Messages, known_faults, open_messages
from stereo_ore.io.recordings.base import make_pair, sampled_depth
from stereo_ore.io.recordings.camera_infos import Taken, calibration_of
from stereo_ore.io.recordings.images import Image, check_alike, to_8_bit
from stereo_ore.io.recordings.names import frame_names, stamp_name
from stereo_ore.io.recordings.pairing import Pair, pair_by_stamp
from stereo_ore.io.recordings.stamps import Stamp
from stereo_ore.io.recordings.topics import choose_topics
from stereo_ore.types import StereoCalibration, StereoPair

log = logging.getLogger(__name__)

SKEW_EDGES_MS = (0.0, 0.1, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)
DEVICE_TIME = re.compile(r"(?:^|;)timestamp=(\d+(?:\.\d+)?)(?:;|$)")
"""Time at which RealSense's camera took an image [ms], in the text that its recorder writes beside
it."""

MOST_WORDS = 1000
"""Characters of a message that lists topics."""


@dataclass(frozen=True)
class BagOptions:
    """What the user may say of a recording: topics of the left and right images, and how far apart
    stamps may be.
    """

    topics: tuple[str, str] | None = None
    max_skew_ms: float = 5.0


class _Entry(NamedTuple):
    """One image in a bag.

    When it was recorded (its place in the bag), when it was taken, whether that is the message's
    own stamp, and whether it is part of a video, and one that decoding can begin at.
    """

    logged_ns: int
    stamp_ns: int
    stamped: bool = True
    video: bool = False
    key: bool = False


class Reader:
    """A bag that is opened when first used, and anew after it was sent to another process."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._bag: Messages | None = None
        self._videos: dict[str, tuple[UnitDecoder, dict[_Entry, int]]] = {}

    def __reduce__(self) -> tuple[type[Reader], tuple[Path]]:
        return Reader, (self.path,)

    @property
    def bag(self) -> Messages:
        """The open bag."""
        if self._bag is None:
            self._bag = open_messages(self.path)
            weakref.finalize(self, self._bag.close)
        return self._bag

    def image_topics(self) -> set[str]:
        """Topics that carry images."""
        return {topic for topic, kind in self.bag.types.items() if kind in ros_messages.IMAGE_TYPES}

    def entries(self, topics: tuple[str, str]) -> tuple[list[_Entry], list[_Entry]]:
        """All images of two topics, by stamp; where a driver leaves the stamp empty, the time of
        recording counts.
        """
        found: dict[str, list[_Entry]] = {topic: [] for topic in topics}
        with known_faults(self.path):
            device_ns = {topic: self._device_times(topic) for topic in topics}
            for topic, logged_ns, message in self.bag.messages(topics):
                found[topic].append(_entry(logged_ns, message, device_ns[topic]))
        left, right = (
            sorted(found[topic], key=lambda entry: (entry.stamp_ns, entry.logged_ns))
            for topic in topics
        )
        return left, right

    def image(self, topic: str, entries: Sequence[_Entry], entry: _Entry, max_pixels: int) -> Image:
        """The picture of an entry: (H, W, 3) BGR, uint8 or uint16; `entries` are all of its topic
        by stamp.
        """
        if not entry.video:
            return ros_messages.image(self._message(topic, entry), self.path, max_pixels)
        if topic not in self._videos:
            units = sorted(entries, key=lambda each: each.logged_ns)
            decoder = UnitDecoder(
                self.path,
                [unit.key for unit in units],
                lambda i: bytes(self._message(topic, units[i]).data),
            )
            self._videos[topic] = decoder, {unit: number for number, unit in enumerate(units)}
        decoder, numbers = self._videos[topic]
        return decoder.picture(numbers[entry], max_pixels)

    def _message(self, topic: str, entry: _Entry) -> Any:
        """The message of an entry."""
        for _, logged_ns, message in self.bag.messages(
            [topic], entry.logged_ns, entry.logged_ns + 1
        ):
            if not entry.stamped or (ros_messages.stamp_ns(message) or logged_ns) == entry.stamp_ns:
                return message
        raise FrameError(
            f"has lost its message at {entry.logged_ns} ns", code="UNREADABLE_IMAGE", file=self.path
        )

    def _device_times(self, topic: str) -> dict[int, int]:
        """Times of the camera [ns] by time of recording, where a RealSense recorder has written
        them as text.
        """
        place, found, _ = topic.partition("/image/data")
        name = f"{place}/image/metadata"
        if not found or self.bag.types.get(name) != "std_msgs/msg/String":
            return {}
        times = (
            (logged_ns, DEVICE_TIME.search(message.data))
            for _, logged_ns, message in self.bag.messages([name])
        )
        return {logged_ns: round(1e6 * float(match[1])) for logged_ns, match in times if match}


def _entry(logged_ns: int, message: Any, device_ns: Mapping[int, int]) -> _Entry:
    video = ros_messages.is_video(message)
    key = video and is_key(bytes(message.data))
    if logged_ns in device_ns:
        return _Entry(logged_ns, device_ns[logged_ns], False, video, key)
    stamp_ns = ros_messages.stamp_ns(message)
    return _Entry(logged_ns, stamp_ns or logged_ns, bool(stamp_ns), video, key)


@dataclass(frozen=True)
class BagPairs:
    """Frames of two messages each, paired and named by stamp; either may be missing."""

    path: Path
    names: tuple[str, ...]
    topics: tuple[str, str]
    entries: tuple[tuple[_Entry | None, _Entry | None], ...]
    options: BagOptions
    reader: Reader
    max_pixels: int = MAX_PIXELS

    @property
    def description(self) -> Mapping[str, Any]:
        """Kind, topics, and how far apart the stamps of the pairs are."""
        skews = [
            abs(left.stamp_ns - right.stamp_ns) / 1e6
            for left, right in self.entries
            if left and right
        ]
        counts, _ = np.histogram(skews, [*SKEW_EDGES_MS, np.inf])
        return {
            "kind": "bag",
            "frames": len(self.names),
            "unpaired": len(self.names) - len(skews),
            "topics": list(self.topics),
            "max_skew_ms": self.options.max_skew_ms,
            "skew_ms": {
                "from": list(SKEW_EDGES_MS),
                "pairs": counts.tolist(),
                "largest": max(skews, default=None),
            },
        }

    @cached_property
    def calibration(self) -> StereoCalibration | None:
        """The calibration in the camera_info of both eyes; looked at only when no other one is
        given.

        Raises
        ------
        CalibrationError
            When it describes an impossible camera or changes on the way.
        """
        left, right = (
            [Taken(entry.logged_ns, entry.stamp_ns) for entry in eye] for eye in self.by_eye
        )
        with known_faults(self.path):
            return calibration_of(self.reader.bag, self.topics, (left, right), self.path)

    @cached_property
    def by_eye(self) -> tuple[list[_Entry], list[_Entry]]:
        """All images of either eye."""
        left, right = ([entry for pair in self.entries if (entry := pair[eye])] for eye in (0, 1))
        return left, right

    @cached_property
    def depth(self) -> int:
        """Bits of 16-bit images."""
        return sampled_depth(len(self.names), self.eyes)

    def files(self, index: int) -> tuple[Path, ...]:
        """The files of the bag."""
        if self.path.is_file():
            log = self.path.with_name(f"{self.path.name}-wal")
            return (self.path, log) if log.is_file() else (self.path,)
        return tuple(sorted(file for file in self.path.iterdir() if file.is_file()))

    def stamp(self, index: int) -> Stamp | None:
        """When the left image's message says that it was taken; without a left image, the right
        one's.
        """
        entry = next(entry for entry in self.entries[index] if entry)
        return Stamp(
            entry.stamp_ns,
            "header" if entry.stamped or entry.stamp_ns != entry.logged_ns else "container",
        )

    def eyes(self, index: int) -> tuple[Image, Image]:
        """Both images of frame `index` as stored."""
        left, right = self.entries[index]
        if left is None or right is None:
            missing = "left" if left is None else "right"
            raise FrameError(
                f"frame {self.names[index]} has no {missing} image within"
                f" {self.options.max_skew_ms:g} ms",
                code="UNPAIRED",
                file=self.path,
                remedy="Frames are paired by stamp; --max-skew-ms is the limit",
            )
        try:
            images = [
                self.reader.image(topic, entries, entry, self.max_pixels)
                for topic, entries, entry in zip(
                    self.topics, self.by_eye, (left, right), strict=True
                )
            ]
        except StereoOreError:
            raise
        except (
            Exception
        ) as fault:  # rosbags raises what it likes; messages have the fields that the bag defines
            raise FrameError(
                f"can't be read here: {fault}", code="UNREADABLE_IMAGE", file=self.path
            ) from None
        check_alike(images[0], images[1], f"{self.path}: {self.topics[0]}", self.topics[1])
        return images[0], images[1]

    def read(self, index: int) -> StereoPair:
        """Read both messages of frame `index`."""
        left, right = self.eyes(index)
        depth = self.depth if left.dtype == np.uint16 else None
        return make_pair(self, index, *to_8_bit(left, right, depth))


def open_bag(path: Path, options: BagOptions) -> BagPairs:
    """Open a bag: find the topics and pair the images by stamp.

    Raises
    ------
    MissingExtraError
        Without the packages that read it.
    SourceError
        When it can't be read or holds no recognisable pair of image topics.
    """
    if path.suffix == ".zstd" and path.is_file():
        path = _folder_of(path)
    reader = Reader(path)
    found = reader.image_topics()
    if not found and (unread := getattr(reader.bag, "unread", "")):
        raise SourceError(
            f"holds no image that can be read here: {unread}",
            file=path,
            remedy="Record it with ROS",
        )
    if not found:
        others = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(reader.bag.types.items()))
        raise SourceError(
            f"holds no topic of images; its topics: {others or 'none'}"[:MOST_WORDS],
            file=path,
            remedy=f"Known: {', '.join(ros_messages.IMAGE_TYPES[:2])} and Foxglove's images",
        )
    topics = choose_topics(found, options.topics, path)
    left, right = reader.entries(topics)
    faults = [
        f"{topic} ({reader.bag.types[topic]}): {fault}"
        for topic, fault in reader.bag.faults.items()
    ]
    if not left and not right:
        what = "no image that can be read" if faults else "no image"
        raise SourceError(
            f"holds {what}: {'; '.join(faults or topics)}", file=path, remedy="Record it again"
        )
    for fault in faults:
        log.warning("%s: messages are passed over: %s", path, fault)
    pairs = pair_by_stamp(
        [entry.stamp_ns for entry in left],
        [entry.stamp_ns for entry in right],
        round(options.max_skew_ms * 1e6),
    )
    entries = tuple(_entries(pair, left, right) for pair in pairs)
    known = (first or second for first, second in entries)
    names = frame_names(stamp_name(entry.stamp_ns) for entry in known if entry)
    return BagPairs(path, names, topics, entries, options, reader)


def is_bag_folder(path: Path) -> bool:
    """Whether a folder is a ROS 2 bag."""
    return (path / "metadata.yaml").is_file() and any(
        file.suffix in BAG_SUFFIXES for file in path.iterdir()
    )


def _folder_of(path: Path) -> Path:
    """The bag that a compressed file belongs to, whose metadata say how it is compressed."""
    if is_bag_folder(path.parent):
        return path.parent
    raise SourceError(
        "is a compressed part of a bag", file=path, remedy=f"Unpack it: zstd -d {path.name}"
    )


def _entries(
    pair: Pair, left: Sequence[_Entry], right: Sequence[_Entry]
) -> tuple[_Entry | None, _Entry | None]:
    i, j = pair
    return None if i is None else left[i], None if j is None else right[j]
