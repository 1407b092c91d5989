"""The Modbus table of registers: which there are, and what they hold for a message.

Everything can be read with function 3 (holding registers) and 4 (input registers). Numbers of more
than one register have the high word first ("ABCD", big endian), reals are IEEE 754 of 32 bits, and
what is unknown is NaN.

`SEQUENCE` stands before the targets and again behind them, and its low word in every slot: a set
that was read in several requests is whole when all are equal. A single request is never torn.
"""

from __future__ import annotations

import math
import struct
import time
import zlib
from dataclasses import dataclass

from stereo_ore.plant.sinks.message import Message, Target

_VERSION = 1
MODBUS_SLOTS, SLOT_WORDS, HEAD_WORDS = 16, 32, 16
END = HEAD_WORDS + MODBUS_SLOTS * SLOT_WORDS
READABLE_WORDS = END + 2
ACKNOWLEDGEMENT, ACKNOWLEDGEMENT_WORDS = 600, 3

STATUSES = ("starting", "ok", "degraded", "empty", "failed", "expired", "stopped")
"""By their number in the table."""
_NAN = float("nan")
LARGEST_FLOAT32 = 3.4028234e38
_UNKNOWN, NOT_OVERSIZE, _OVERSIZE = 0, 1, 2


@dataclass(frozen=True)
class Register:
    """An entry of the table: address from 0, `struct` code of its type, name, unit and meaning."""

    address: int
    code: str
    name: str
    unit: str
    text: str


HEAD = (
    Register(0, "H", "version", "", f"layout of this table: {_VERSION}"),
    Register(1, "H", "heartbeat", "", "counts up twice a second while the program lives"),
    Register(2, "I", "sequence", "", "number of the message; first written"),
    Register(4, "H", "valid", "", "1 while targets may be struck, else 0"),
    Register(
        5, "H", "remaining", "ms", "for how long they may be struck, counted down as it is read"
    ),
    Register(6, "H", "count", "", "slots in use, best target first"),
    Register(
        7, "H", "status", "", ", ".join(f"{number} {name}" for number, name in enumerate(STATUSES))
    ),
    Register(8, "i", "frame_index", "", "number of the frame; -1: none"),
    Register(10, "H", "replay", "", "1: a recording, not the camera"),
    Register(
        11, "H", "session", "", "changes with every start of the program, when sequence begins anew"
    ),
)
SLOT = (
    Register(0, "H", "sequence_low", "", "low word of sequence; 0 in a slot that is not in use"),
    Register(1, "H", "id", "", "ore id in the frame; 0: slot not in use"),
    Register(2, "H", "oversize", "", "2 yes, 1 no, 0 unknown"),
    Register(4, "f", "position_x", "m", "strike point in the arm frame"),
    Register(6, "f", "position_y", "m", ""),
    Register(8, "f", "position_z", "m", ""),
    Register(10, "f", "direction_x", "", "unit vector the tool moves along, arm frame"),
    Register(12, "f", "direction_y", "", ""),
    Register(14, "f", "direction_z", "", ""),
    Register(16, "f", "size_longest", "m", "dimensions of the lump"),
    Register(18, "f", "size_middle", "m", ""),
    Register(20, "f", "size_shortest", "m", ""),
    Register(22, "f", "volume", "m³", "volume of the lump"),
    Register(
        24,
        "f",
        "sigma_x",
        "m",
        "standard deviations of its centre of gravity along the camera's axes",
    ),
    Register(26, "f", "sigma_y", "m", ""),
    Register(28, "f", "sigma_z", "m", ""),
    Register(30, "f", "score", "", "quality of the strike"),
)
"""Addresses from the beginning of a slot."""
TAIL = (Register(END, "I", "sequence", "", "number of the message; last written"),)
WRITABLE = (
    Register(
        ACKNOWLEDGEMENT, "I", "acknowledged_sequence", "", "arm: sequence of the message in use"
    ),
    Register(
        ACKNOWLEDGEMENT + 2, "H", "acknowledged_target", "", "arm: id of the target being struck"
    ),
)


def words(message: Message, heartbeat: int) -> list[int]:
    """The readable registers, as they may be read now: without the targets once they have
    expired.
    """
    message = message.current()
    remaining_s = message.deadline - time.monotonic() if message.valid else 0.0
    data = bytearray(2 * READABLE_WORDS)
    head = (
        _VERSION,
        heartbeat % 2**16,
        message.sequence % 2**32,
        message.valid,
        min(2**16 - 1, int(1000 * max(0.0, remaining_s))),
        len(message.targets[:MODBUS_SLOTS]),
        STATUSES.index(message.status),
        -1 if message.index is None else min(message.index, 2**31 - 1),
        message.origin.replay,
        zlib.crc32(message.origin.session.encode()) % 2**16,
    )
    _put(data, 0, HEAD, head)
    for slot in range(MODBUS_SLOTS):
        target = message.targets[slot] if slot < len(message.targets) else None
        _put(data, HEAD_WORDS + slot * SLOT_WORDS, SLOT, _slot(target, message.sequence))
    _put(data, 0, TAIL, (message.sequence % 2**32,))
    return list(struct.unpack(f">{READABLE_WORDS}H", data))


def acknowledged(registers: list[int]) -> tuple[int, int]:
    """Sequence and ore that the arm has written into its three registers."""
    return registers[0] << 16 | registers[1], registers[2]


def rows() -> list[tuple[int, str, str, str, str]]:
    """The table for people and for engineering tools: address, type, name, unit, meaning."""
    slots = [
        Register(
            HEAD_WORDS + slot * SLOT_WORDS + register.address,
            register.code,
            f"target_{slot + 1}.{register.name}",
            register.unit,
            register.text,
        )
        for slot in range(MODBUS_SLOTS)
        for register in SLOT
    ]
    types = {"H": "uint16", "I": "uint32", "i": "int32", "f": "float32"}
    return [
        (r.address, types[r.code], r.name, r.unit, r.text)
        for r in (*HEAD, *slots, *TAIL, *WRITABLE)
    ]


def _slot(target: Target | None, sequence: int) -> tuple[float, ...]:
    if target is None:
        return (0, 0, _UNKNOWN, *(_NAN,) * (len(SLOT) - 3))
    size = target.size_m or (_NAN,) * 3
    sigma = target.sigma_m or (_NAN,) * 3
    oversize = {True: _OVERSIZE, False: NOT_OVERSIZE, None: _UNKNOWN}[target.oversize]
    volume = _NAN if target.volume_m3 is None else target.volume_m3
    numbers = *target.position_m, *target.direction, *size, volume, *sigma, target.score
    return (sequence % 2**16, target.id % 2**16, oversize, *numbers)


def _put(
    data: bytearray, start: int, registers: tuple[Register, ...], values: tuple[float, ...]
) -> None:
    for register, value in zip(registers, values, strict=True):
        if register.code == "f" and abs(value) > LARGEST_FLOAT32:
            value = math.copysign(math.inf, value)
        struct.pack_into(f">{register.code}", data, 2 * (start + register.address), value)
