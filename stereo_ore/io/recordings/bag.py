"""ROS 1 bags, ROS 2 bags (sqlite3 or MCAP) and single MCAP files, read without ROS by the rosbags package."""

from __future__ import annotations

import weakref
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from stereo_ore.config.models import MAX_PIXELS
from stereo_ore.errors import FrameError, MissingExtraError, SourceError, StereoOreError
from stereo_ore.io.recordings import ros_messages
from stereo_ore.io.recordings.images import check_alike, to_8_bit
from stereo_ore.io.recordings.names import frame_names, stamp_name
from stereo_ore.io.recordings.pairing import Pair, pair_by_stamp
from stereo_ore.io.recordings.topics import camera_info_topic, choose_topics, is_rectified
from stereo_ore.types import StereoCalibration, StereoPair

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

BAG_SUFFIXES = (".bag", ".mcap", ".db3")
SKEW_EDGES_MS = (0.0, 0.1, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)


@dataclass(frozen=True)
class BagOptions:
    """What the user may say of a bag: topics of the left and right images, and how far apart their stamps may be."""

    topics: tuple[str, str] | None = None
    max_skew_ms: float = 5.0


class Entry(NamedTuple):
    """One image in a bag: when it was recorded (its place in the bag) and when it was taken."""

    logged_ns: int
    stamp_ns: int


