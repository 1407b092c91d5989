"""The OPC UA information model: which nodes there are, and what each holds for a message.

Arrays have a fixed number of slots, as controllers want them; slots beyond `Targets.Count` hold
NaN, so that a value read by mistake is no place to strike.

`Targets.SequenceNumber` is written first and `Sequence` last. Who reads the nodes one by one reads
`Sequence`, then the payload, then `SequenceNumber[0]`: the payload is whole when both are equal.
Who reads all in one request, or groups the values of a subscription by source timestamp, gets them
whole in any case.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

from stereo_ore.plant.sinks.message import MOST_ALTERNATES, Message, Target

NAMESPACE = "urn:stereo-ore:targets"
OPCUA_SLOTS = 16
POSTURE_SLOTS = 16
"""Bodies of the arm that its side may write; a breaker has some five."""

_NAN = float("nan")
_OVERSIZE = {True: 1, False: 0, None: -1}
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
NO_TIME = datetime(1601, 1, 1, tzinfo=UTC)
"""OPC UA's null time."""
LARGEST_INT32 = 2**31 - 1


@dataclass(frozen=True)
class _Unit:
    """A unit of UNECE Recommendation 20; `code` is its common code as the number that EUInformation
    wants.
    """

    name: str
    code: int


UNITS = {
    "m": _Unit("metre", 5067858),
    "m³": _Unit("cubic metre", 5067857),
    "ns": _Unit("nanosecond", 4404279),
}
"""MTR, MTQ, C47: the characters of the common code as one big-endian number (OPC 10000-8,
5.6.3)."""


@dataclass(frozen=True)
class Variable:
    """A node: folder, name, OPC UA type, description, and its value for a message.

    `length` is that of an array: None for a scalar, 0 for one that varies. `certain` is False for
    what means nothing while no target is valid: such a node then has the status Uncertain.
    """

    folder: str
    name: str
    type: str
    text: str
    value: Callable[[Message], Any]
    unit: str = ""
    length: int | None = None
    frame: str = ""
    certain: bool = True


def _slot(
    name: str, type: str, text: str, get: Callable[[Target], Any], empty: Any, unit: str = ""
) -> Variable:
    """An array with a value a slot."""

    def value(message: Message) -> list[Any]:
        used = [get(target) for target in message.targets[:OPCUA_SLOTS]]
        return used + [empty] * (OPCUA_SLOTS - len(used))

    return Variable("Targets", name, type, text, value, unit, OPCUA_SLOTS, certain=False)


def _numbers(
    name: str,
    text: str,
    get: Callable[[Target], Sequence[float] | None],
    unit: str = "",
    frame: str = "",
    count: int = 3,
) -> Variable:
    """A flat array x0 y0 z0 x1 …: `count` values a slot, NaN for those that are missing."""

    def value(message: Message) -> list[float]:
        found = [_NAN] * (count * OPCUA_SLOTS)
        for slot, target in enumerate(message.targets[:OPCUA_SLOTS]):
            known = get(target) or ()
            found[count * slot : count * slot + len(known)] = known
        return found

    return Variable(
        "Targets", name, "Double", text, value, unit, count * OPCUA_SLOTS, frame, certain=False
    )


_RESULT_STATES = {"ok": 1, "empty": 1, "expired": 3, "degraded": 4, "failed": 4}
"""ResultStateDataType of OPC 40100-1, 12.19."""


def _result(
    name: str, type: str, text: str, value: Callable[[Message], Any], **more: Any
) -> Variable:
    return Variable("Result", name, type, text, value, **more)


