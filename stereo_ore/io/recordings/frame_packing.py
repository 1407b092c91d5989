"""How a picture of H.264 or H.265 holds both eyes, from its frame packing arrangement message.

Rec. ITU-T H.264 D.1.26, H.265 D.2.16 (payload type 45).
"""

from __future__ import annotations

from collections.abc import Iterator

ARRANGEMENTS = (
    "a checkerboard of both eyes",
    "columns of either eye by turns",
    "rows of either eye by turns",
    "side by side",
    "over and under",
    "one eye after the other",
)
FRAME_PACKING = 45
RIGHT_FIRST = 2
"""Content interpretation type: the first constituent frame is the right eye."""
_START_CODE = b"\x00\x00\x01"
_HEADER_BYTES = {0x06: 1, 0x4E: 2}
"""Length of the unit's header by its first byte: messages (SEI) of H.264, and of H.265 before the
picture."""


def packing_of(access_unit: bytes) -> str | None:
    """As `Container.packing`, of one access unit in Annex B form; None where it says nothing."""
    for unit in access_unit.split(_START_CODE)[1:]:
        header = _HEADER_BYTES.get(unit[0] & 0x7F if unit else -1)
        if header:
            for kind, payload in _messages(unit[header:].replace(b"\x00\x00\x03", b"\x00\x00")):
                if kind == FRAME_PACKING and payload:
                    return _arrangement(payload)
    return None


def _messages(data: bytes) -> Iterator[tuple[int, bytes]]:
    place = 0
    while place + 2 <= len(data):
        numbers = []
        for _ in range(2):
            number = 0
            while place < len(data) and data[place] == 0xFF:
                number, place = number + 255, place + 1
            if place >= len(data):
                return
            number, place = number + data[place], place + 1
            numbers.append(number)
        yield numbers[0], data[place : place + numbers[1]]
        place += numbers[1]


def _arrangement(payload: bytes) -> str | None:
    """arrangement_id ue(v), cancel_flag u(1), type u(7), quincunx u(1), content_interpretation_type
    u(6).
    """
    bits = "".join(f"{byte:08b}" for byte in payload[:16])
    place = 2 * (len(bits) - len(bits.lstrip("0"))) + 1
    fields = bits[place : place + 15]
    if len(fields) < 15 or fields[0] == "1":
        return None
    kind, interpretation = int(fields[1:8], 2), int(fields[9:15], 2)
    if kind >= len(ARRANGEMENTS) or interpretation not in (1, RIGHT_FIRST):
        return None
    if ARRANGEMENTS[kind] == "side by side":
        return "right-left" if interpretation == RIGHT_FIRST else "left-right"
    if ARRANGEMENTS[kind] == "over and under":
        return f"over and under, {'right' if interpretation == RIGHT_FIRST else 'left'} eye on top"
    return ARRANGEMENTS[kind]
