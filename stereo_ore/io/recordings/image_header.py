"""How large a picture an image file claims to hold, read from its header before anything is decoded."""

from __future__ import annotations

import struct
from collections.abc import Callable

JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers that begin with the picture's size (SOF)."""
JPEG_BARE = frozenset((0x01, *range(0xD0, 0xD8)))
"""Markers without a length."""
TIFF_TYPES = {1: "B", 3: "H", 4: "I", 16: "Q"}
TIFF_WIDTH, TIFF_HEIGHT = 256, 257
MOST_TAGS = 4096


def claimed_size(data: bytes) -> tuple[int, int] | None:
    """Width and height that a PNG, JPEG, TIFF or BMP claims; None for anything else, and for a header that is none."""
    for magic, read in _READERS.items():
        if data.startswith(magic):
            try:
                return read(data)
            except (struct.error, OverflowError):
                return None
    return None


def _png(data: bytes) -> tuple[int, int] | None:
    """The size in a PNG all of whose chunks are there: OpenCV allocates what the length of a chunk claims."""
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
    order = "<" if data[:2] == b"II" else ">"
    big = struct.unpack_from(order + "H", data, 2)[0] == 43
    (start,) = struct.unpack_from(order + ("Q" if big else "I"), data, 8 if big else 4)
    (count,) = struct.unpack_from(order + ("Q" if big else "H"), data, start)
    entry, first, value = (20, start + 8, 12) if big else (12, start + 2, 8)
    found: dict[int, int] = {}
    for place in range(first, first + entry * min(count, MOST_TAGS), entry):
        tag, kind = struct.unpack_from(order + "HH", data, place)
        if tag in (TIFF_WIDTH, TIFF_HEIGHT) and kind in TIFF_TYPES:
            found.setdefault(tag, struct.unpack_from(order + TIFF_TYPES[kind], data, place + value)[0])
    return (found[TIFF_WIDTH], found[TIFF_HEIGHT]) if len(found) == 2 else None


_READERS: dict[bytes, Callable[[bytes], tuple[int, int] | None]] = {
    b"\x89PNG\r\n\x1a\n": _png,
    b"\xff\xd8": _jpeg,
    b"II*\0": _tiff,
    b"MM\0*": _tiff,
    b"II+\0": _tiff,
    b"MM\0+": _tiff,
    b"BM": _bmp,
}