def _time(nanoseconds: int | None) -> datetime:
    return NO_TIME if nanoseconds is None else EPOCH + timedelta(microseconds=nanoseconds // 1000)


def _index(message: Message) -> int:
    return -1 if message.index is None else message.index


PAYLOAD = (
    Variable(
        "Targets",
        "SequenceNumber",
        "UInt32",
        "Sequence; first written",
        lambda m: [m.sequence] * OPCUA_SLOTS,
        length=OPCUA_SLOTS,
    ),
    Variable("Targets", "Valid", "Boolean", "true while targets may be struck", lambda m: m.valid),
    Variable("Targets", "Count", "UInt32", "slots in use, best target first",
        lambda m: len(m.targets[:OPCUA_SLOTS])),
    _slot("Id", "UInt32", "ore id in the frame; 0: slot not in use", lambda t: t.id, 0),
    _numbers("Position", "strike points x y z", lambda t: t.position_m, "m", "arm"),
    _numbers("Direction", "unit vectors the tool moves along", lambda t: t.direction, frame="arm"),
    _numbers("Size", "longest, middle, shortest; NaN unknown", lambda t: t.size_m, "m"),
    _slot("Volume", "Double", "volume of the lump; NaN unknown",
        lambda t: _NAN if t.volume_m3 is None else t.volume_m3,
        _NAN, "m³"),
    _numbers("Sigma", "standard deviations of the centre of gravity; NaN unknown",
        lambda t: t.sigma_m, "m",
        "left_rectified"),
    _numbers("Centre", "centres of gravity; NaN unknown", lambda t: t.centre_m, "m", "arm"),
    _numbers("VolumeBounds", "lower and upper bound a slot; NaN unknown",
        lambda t: t.volume_bounds_m3, "m³", count=2),
    _numbers("AlternatePosition", "three other strike points a slot; NaN: none",
        lambda t: [x for other in t.alternates for x in other.position_m], "m", "arm",
        3 * MOST_ALTERNATES),
    _numbers("AlternateDirection", "their directions",
        lambda t: [x for other in t.alternates for x in other.direction], "", "arm",
        3 * MOST_ALTERNATES),
    _slot("Oversize", "Int16", "1 yes, 0 no, -1 unknown", lambda t: _OVERSIZE[t.oversize], -1),
    _slot("Score", "Double", "quality of the strike", lambda t: t.score, _NAN),
    _slot("Track", "UInt32", "number of the lump in the run, the same in each frame; 0 unknown",
        lambda t: t.track or 0, 0),
    _result("Frame", "String", "name of the frame", lambda m: m.frame or ""),
    _result("FrameIndex", "Int64", "number of the frame; -1: none", _index),
    _result("FrameIndex32", "Int32", "FrameIndex for clients without 64 bits",
        lambda m: min(_index(m), LARGEST_INT32)),
    _result("StampNs", "Int64", "camera's time of the frame; 0 unknown", lambda m: m.stamp_ns or 0,
        unit="ns"),
    _result("Stamp", "DateTime", "StampNs to the microsecond; null time: unknown",
        lambda m: _time(m.stamp_ns)),
    _result("StampSource", "String", "where the stamp is from: header, file name, arrival …",
        lambda m: m.stamp_source or ""),
    _result("Published", "DateTime", "when it was published", lambda m: _time(m.published_ns)),
    _result("ValidUntil", "DateTime", "strike no later", lambda m: _time(m.valid_until_ns)),
    _result("Status", "String", "ok, degraded, empty, failed, expired …", lambda m: m.status),
    _result("ResultState", "Int32",
        "OPC 40100-1: 1 completed, 3 aborted (expired), 4 failed (degraded too), 0 undefined",
        lambda m: _RESULT_STATES.get(m.status, 0)),
    _result("Reasons", "String", "codes", lambda m: list(m.reasons), length=0),
    _result("Foreign", "String", "names of bodies in view that are no ore",
        lambda m: list(m.foreign), length=0),
    _result("FinesShare", "Double",
        "share 0…1 of the visible screen under fines and mud; NaN unknown",
        lambda m: _NAN if m.fines_share is None else m.fines_share),
    _result("Session", "String", "changes when Sequence begins anew", lambda m: m.origin.session),
    _result("TransformId", "String", "the arm_from_camera in use",
        lambda m: m.origin.transform_id or ""),
    _result("Replay", "Boolean", "true: a recording, not the camera", lambda m: m.origin.replay),
    _result("Json", "String", "the whole message in one value", lambda m: m.line()),
    _result("Sequence", "UInt32", "number of the message; last written", lambda m: m.sequence),
)  # fmt: skip
"""In the order in which they are written."""

CONTROL = (
    _result("Heartbeat", "UInt32", "counts up twice a second while the program lives", lambda m: 0),
    Variable(
        "Acknowledgement",
        "AcknowledgedSequence",
        "UInt32",
        "arm: Sequence of the message in use",
        lambda m: 0,
    ),
    Variable(
        "Acknowledgement",
        "AcknowledgedTarget",
        "UInt32",
        "arm: Id of the target being struck",
        lambda m: 0,
    ),
)
"""What is not part of a message."""


def _written(
    name: str, type: str, text: str, unit: str = "", length: int | None = None, frame: str = ""
) -> Variable:
    """A variable that the arm writes; its value until then is that of an empty message."""
    empty: Any = {"String": "", "DateTime": NO_TIME}.get(type, 0)
    value = empty if length is None else [empty] * length
    return Variable("Posture", name, type, text, lambda m: value, unit, length, frame, False)


POSTURE = (
    _written("BodyCount", "UInt32", "arm: slots in use; 0: no part of the arm is near the screen"),
    _written("Name", "String", "arm: names of its parts, one a slot", length=POSTURE_SLOTS),
    _written("From", "Double", "arm: first ends of the capsules' axes x y z", "m",
        3 * POSTURE_SLOTS, "arm"),
    _written("To", "Double", "arm: other ends of the capsules' axes x y z", "m",
        3 * POSTURE_SLOTS, "arm"),
    _written("Radius", "Double", "arm: radii of the capsules", "m", POSTURE_SLOTS),
    _written("PostureStamp", "DateTime", "arm: when it was there (UTC); written last, it hands"
        " over the posture"),
)  # fmt: skip
"""Where the arm's parts are, for a site with `posture: {opcua: true}`."""

MODEL = (*PAYLOAD, *CONTROL, *POSTURE)
"""All nodes."""

WRITTEN_FOLDERS = ("Acknowledgement", "Posture")
"""Folders whose nodes clients may write."""
