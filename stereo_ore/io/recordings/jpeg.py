"""The structure of a JPEG file: where its picture ends, how it is to be turned, whether it holds
both eyes.

Markers as in ITU-T T.81; turns as in Exif 3.0; pairs as in CIPA DC-007 (multi-picture format) and
in JPEG stereo.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from itertools import pairwise

from stereo_ore.io.recordings.image_header import claimed_size, tiff_tags

SOI, EOI, SCAN = 0xD8, 0xD9, 0xDA
_MARKER = re.compile(rb"\xff[\x01-\xcf\xd8-\xfe]", re.DOTALL)
"""What is neither a stuffed byte, nor a restart, nor filling."""
_EXTRANEOUS = re.compile(rb"Corrupt JPEG data: (\d+) extraneous bytes before marker 0xd9")
_DAMAGE = re.compile(
    rb"Corrupt JPEG data: (?!\d+ extraneous)|Premature end of JPEG|Inconsistent progression"
)
STRAY_BYTES = 64
"""Cameras leave a few bytes, or zeros, behind the last row; damage that shifts the rows leaves
more."""
EXIF, MPF, JPS = (0xE1, b"Exif\0\0"), (0xE2, b"MPF\0"), (0xE3, b"_JPSJPS_")
"""Segments by marker and first bytes."""
MP_ENTRIES, MP_ENTRY_BYTES, MP_THUMBNAIL = 0xB002, 16, 0x010000
ORIENTATION = 0x0112
JPS_SIDE_BY_SIDE, JPS_OVER_UNDER, JPS_LEFT_FIRST = 2, 3, 4


def end_of(data: bytes, start: int = 0) -> int | None:
    """Place behind the end marker of the JPEG that begins at `start`; None where its markers are
    not complete.
    """
    place = start + 2
    while match := _MARKER.search(data, place):
        marker, place = match[0][1], match.end()
        if marker == EOI:
            return place
        if marker > 0x01 and marker != SOI:
            if place + 2 > len(data):
                return None
            place += max(int.from_bytes(data[place : place + 2], "big"), 2)
    return None


def damage(data: bytes, complaints: bytes) -> bool:
    """Whether what libjpeg said of a picture means that rows are missing or shifted.

    Bytes that belong to no marker are passed over by every decoder, with a word; that is no damage.
    """
    stray = max(map(int, _EXTRANEOUS.findall(complaints)), default=0)
    end = end_of(data) or len(data)
    padding = len(set(data[max(end - 2 - stray, 0) : end - 2])) <= 1
    return bool(_DAMAGE.search(complaints)) or (stray > STRAY_BYTES and not padding)


def segments(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Marker, start and end of the content of each segment before the picture."""
    place = 2
    while match := _MARKER.search(data, place):
        marker, place = match[0][1], match.end()
        if marker in (SCAN, EOI) or place + 2 > len(data):
            return
        if marker > 0x01 and marker != SOI:
            end = place + max(int.from_bytes(data[place : place + 2], "big"), 2)
            yield marker, place + 2, min(end, len(data))
            place = end


def orientation(data: bytes) -> int:
    """The turn that Exif asks viewers for: 1 none, 3 half, 6 and 8 a quarter, the others
    mirrored.
    """
    found = _segment(data, EXIF)
    return tiff_tags(data[slice(*found)]).get(ORIENTATION, 1) if found else 1


def jps_packing(data: bytes) -> str | None:
    """How a JPEG stereo file says that it holds both eyes, in the words of `Container.packing`."""
    found = _segment(data, JPS)
    if found is None or found[1] - found[0] < 6:
        return None
    _, flags, layout, media = data[found[0] + 2 : found[0] + 6]
    if media != 1:
        return None
    if layout == JPS_SIDE_BY_SIDE:
        return "left-right" if flags & JPS_LEFT_FIRST else "right-left"
    upper = "left" if flags & JPS_LEFT_FIRST else "right"
    return (
        f"over and under, {upper} eye on top"
        if layout == JPS_OVER_UNDER
        else "rows or colours of either eye"
    )


def pictures(data: bytes) -> tuple[bytes, ...]:
    """The two eyes of a multi-picture file, left eye first; empty where it is no pair.

    Previews and maps of brightness, which phones add, are of another size than the picture.
    """
    found = _segment(data, MPF)
    if found is None:
        return ()
    start, end = found
    entries = tiff_tags(data[start:end], raw=(MP_ENTRIES,)).get(MP_ENTRIES, b"")
    pair = []
    for place, stop in pairwise(range(0, len(entries) + 1, MP_ENTRY_BYTES)):
        order = "<" if data[start : start + 2] == b"II" else ">"
        kind, size, offset = struct.unpack_from(order + "III", entries[place:stop])
        first = start + offset if offset else 0
        picture = data[first : first + size]
        if kind & 0xFF0000 != MP_THUMBNAIL and picture[:2] == b"\xff\xd8":
            pair.append(picture)
    sizes = {claimed_size(picture) for picture in pair}
    return tuple(pair) if len(pair) == 2 and len(sizes) == 1 and None not in sizes else ()


def _segment(data: bytes, kind: tuple[int, bytes]) -> tuple[int, int] | None:
    """Start and end of what follows the signature of the first segment of a kind."""
    marker, signature = kind
    for found, start, end in segments(data):
        if found == marker and data.startswith(signature, start):
            return start + len(signature), end
    return None
