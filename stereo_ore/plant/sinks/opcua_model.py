"""The OPC UA information model: which nodes there are, and what each holds for a message.

Arrays have a fixed number of slots, as controllers want them; slots beyond `Targets.Count` hold NaN, so that a value
read by mistake is no place to strike.

`Targets.SequenceNumber` is written first and `Sequence` last. Who reads the nodes one by one reads `Sequence`, then
the payload, then `SequenceNumber[0]`: the payload is whole when both are equal. Who reads all in one request, or
groups the values of a subscription by source timestamp, gets them whole in any case.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

from stereo_ore.plant.sinks.message import Message, Target

NAMESPACE = "urn:stereo-ore:targets"
SLOTS = 16

NAN3 = (float("nan"),) * 3
OVERSIZE = {True: 1, False: 0, None: -1}
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


@dataclass(frozen=True)
class Variable:
    """A node: folder, name, OPC UA type, description, and its value for a message; `unit` "m" where it has one."""

    folder: str
    name: str
    type: str
    text: str
    value: Callable[[Message], Any]
    unit: str = ""


def _vectors(get: Callable[[Target], Iterable[float] | None]) -> Callable[[Message], list[float]]:
    """A flat array x0 y0 z0 x1 …: three values a slot."""

    def value(message: Message) -> list[float]:
        used = [number for target in message.targets[:SLOTS] for number in (get(target) or NAN3)]
        return used + [float("nan")] * (3 * SLOTS - len(used))

    return value


def _slots(get: Callable[[Target], Any], empty: Any) -> Callable[[Message], list[Any]]:
    def value(message: Message) -> list[Any]:
        used = [get(target) for target in message.targets[:SLOTS]]
        return used + [empty] * (SLOTS - len(used))

    return value


def _time(nanoseconds: int) -> datetime:
    return EPOCH + timedelta(microseconds=nanoseconds // 1000)


PAYLOAD = (
    Variable("Targets", "SequenceNumber", "UInt32", "Sequence; first written", lambda m: [m.sequence] * SLOTS),
    Variable("Targets", "Valid", "Boolean", "true while targets may be struck", lambda m: m.valid),
    Variable("Targets", "Count", "UInt32", "slots in use, best target first", lambda m: len(m.targets[:SLOTS])),
    Variable("Targets", "Id", "UInt32", "ore id in the frame; 0: slot not in use", _slots(lambda t: t.id, 0)),
    Variable("Targets", "Position", "Double", "strike points x y z", _vectors(lambda t: t.position_m), "m"),
    Variable("Targets", "Direction", "Double", "unit vectors the tool moves along", _vectors(lambda t: t.direction)),
    Variable("Targets", "Size", "Double", "longest, middle, shortest; NaN unknown", _vectors(lambda t: t.size_m), "m"),
    Variable("Targets", "Oversize", "Int16", "1 yes, 0 no, -1 unknown", _slots(lambda t: OVERSIZE[t.oversize], -1)),
    Variable("Targets", "Score", "Double", "quality of the strike", _slots(lambda t: t.score, float("nan"))),
    Variable("Result", "Frame", "String", "name of the frame", lambda m: m.frame or ""),
    Variable(
        "Result", "FrameIndex", "Int64", "number of the frame; -1: none", lambda m: -1 if m.index is None else m.index
    ),
    Variable("Result", "StampNs", "Int64", "camera's time of the frame; 0 unknown", lambda m: m.stamp_ns or 0, "ns"),
    Variable("Result", "Published", "DateTime", "when it was published", lambda m: _time(m.published_ns)),
    Variable("Result", "ValidUntil", "DateTime", "strike no later", lambda m: _time(m.valid_until_ns)),
    Variable("Result", "Status", "String", "ok, degraded, empty, failed, expired …", lambda m: m.status),
    Variable("Result", "Reasons", "String", "codes", lambda m: list(m.reasons)),
    Variable("Result", "Session", "String", "changes when Sequence begins anew", lambda m: m.origin.session),
    Variable("Result", "TransformId", "String", "the arm_from_camera in use", lambda m: m.origin.transform_id or ""),
    Variable("Result", "Replay", "Boolean", "true: a recording, not the camera", lambda m: m.origin.replay),
    Variable("Result", "Json", "String", "the whole message in one value", lambda m: m.line()),
    Variable("Result", "Sequence", "UInt32", "number of the message; last written", lambda m: m.sequence),
)
"""In the order in which they are written."""

CONTROL = (
    Variable("Result", "Heartbeat", "UInt32", "counts up twice a second while the program lives", lambda m: 0),
    Variable("Acknowledgement", "AcknowledgedSequence", "UInt32", "arm: Sequence of the message in use", lambda m: 0),
    Variable("Acknowledgement", "AcknowledgedTarget", "UInt32", "arm: Id of the target being struck", lambda m: 0),
)
"""What is not part of a message."""
