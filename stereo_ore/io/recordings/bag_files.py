"""Messages of bags: ROS 1, ROS 2 (sqlite3, MCAP, compressed or not) by rosbags, other MCAP files by
mcap.

Both readers offer the same: topics with the types of their messages, and the messages from one time
to another.
"""

from __future__ import annotations

import logging
import shutil
import sqlite3
import struct
import tempfile
import weakref
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from stereo_ore.errors import MissingExtraError, SourceError, StereoOreError
from stereo_ore.io.recordings.mcap_file import McapFile

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

_log = logging.getLogger(__name__)

BAG_SUFFIXES = (".bag", ".mcap", ".db3", ".zstd")
ROS1_IMAGE = "sensor_msgs/msg/Image"


class Messages(Protocol):
    """An open bag; `faults` tells of each topic why messages of it could not be read, and were
    passed over.
    """

    faults: dict[str, str]

    @property
    def types(self) -> dict[str, str]:
        """Type of the messages of each topic."""
        ...

    def messages(
        self, topics: Collection[str], start: int | None = None, stop: int | None = None
    ) -> Iterator[tuple[str, int, Any]]:
        """Topic, time of recording [ns] and message, of some topics, from `start` to before
        `stop`.
        """
        ...

    def close(self) -> None:
        """Close its files."""
        ...


class RosBag:
    """A bag that rosbags reads."""

    def __init__(self, path: Path) -> None:
        folder = _checkpointed(path)
        if folder:
            weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
            path = folder if path.is_dir() else folder / path.name
        self._bag = _open_ros(path)
        self.faults: dict[str, str] = {}
        self.types = {connection.topic: connection.msgtype for connection in self._bag.connections}

    def messages(
        self, topics: Collection[str], start: int | None = None, stop: int | None = None
    ) -> Iterator[tuple[str, int, Any]]:
        """See `Messages.messages`."""
        connections = [
            connection for connection in self._bag.connections if connection.topic in topics
        ]
        for connection, logged_ns, data in self._bag.messages(connections, start, stop):
            try:
                message = self._read(data, connection.msgtype)
            except Exception as fault:  # rosbags raises what it likes
                self.faults[connection.topic] = str(fault) or type(fault).__name__
                continue
            yield connection.topic, logged_ns, message

    def close(self) -> None:
        """Close its files."""
        self._bag.close()

    def _read(self, data: bytes, kind: str) -> Any:
        """A message; librealsense writes ROS 1 images with four bytes too many, which are left
        out.
        """
        if kind == ROS1_IMAGE and not self._bag.is2:
            data = data[: _image_length(data)]
        return self._bag.deserialize(data, kind)


def _image_length(data: bytes) -> int:
    """Bytes of a ROS 1 image: seq, stamp, frame_id, height, width, encoding, is_bigendian, step,
    data.
    """
    place = 12
    try:
        for skip in (8, 5, 0):
            place += 4 + struct.unpack_from("<I", data, place)[0] + skip
    except struct.error:
        return len(data)
    return place


def open_messages(path: Path) -> Messages:
    """Open a bag file or folder.

    Raises
    ------
    MissingExtraError
        Without the package that reads it.
    SourceError
        When it is damaged or of no known kind.
    """
    with known_faults(path):
        if McapFile.reads(path):
            return McapFile(path)
        return RosBag(path)


@contextmanager
def known_faults(path: Path) -> Iterator[None]:
    """Whatever the readers and their storages raise on a damaged file, as a SourceError."""
    try:
        yield
    except StereoOreError:
        raise
    except Exception as fault:
        raise SourceError(
            f"can't be read as a bag: {fault or type(fault).__name__}",
            file=path,
            remedy=_remedy(path),
        ) from None


def _remedy(path: Path) -> str:
    repairs = {
        ".bag": "rosbag reindex FILE",
        ".mcap": "mcap recover FILE",
        ".db3": "ros2 bag reindex FOLDER",
    }
    repair = repairs.get(path.suffix.lower(), "ros2 bag reindex FOLDER")
    return f"If it was cut off while recording, repair it: {repair}; otherwise copy it again"


def _open_ros(path: Path) -> AnyReader:
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise MissingExtraError("rosbags", "bags") from None
    bag = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
    bag.open()
    return bag


def _checkpointed(path: Path) -> Path | None:
    """A folder with a copy of a ROS 2 bag whose write-ahead log is written into its database; None
    where it has none.

    rosbags does not see such a log, and to write it into the database would change the recording.
    """
    files = [path] if path.is_file() else sorted(path.iterdir())
    logs = {file.name for file in files if _log_of(file).is_file() and _log_of(file).stat().st_size}
    if path.suffix == ".bag" or not logs:
        return None
    folder = Path(tempfile.mkdtemp(prefix="stereo-ore-bag-"))
    _log.info(
        "%s has a write-ahead log (%s-wal): read with it from a copy", path, ", ".join(sorted(logs))
    )
    for file in files:
        if file.name in logs:
            shutil.copyfile(file, folder / file.name)
            shutil.copyfile(_log_of(file), _log_of(folder / file.name))
            database = sqlite3.connect(folder / file.name)
            try:
                database.execute("pragma wal_checkpoint(truncate)")
                database.execute("pragma journal_mode=delete")
            finally:
                database.close()
        elif file.is_file() and not file.name.endswith(("-wal", "-shm")):
            (folder / file.name).symlink_to(file.resolve())
    return folder


def _log_of(file: Path) -> Path:
    return file.with_name(f"{file.name}-wal")