class Reader:
    """A bag that is opened when first used, and anew after it was sent to another process."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._bag: AnyReader | None = None

    def __reduce__(self) -> tuple[type[Reader], tuple[Path]]:
        return Reader, (self.path,)

    @property
    def bag(self) -> AnyReader:
        """The open bag."""
        if self._bag is None:
            self._bag = _open(self.path)
            weakref.finalize(self, self._bag.close)
        return self._bag

    def topics(self, *types: str) -> set[str]:
        """Topics that carry messages of these types."""
        return {connection.topic for connection in self.bag.connections if connection.msgtype in types}

    def messages(
        self, topics: Collection[str], start: int | None = None, stop: int | None = None
    ) -> Iterator[tuple[str, int, Any]]:
        """Topic, time of recording [ns] and message, of some topics, from `start` to before `stop`."""
        connections = [connection for connection in self.bag.connections if connection.topic in topics]
        for connection, logged_ns, data in self.bag.messages(connections, start, stop):
            yield connection.topic, logged_ns, self.bag.deserialize(data, connection.msgtype)

    def entries(self, topics: tuple[str, str]) -> tuple[list[Entry], list[Entry]]:
        """All images of two topics, by stamp; where a driver leaves the stamp empty, the time of recording counts."""
        found: dict[str, list[Entry]] = {topic: [] for topic in topics}
        with _known_faults(self.path):
            for topic, logged_ns, message in self.messages(topics):
                found[topic].append(Entry(logged_ns, ros_messages.stamp_ns(message) or logged_ns))
        left, right = (sorted(found[topic], key=lambda entry: (entry.stamp_ns, entry.logged_ns)) for topic in topics)
        return left, right

    def message(self, topic: str, entry: Entry) -> Any:
        """The message of an entry."""
        for _, logged_ns, message in self.messages([topic], entry.logged_ns, entry.logged_ns + 1):
            if (ros_messages.stamp_ns(message) or logged_ns) == entry.stamp_ns:
                return message
        raise FrameError(f"has lost its message at {entry.logged_ns} ns", code="UNREADABLE_IMAGE", file=self.path)


@dataclass(frozen=True)
class BagPairs:
    """Frames of two messages each, paired and named by stamp; either may be missing."""

    path: Path
    names: tuple[str, ...]
    topics: tuple[str, str]
    entries: tuple[tuple[Entry | None, Entry | None], ...]
    options: BagOptions
    reader: Reader
    calibration: StereoCalibration | None = None
    max_pixels: int = MAX_PIXELS

    @property
    def description(self) -> Mapping[str, Any]:
        """Kind, topics, and how far apart the stamps of the pairs are."""
        skews = [abs(left.stamp_ns - right.stamp_ns) / 1e6 for left, right in self.entries if left and right]
        counts, _ = np.histogram(skews, [*SKEW_EDGES_MS, np.inf])
        return {
            "kind": "bag",
            "frames": len(self.names),
            "unpaired": len(self.names) - len(skews),
            "topics": list(self.topics),
            "max_skew_ms": self.options.max_skew_ms,
            "skew_ms": {"from": list(SKEW_EDGES_MS), "pairs": counts.tolist(), "largest": max(skews, default=None)},
        }

    def files(self, index: int) -> tuple[Path, ...]:
        """The files of the bag."""
        if self.path.is_file():
            return (self.path,)
        return tuple(sorted(file for file in self.path.iterdir() if file.is_file()))

    def read(self, index: int) -> StereoPair:
        """Read both messages of frame `index`."""
        left, right = self.entries[index]
        if left is None or right is None:
            missing = "left" if left is None else "right"
            raise FrameError(
                f"frame {self.names[index]} has no {missing} image within {self.options.max_skew_ms:g} ms",
                code="UNPAIRED",
                file=self.path,
                remedy="Frames are paired by stamp; --max-skew-ms is the limit",
            )
        try:
            messages = self.reader.message(self.topics[0], left), self.reader.message(self.topics[1], right)
            left_image, right_image = (ros_messages.image(message, self.path, self.max_pixels) for message in messages)
        except StereoOreError:
            raise
        except Exception as fault:  # rosbags raises what it likes; messages have the fields that the bag defines
            raise FrameError(f"can't be read here: {fault}", code="UNREADABLE_IMAGE", file=self.path) from None
        check_alike(left_image, right_image, f"{self.path}: {self.topics[0]}", self.topics[1])
        return StereoPair(
            *to_8_bit(left_image, right_image), name=self.names[index], index=index, stamp_ns=left.stamp_ns
        )


def open_bag(path: Path, options: BagOptions) -> BagPairs:
    """Open a bag: find the topics, pair the images by stamp, take the calibration that comes with them.

    Raises
    ------
    MissingExtraError
        Without the rosbags package.
    SourceError
        When it can't be read or holds no recognisable pair of image topics.
    CalibrationError
        When its camera_info describes an impossible camera.
    """
    reader = Reader(path)
    topics = choose_topics(reader.topics(*ros_messages.IMAGE_TYPES), options.topics, path)
    left, right = reader.entries(topics)
    if not left and not right:
        raise SourceError("holds no image", file=path, key=", ".join(topics))
    pairs = pair_by_stamp(
        [entry.stamp_ns for entry in left], [entry.stamp_ns for entry in right], round(options.max_skew_ms * 1e6)
    )
    entries = tuple(_entries(pair, left, right) for pair in pairs)
    names = frame_names(stamp_name((first or second).stamp_ns) for first, second in entries if first or second)  # type: ignore[union-attr]
    return BagPairs(path, names, topics, entries, options, reader, _calibration(reader, topics))


def is_bag_folder(path: Path) -> bool:
    """Whether a folder is a ROS 2 bag."""
    return (path / "metadata.yaml").is_file() and any(file.suffix in BAG_SUFFIXES for file in path.iterdir())


def _entries(pair: Pair, left: Sequence[Entry], right: Sequence[Entry]) -> tuple[Entry | None, Entry | None]:
    i, j = pair
    return None if i is None else left[i], None if j is None else right[j]


def _calibration(reader: Reader, topics: tuple[str, str]) -> StereoCalibration | None:
    """The calibration in the first camera_info of both eyes; None when an eye has none, or it says nothing."""
    if any(camera_info_topic(topic) not in reader.topics(ros_messages.CAMERA_INFO) for topic in topics):
        return None
    with _known_faults(reader.path):
        infos = [_first(reader, camera_info_topic(topic)) for topic in topics]
        if any(info is None or not np.any(ros_messages.matrix(info, "K")) for info in infos):
            return None
        return ros_messages.calibration(infos[0], infos[1], is_rectified(topics[0]), reader.path)


def _first(reader: Reader, topic: str) -> Any:
    """The first message of a topic; None when there is none."""
    return next((message for _, _, message in reader.messages([topic])), None)


def _open(path: Path) -> AnyReader:
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise MissingExtraError("rosbags", "bags") from None
    with _known_faults(path):
        bag = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        bag.open()
    return bag


@contextmanager
def _known_faults(path: Path) -> Iterator[None]:
    """Whatever rosbags and its storages raise on a damaged file, as a SourceError."""
    try:
        yield
    except StereoOreError:
        raise
    except Exception as fault:
        remedy = 'Repair it: "rosbag reindex", "ros2 bag reindex" or "mcap recover"'
        raise SourceError(
            f"can't be read as a bag: {fault or type(fault).__name__}", file=path, remedy=remedy
        ) from None
