"""How large a picture an image file claims to hold, read from its header before anything is
decoded.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Collection
from typing import Any, NamedTuple

JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers that begin with the picture's size (SOF)."""
JPEG_BARE = frozenset((0x01, *range(0xD0, 0xD8)))
"""Markers without a length."""
TIFF_TYPES = {1: "B", 3: "H", 4: "I", 16: "Q"}
TIFF_SUBFILE, TIFF_WIDTH, TIFF_HEIGHT = 254, 256, 257
NO_PICTURE = 0b101
"""Bits of the subfile type: a smaller copy, a mask."""
MOST_TAGS, MOST_PAGES = 4096, 10_000
_BLANK = rb"(?:\s|#[^\n]*\n)+"
_NETPBM = re.compile(
    rb"P[56]"
    + _BLANK
    + rb"(?P<width>\d{1,9})"
    + _BLANK
    + rb"(?P<height>\d{1,9})"
    + _BLANK
    + rb"(?P<largest>\d{1,5})\s"
)


def claimed_size(data: bytes) -> tuple[int, int] | None:
    """Width and height that a picture in a format that is read claims; None for anything else."""
    for magic, read in _READERS.items():
        if data.startswith(magic):
            try:
                return read(data)
            except (struct.error, OverflowError):
                return None
    return None


def _png(data: bytes) -> tuple[int, int] | None:
    """The size in a PNG all of whose chunks are there: OpenCV allocates what the length of a chunk
    claims.
    """
    place, kind = 8, b""
    while kind != b"IEND":
        length, kind = struct.unpack_from(">I4s", data, place)
        place += 12 + length
        if place > len(data):
            return None
    width, height = struct.unpack_from(">II", data, 16)
    return (width, height) if data[12:16] == b"IHDR" else None


def _bmp(data: bytes) -> tuple[int, int]:
    (header,) = struct.unpack_from("<I", data, 14)
    width, height = struct.unpack_from("<HH" if header == 12 else "<ii", data, 18)
    return abs(width), abs(height)


def _jpeg(data: bytes) -> tuple[int, int] | None:
    """The size in the first frame header, found as decoders find it: from marker to marker."""
    place = 2
    while (place := data.find(b"\xff", place)) >= 0:
        while data[place : place + 1] == b"\xff":
            place += 1
        marker = struct.unpack_from("B", data, place)[0]
        place += 1
        if marker in JPEG_FRAMES:
            height, width = struct.unpack_from(">HH", data, place + 3)
            return width, height
        if marker and marker not in JPEG_BARE:
            place += max(struct.unpack_from(">H", data, place)[0], 2)
    return None


def _tiff(data: bytes) -> tuple[int, int] | None:
    """The size in the first directory of a TIFF or BigTIFF."""
    found = tiff_tags(data)
    return (
        (found[TIFF_WIDTH], found[TIFF_HEIGHT])
        if TIFF_WIDTH in found and TIFF_HEIGHT in found
        else None
    )


def tiff_pages(data: bytes) -> int:
    """Number of pictures in a TIFF, smaller copies and masks left out; those before damage, where
    it is damaged.
    """
    pages, start, seen = 0, None, set[int]()
    try:
        while start != 0 and (directory := _directory(data, start)) and directory.start not in seen:
            seen.add(directory.start)
            pages += not _tags(data, directory).get(TIFF_SUBFILE, 0) & NO_PICTURE
            start = directory.following if len(seen) < MOST_PAGES else 0
    except (struct.error, OverflowError):
        pass
    return pages


def tiff_tags(data: bytes, raw: Collection[int] = ()) -> dict[int, Any]:
    """First value of each whole-numbered tag in the first directory; of the tags in `raw` their
    bytes.

    Empty where the directory is damaged.
    """
    try:
        directory = _directory(data, None)
        return _tags(data, directory, raw) if directory else {}
    except (struct.error, OverflowError):
        return {}


class _Directory(NamedTuple):
    """A directory of a TIFF: byte order, whether it is a BigTIFF, where it is, how many entries,
    where the next is.
    """

    order: str
    big: bool
    start: int
    entries: int
    following: int


def _directory(data: bytes, start: int | None) -> _Directory | None:
    """The directory at `start`, the first for None."""
    order = {b"II": "<", b"MM": ">"}.get(data[:2])
    if order is None:
        return None
    big = struct.unpack_from(order + "H", data, 2)[0] == 43
    number, entry, head = (order + "Q", 20, 8) if big else (order + "I", 12, 2)
    if start is None:
        (start,) = struct.unpack_from(number, data, 8 if big else 4)
    (count,) = struct.unpack_from(order + ("Q" if big else "H"), data, start)
    end = start + head + entry * count
    following = (
        struct.unpack_from(number, data, end)[0]
        if end + struct.calcsize(number) <= len(data)
        else 0
    )
    return _Directory(order, big, start, count, following)


def _tags(data: bytes, directory: _Directory, raw: Collection[int] = ()) -> dict[int, Any]:
    order, big, start, entries, _ = directory
    entry, first, value = (20, start + 8, 12) if big else (12, start + 2, 8)
    found: dict[int, Any] = {}
    for place in range(first, first + entry * min(entries, MOST_TAGS), entry):
        tag, kind = struct.unpack_from(order + "HH", data, place)
        if tag in raw:
            (size,), (where,) = (
                struct.unpack_from(order + "I", data, place + shift) for shift in (4, 8)
            )
            found.setdefault(
                tag, data[place + 8 : place + 8 + size] if size <= 4 else data[where : where + size]
            )
        elif kind in TIFF_TYPES:
            found.setdefault(
                tag, struct.unpack_from(order + TIFF_TYPES[kind], data, place + value)[0]
            )
    return found


def _webp(data: bytes) -> tuple[int, int] | None:
    """The size in a WebP (RFC 9649) that is all there."""
    (size,) = struct.unpack_from("<I", data, 4)
    if data[8:12] != b"WEBP" or size + 8 > len(data):
        return None
    kind = data[12:16]
    if kind == b"VP8 ":
        width, height = struct.unpack_from("<HH", data, 26)
        return width & 0x3FFF, height & 0x3FFF
    if kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", data, 21)
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if kind == b"VP8X":
        return 1 + int.from_bytes(data[24:27], "little"), 1 + int.from_bytes(data[27:30], "little")
    return None


def _netpbm(data: bytes) -> tuple[int, int] | None:
    """The size in a binary PGM or PPM that is all there."""
    match = _NETPBM.match(data)
    if match is None:
        return None
    width, height, largest = (int(match[name]) for name in ("width", "height", "largest"))
    samples = width * height * (3 if data[:2] == b"P6" else 1)
    return (
        (width, height)
        if match.end() + samples * (1 if largest < 256 else 2) <= len(data)
        else None
    )


_READERS: dict[bytes, Callable[[bytes], tuple[int, int] | None]] = {
    b"\x89PNG\r\n\x1a\n": _png,
    b"\xff\xd8": _jpeg,
    b"II*\0": _tiff,
    b"MM\0*": _tiff,
    b"II+\0": _tiff,
    b"MM\0+": _tiff,
    b"BM": _bmp,
    b"RIFF": _webp,
    b"P5": _netpbm,
    b"P6": _netpbm,
}
