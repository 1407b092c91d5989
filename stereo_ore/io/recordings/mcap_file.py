"""MCAP files that were written without ROS 2: messages in protobuf (Foxglove) or in ROS 1's form,
or bare bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import IO, TYPE_CHECKING, Any

from stereo_ore.errors import MissingExtraError, SourceError

if TYPE_CHECKING:
    from mcap.reader import McapReader
    from mcap.records import Channel, Schema

MAGIC = b"\x89MCAP0\r\n"
HEADER = 0x01
Decode = Callable[[bytes], Any]


def profile_of(path: Path) -> str | None:
    """The profile in the header of an MCAP file; None where it is no MCAP."""
    with path.open("rb") as file:
        start = file.read(len(MAGIC) + 1 + 8 + 4 + 64)
    place = len(MAGIC)
    if not start.startswith(MAGIC) or start[place : place + 1] != bytes([HEADER]):
        return None
    length = int.from_bytes(start[place + 9 : place + 13], "little")
    return start[place + 13 : place + 13 + length].decode("utf-8", "replace")


class McapFile:
    """An open MCAP file."""

    def __init__(self, path: Path) -> None:
        try:
            from mcap.reader import make_reader
        except ImportError:
            raise MissingExtraError("mcap", "bags") from None
        self.faults: dict[str, str] = {}
        self._path = path
        self._file: IO[bytes] = path.open("rb")
        try:
            self._reader: McapReader = make_reader(self._file)
            summary = self._reader.get_summary()
            if summary is None:
                raise ValueError("it has no summary at its end")
        except BaseException:
            self.close()
            raise
        self._schemas = summary.schemas
        self.channels = summary.channels
        self._decoders: dict[int, Decode | None] = {}

    @staticmethod
    def reads(path: Path) -> bool:
        """Whether a file is an MCAP that is not ROS 2's."""
        return (
            path.is_file()
            and path.suffix.lower() in (".mcap", ".svo2")
            and profile_of(path) not in (None, "ros2")
        )

    @property
    def types(self) -> dict[str, str]:
        """Type of the messages of each topic that can be read."""
        return {
            channel.topic: _type(self._schemas.get(channel.schema_id))
            for channel in self.channels.values()
            if self._decoder(channel)
        }

    @property
    def unread(self) -> str:
        """Topics whose messages can't be read, and how they are encoded; for a message."""
        others = [channel for channel in self.channels.values() if not self._decoder(channel)]
        kinds = {c.topic: _kind(c, self._schemas.get(c.schema_id)) for c in others}
        return ", ".join(f"{topic} ({kind})" for topic, kind in sorted(kinds.items()))

    def messages(
        self, topics: Collection[str], start: int | None = None, stop: int | None = None
    ) -> Iterator[tuple[str, int, Any]]:
        """See `bag_files.Messages.messages`."""
        for channel, logged_ns, data in self.raw(topics, start, stop):
            if decode := self._decoder(channel):
                try:
                    message = decode(data)
                except Exception as fault:  # the packages raise what they like
                    self.faults[channel.topic] = str(fault) or type(fault).__name__
                    continue
                yield channel.topic, logged_ns, message

    def raw(
        self, topics: Collection[str], start: int | None = None, stop: int | None = None
    ) -> Iterator[tuple[Channel, int, bytes]]:
        """Channel, time of recording [ns] and bytes of the messages of some topics, from `start` to
        before `stop`.
        """
        for _, channel, message in self._reader.iter_messages(
            list(topics), starting_at=start, ending_before=stop
        ):
            yield channel, message.log_time, message.data

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _decoder(self, channel: Channel) -> Decode | None:
        if channel.id not in self._decoders:
            self._decoders[channel.id] = _decoder(
                channel, self._schemas.get(channel.schema_id), self._path
            )
        return self._decoders[channel.id]


def _kind(channel: Channel, schema: Schema | None) -> str:
    return " ".join(filter(None, (channel.message_encoding, schema.name if schema else "")))


def _type(schema: Schema | None) -> str:
    """A type's name as ROS 2 spells it; protobuf's stay."""
    name = schema.name if schema else ""
    package, slash, message = name.partition("/")
    return f"{package}/msg/{message}" if slash and "/" not in message else name


def _decoder(channel: Channel, schema: Schema | None, path: Path) -> Decode | None:
    """What turns the bytes of a channel's messages into objects; None for encodings that are not
    read.
    """
    if schema is None:
        return None
    try:
        match channel.message_encoding, schema.encoding:
            case "protobuf", "protobuf":
                return _protobuf(schema, path)
            case ("ros1" | "cdr") as encoding, ("ros1msg" | "ros2msg"):
                return _ros(schema, encoding)
    except (MissingExtraError, SourceError):
        raise
    except Exception:  # a schema that is none: its packages raise what they like
        return None
    return None


def _ros(schema: Schema, encoding: str) -> Decode:
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError:
        raise MissingExtraError("rosbags", "bags") from None
    store, kind = get_typestore(Stores.EMPTY), _type(schema)
    # Types that a schema only names are those of the distribution.
    store.register(
        get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE).fielddefs
    )
    own = get_types_from_msg(schema.data.decode(), kind)
    store.register({name: fields for name, fields in own.items() if name not in store.fielddefs})
    read = store.deserialize_ros1 if encoding == "ros1" else store.deserialize_cdr
    return lambda data: read(data, kind)


def _protobuf(schema: Schema, path: Path) -> Decode:
    try:
        from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
    except ImportError:
        raise MissingExtraError("protobuf", "bags") from None
    pool = descriptor_pool.DescriptorPool()
    files = {
        file.name: file for file in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file
    }

    def add(name: str) -> None:
        """A file after those that it needs."""
        if file := files.pop(name, None):
            for needed in file.dependency:
                add(needed)
            pool.Add(file)

    for name in tuple(files):
        add(name)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))

    def decode(data: bytes) -> Any:
        message = kind.FromString(data)
        return SimpleNamespace(
            **{field.name: getattr(message, field.name) for field in kind.DESCRIPTOR.fields}
        )

    return decode
