"""Recordings of ZED cameras (SVO2), read without Stereolabs' software.

An SVO2 file is an MCAP container. Its channel ``Camera_SN<serial>/side_by_side`` has a message a
frame: an access unit of H.264 or H.265 with both eyes beside each other, and a footer of 56 bytes
behind it.
"""

from __future__ import annotations

import re
import struct
import weakref
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from stereo_ore.config.models import MAX_PIXELS
from stereo_ore.errors import FrameError, SourceError
from stereo_ore.io.recordings.access_units import UnitDecoder, is_key
from stereo_ore.io.recordings.bag_files import known_faults
from stereo_ore.io.recordings.base import make_pair
from stereo_ore.io.recordings.both_eyes import check_eye_size
from stereo_ore.io.recordings.images import split_in_two, to_8_bit
from stereo_ore.io.recordings.mcap_file import McapFile
from stereo_ore.io.recordings.names import frame_names, stamp_name
from stereo_ore.io.recordings.stamps import Stamp
from stereo_ore.types import StereoCalibration, StereoPair

SVO1_MAGIC = b"\xf5\xff\xff\xff"
CHANNEL = re.compile(r"(?:.*/)?Camera_SN(?P<serial>\d+)/side_by_side")
FOOTER = struct.Struct("<iiIiiiQ24x")
"""Width, height, magic, 1, 2, −1, time [ns]; then sizes and numbers of frames that are not needed
here."""
FOOTER_MAGIC = 0x5C002C00
FACTORY_CALIBRATION = (
    "SN{serial}.conf, from /usr/local/zed/settings where it was recorded or"
    " https://calib.stereolabs.com"
)


class _Unit(NamedTuple):
    """One frame in the file: when it was recorded (its place), when it was taken [ns], whether
    decoding can begin.
    """

    logged_ns: int
    stamp_ns: int
    key: bool


class SvoFile:
    """An SVO2 file, opened when first used, and anew after it was sent to another process."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file: McapFile | None = None
        self._decoder: UnitDecoder | None = None

    def __reduce__(self) -> tuple[type[SvoFile], tuple[Path]]:
        return SvoFile, (self.path,)

    @property
    def file(self) -> McapFile:
        """The open container."""
        if self._file is None:
            with known_faults(self.path):
                self._file = McapFile(self.path)
            weakref.finalize(self, self._file.close)
        return self._file

    def channel(self) -> tuple[str, str]:
        """Topic of the images and serial number of the camera."""
        for channel in self.file.channels.values():
            if match := CHANNEL.fullmatch(channel.topic):
                return channel.topic, match["serial"]
        topics = (
            ", ".join(sorted(channel.topic for channel in self.file.channels.values())) or "none"
        )
        raise SourceError(
            f"holds no images of both eyes; channels: {topics}",
            file=self.path,
            remedy="Record it again",
        )

    def units(self) -> tuple[_Unit, ...]:
        """All frames, in the order in which they were recorded."""
        topic, _ = self.channel()
        with known_faults(self.path):
            return tuple(
                _Unit(logged_ns, _stamp(data) or logged_ns, is_key(data))
                for _, logged_ns, data in self.file.raw([topic])
                if len(data) > FOOTER.size
            )

    def decoder(self, units: tuple[_Unit, ...]) -> UnitDecoder:
        """The decoder of the frames."""
        if self._decoder is None:
            topic, _ = self.channel()

            def unit(index: int) -> bytes:
                start = units[index].logged_ns
                for _, _, data in self.file.raw([topic], start, start + 1):
                    return data[: -FOOTER.size] if _stamp(data) else data
                raise FrameError(
                    f"has lost its frame at {start} ns", code="UNREADABLE_IMAGE", file=self.path
                )

            self._decoder = UnitDecoder(self.path, [each.key for each in units], unit)
        return self._decoder


def _stamp(data: bytes) -> int:
    """The time in a message's footer [ns]; 0 where there is no footer."""
    if len(data) < FOOTER.size:
        return 0
    _, _, magic, *_, stamp_ns = FOOTER.unpack(data[-FOOTER.size :])
    return int(stamp_ns) if magic == FOOTER_MAGIC and stamp_ns < 2**63 else 0


@dataclass(frozen=True)
class SvoFrames:
    """Frames of an SVO2 file, named by stamp; `eye_size` (width, height) [px] is that of the
    calibration.
    """

    path: Path
    names: tuple[str, ...]
    serial: str
    units: tuple[_Unit, ...]
    file: SvoFile
    max_pixels: int = MAX_PIXELS
    eye_size: tuple[int, int] | None = None

    @property
    def description(self) -> Mapping[str, Any]:
        """Kind, camera and number of frames."""
        return {"kind": "SVO2", "frames": len(self.names), "camera": f"SN{self.serial}"}

    @property
    def calibration(self) -> StereoCalibration | None:
        """None ever comes: the file holds none, and the error says where it is to be had."""
        remedy = (
            "Give its factory calibration with --calib:"
            f" {FACTORY_CALIBRATION.format(serial=self.serial)}"
        )
        raise SourceError("carries no calibration", file=self.path, remedy=remedy)

    @property
    def notes(self) -> tuple[str, ...]:
        """What the file does not say."""
        return ("calibrate check tells whether its images are rectified",)

    def files(self, index: int) -> tuple[Path, ...]:
        """The file."""
        return (self.path,)

    def stamp(self, index: int) -> Stamp | None:
        """When the camera took the frame."""
        return Stamp(self.units[index].stamp_ns, "header")

    def read(self, index: int) -> StereoPair:
        """Decode frame `index` and split it in the middle."""
        image = self.file.decoder(self.units).picture(index, self.max_pixels)
        left, right = split_in_two(image, self.path)
        check_eye_size(left, self.eye_size, self.path)
        return make_pair(self, index, *to_8_bit(left, right))


def open_svo(path: Path) -> SvoFrames:
    """Open a recording of a ZED camera.

    Raises
    ------
    MissingExtraError
        Without the packages mcap and av.
    SourceError
        When it is of version 1, which only Stereolabs' software reads, or damaged.
    """
    with path.open("rb") as file:
        magic = file.read(8)
    if magic[:4] == SVO1_MAGIC or not magic.startswith(b"\x89MCAP"):
        raise SourceError(
            "is an SVO recording of version 1, which only Stereolabs' own software reads",
            file=path,
            remedy=(
                f"Export it where the ZED SDK is: ZED_SVO_Export {path.name} FOLDER 2; then run on"
                " the folder"
            ),
        )
    recording = SvoFile(path)
    _, serial = recording.channel()
    units = recording.units()
    if not units:
        raise SourceError("holds no frame", file=path, remedy="Record it again")
    names = frame_names(stamp_name(unit.stamp_ns) for unit in units)
    return SvoFrames(path, names, serial, units, recording)
