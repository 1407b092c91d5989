"""What a video file says of itself: how its pictures hold both eyes, how many tracks it has, when
it began.

OpenCV hands on none of it. Matroska and WebM (RFC 9559) and MP4 and MOV (ISO/IEC 14496-12) are
read; of other containers nothing is known.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO

MATROSKA_MODES = {
    1: "left-right",
    2: "over and under, right eye on top",
    3: "over and under, left eye on top",
    **dict.fromkeys((4, 5), "a checkerboard of both eyes"),
    **dict.fromkeys((6, 7), "rows of either eye by turns"),
    **dict.fromkeys((8, 9), "columns of either eye by turns"),
    **dict.fromkeys((10, 12), "an anaglyph"),
    11: "right-left",
    **dict.fromkeys((13, 14), "one eye after the other"),
}
"""Matroska's StereoMode."""
MP4_MODES = {1: "over and under, left eye on top", 2: "left-right", 4: "right-left"}
"""Stereo mode of the box ``st3d`` (Spherical Video V2)."""
LAYERS = "an eye a layer (a spatial video, MV-HEVC), of which decoders give one"
_LAYERED = (b"lhvC", b"vexu")
"""Boxes of a sample entry whose pictures have layers: their parameter sets, and Apple's words about
the eyes.
"""
MATROSKA_EPOCH_NS = int(datetime(2001, 1, 1, tzinfo=UTC).timestamp()) * 10**9
MP4_EPOCH_S = -int(datetime(1904, 1, 1, tzinfo=UTC).timestamp())
MOST_PARTS = 10_000
"""A header of more elements or boxes is not searched further."""


@dataclass(frozen=True)
class Container:
    """What is said.

    Attributes
    ----------
    packing
        "left-right", "right-left", or words for another arrangement of the eyes; None: nothing.
    video_tracks
        Number of video tracks; 1 where it is not known.
    began_ns
        When the recording began [ns since 1970, UTC]; None: not said.
    """

    packing: str | None = None
    video_tracks: int = 1
    began_ns: int | None = None


def read_container(path: Path) -> Container:
    """What the container says of itself; of a damaged one nothing."""
    try:
        with path.open("rb") as file:
            magic = file.read(12)
            if magic.startswith(b"\x1a\x45\xdf\xa3"):
                return _matroska(file)
            if magic[4:8] in (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip"):
                return _mp4(file)
    except (OSError, struct.error, ValueError, OverflowError, IndexError):
        pass  # decoding will tell what is wrong with it
    return Container()


# --- Matroska

_SEGMENT, _INFO, _DATE, _TRACKS, _CLUSTER = 0x18538067, 0x1549A966, 0x4461, 0x1654AE6B, 0x1F43B675
_TRACK, _TYPE, _VIDEO, _MODE = 0xAE, 0x83, 0xE0, 0x53B8


def _matroska(file: BinaryIO) -> Container:
    packing, tracks, began_ns = None, 0, None
    for kind, start, end in _elements(
        file, 0, os.fstat(file.fileno()).st_size, (_SEGMENT, _INFO, _TRACKS)
    ):
        if kind == _DATE:
            began_ns = MATROSKA_EPOCH_NS + int.from_bytes(
                _part(file, start, end), "big", signed=True
            )
        elif kind == _TRACK:
            inner = {
                k: _part(file, s, e)
                for k, s, e in _elements(file, start, end, (_VIDEO,))
                if k in (_TYPE, _MODE)
            }
            if int.from_bytes(inner.get(_TYPE, b""), "big") == 1:
                tracks += 1
                packing = packing or MATROSKA_MODES.get(
                    int.from_bytes(inner.get(_MODE, b""), "big")
                )
        elif kind == _CLUSTER:
            break
    return Container(packing, tracks or 1, began_ns)


def _elements(
    file: BinaryIO, start: int, end: int, inside: tuple[int, ...]
) -> Iterator[tuple[int, int, int]]:
    """Id, start and end of the elements from `start` to `end`, those in `inside` replaced by what
    is in them.
    """
    for _ in range(MOST_PARTS):
        if start >= end:
            return
        file.seek(start)
        head = file.read(12)
        id_length, size_length = _length(head, 0), 0
        if id_length and len(head) > id_length:
            size_length = _length(head, id_length)
        if not id_length or not size_length:
            return
        kind = int.from_bytes(head[:id_length], "big")
        size = (
            int.from_bytes(head[id_length : id_length + size_length], "big")
            & (1 << 7 * size_length) - 1
        )
        start += id_length + size_length
        unknown = size == (1 << 7 * size_length) - 1
        if kind in inside:
            yield from _elements(file, start, end if unknown else min(end, start + size), inside)
        else:
            yield kind, start, min(end, start + size)
        if unknown:
            return
        start += size


def _length(head: bytes, place: int) -> int:
    """Bytes of the number of variable length at `place`, which its leading zeros tell; 0 where it
    is none.
    """
    return 0 if place >= len(head) or head[place] == 0 else 9 - head[place].bit_length()


# --- MP4

_NESTED = (b"moov", b"trak", b"mdia", b"minf", b"stbl")
SAMPLE_ENTRY_BYTES = 78
"""What stands in a visual sample entry before its boxes."""


def _mp4(file: BinaryIO) -> Container:
    packing, tracks, began_ns = None, 0, None
    for kind, start, end in _boxes(file, 0, os.fstat(file.fileno()).st_size):
        if kind == b"mvhd":
            began_ns = _created_ns(_part(file, start, end))
        elif kind == b"hdlr":
            tracks += _part(file, start, end)[8:12] == b"vide"
        elif kind == b"stsd":
            for _, first, last in _boxes(file, start + 8, end):
                for name, inner, stop in _boxes(file, first + SAMPLE_ENTRY_BYTES, last):
                    if name in _LAYERED:
                        packing = LAYERS
                    elif name == b"st3d":
                        packing = packing or MP4_MODES.get(_part(file, inner, stop)[4])
    return Container(packing, tracks or 1, began_ns)


def _created_ns(mvhd: bytes) -> int | None:
    """The creation time of a movie header; None where it was left at zero."""
    (seconds,) = struct.unpack_from(">Q" if mvhd[0] == 1 else ">I", mvhd, 4)
    return int(seconds - MP4_EPOCH_S) * 10**9 if seconds > MP4_EPOCH_S else None


def _boxes(file: BinaryIO, start: int, end: int) -> Iterator[tuple[bytes, int, int]]:
    """Type, start and end of the boxes from `start` to `end`, those of `_NESTED` replaced by what
    is in them.
    """
    for _ in range(MOST_PARTS):
        if start + 8 > end:
            return
        file.seek(start)
        head = file.read(16)
        size, kind = struct.unpack_from(">I4s", head)
        body = start + 8
        if size == 1:
            (size,), body = struct.unpack_from(">Q", head, 8), start + 16
        stop = end if size == 0 else min(end, start + size)
        if stop < body:
            return
        if kind in _NESTED:
            yield from _boxes(file, body, stop)
        else:
            yield kind, body, stop
        start = stop


def _part(file: BinaryIO, start: int, end: int) -> bytes:
    file.seek(start)
    return file.read(min(end - start, 4096))
