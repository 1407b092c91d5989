"""What the arm's side is told: the targets of a frame, with the time for which they hold.

A message is valid only while its targets may be struck. Everything else (a degraded or failed
frame, no arm frame, no new frame in time, the end of the program) is a message without targets.
"""

from __future__ import annotations

import hashlib
import json
import time
from dataclasses import asdict, dataclass, replace
from typing import Any

from stereo_ore.times import utc
from stereo_ore.types import F64, JsonMapping

_SCHEMA = "stereo_ore/targets/1"
"""Described in schema/targets-1.json."""

_Vector = tuple[float, float, float]


MOST_ALTERNATES = 3
"""Other strikes of a lump that a message has at most."""


@dataclass(frozen=True)
class Alternate:
    """Another place to strike a lump."""

    position_m: _Vector
    direction: _Vector
    score: float


@dataclass(frozen=True)
class Target:
    """One lump to strike, best first: arm frame, metres.

    `rank` is its place in the order, 1 first; `track` the lump's number in the run, the same in
    each frame that shows it, where that is known. `direction` is the unit vector the tool moves
    along; `size_m` longest, middle and shortest dimension; `sigma_m` the standard deviations of the
    centre of gravity `centre_m` along the axes of the camera; `alternates` other strikes of the
    same lump, best first.
    """

    id: int
    position_m: _Vector
    direction: _Vector
    size_m: _Vector | None
    oversize: bool | None
    score: float
    volume_m3: float | None = None
    sigma_m: _Vector | None = None
    centre_m: _Vector | None = None
    volume_bounds_m3: tuple[float, float] | None = None
    alternates: tuple[Alternate, ...] = ()
    rank: int = 1
    track: int | None = None


@dataclass(frozen=True)
class Origin:
    """What all messages of one program run share.

    `session` changes with every start, when sequence numbers begin anew; `transform_id` tells with
    which arm-from-camera transform positions were made; `replay` marks recorded frames that are
    published again.
    """

    session: str = ""
    transform_id: str | None = None
    replay: bool = False


@dataclass(frozen=True)
class Message:
    """The targets of one frame, or that there are none, names of foreign bodies in view, and the
    share of the screen that is under fines; `deadline` is on this process's monotonic clock [s],
    `age_s` how old the frame was when it was published.
    """

    sequence: int
    origin: Origin
    frame: str | None
    index: int | None
    stamp_ns: int | None
    published_ns: int
    valid_until_ns: int
    status: str
    reasons: tuple[str, ...]
    targets: tuple[Target, ...] = ()
    deadline: float = 0.0
    stamp_source: str | None = None
    age_s: float | None = None
    foreign: tuple[str, ...] = ()
    fines_share: float | None = None

    @property
    def valid(self) -> bool:
        """Whether the targets might be struck until `valid_until_ns`."""
        return bool(self.targets)

    def current(self) -> Message:
        """The message as it may be sent now: without its targets once they have expired."""
        return (
            self.withdrawn("EXPIRED")
            if self.targets and time.monotonic() >= self.deadline
            else self
        )

    def withdrawn(self, reason: str) -> Message:
        """The same frame without targets, and why."""
        return replace(self, targets=(), reasons=(*self.reasons, reason))

    def shortened(self, count: int) -> Message:
        """The same frame with its `count` best targets, and why there are no more."""
        if count >= len(self.targets):
            return self
        return replace(
            self, targets=self.targets[:count], reasons=(*self.reasons, "TARGETS_LEFT_OUT")
        )

    def json(self) -> dict[str, Any]:
        """What goes over the wire; units and frame are in it.

        Times are there twice: in nanoseconds, which JavaScript and other readers without 64-bit
        integers round, and as text with all nine digits.
        """
        head = {
            "schema": _SCHEMA,
            "sequence": self.sequence,
            "valid": self.valid,
            "units": "m",
            "coordinates": "arm",
        }
        fields = asdict(self)
        del fields["deadline"]
        origin: dict[str, Any] = fields.pop("origin")
        times = {
            f"{name}_utc": utc(fields[f"{name}_ns"])
            for name in ("stamp", "published", "valid_until")
        }
        return head | origin | fields | times

    def line(self) -> str:
        """One line of JSON."""
        return json.dumps(self.json(), ensure_ascii=False, allow_nan=False, separators=(",", ":"))


def new_session() -> str:
    """A name for the messages of this start of the program."""
    return f"{time.time_ns():x}"


def offline(origin: Origin) -> str:
    """What a broker says for a program that has vanished: a line of JSON that withdraws all its
    session has said.

    It is written down before the first message and sent after the last, so it has no number and no
    time: a consumer that keeps the newest must not compare it.
    """
    gone = notice(0, origin, "offline").json()
    none = dict.fromkeys(
        ("sequence", "published_ns", "valid_until_ns", "published_utc", "valid_until_utc")
    )
    return json.dumps(gone | none, separators=(",", ":"))


def notice(sequence: int, origin: Origin, status: str) -> Message:
    """A message that belongs to no frame: the program starts, stops or is gone."""
    now = time.time_ns()
    return Message(sequence, origin, None, None, None, now, now, status, (status.upper(),))


def message(
    record: JsonMapping, sequence: int, origin: Origin, *, age_s: float, valid_for_s: float
) -> Message:
    """The message of a frame's record.

    Parameters
    ----------
    record : mapping
        A record of ``frames.jsonl``.
    sequence : int
        Number of the message in its session.
    origin : Origin
        What messages of this run share.
    age_s : float
        Time since the frame was taken or arrived [s]. A negative age, from a clock that was set
        back, is as untrustworthy as a large one.
    valid_for_s : float
        How long the targets hold after that [s].
    """
    now, remaining_s = time.time_ns(), valid_for_s - abs(age_s)
    targets, reasons = _targets(record)
    whole = Message(
        sequence=sequence,
        origin=origin,
        frame=record["frame"],
        index=record["index"],
        stamp_ns=record["stamp_ns"],
        stamp_source=record.get("stamp_source"),
        published_ns=now,
        valid_until_ns=now + max(0, int(1e9 * remaining_s)),
        status=record["status"],
        reasons=(*(reason["code"] for reason in record["reasons"]), *reasons),
        targets=targets,
        deadline=time.monotonic() + remaining_s,
        age_s=round(age_s, 3),
        foreign=tuple(body["name"] for body in record.get("foreign", ())),
        fines_share=(record["grizzly"] or {}).get("fines_share"),
    )
    return whole.current()


def _targets(record: JsonMapping) -> tuple[tuple[Target, ...], tuple[str, ...]]:
    """Targets that an arm can use, and the codes of what stands against the others."""
    if record["status"] != "ok" or not record["targets"]:
        return (), ()
    if record["arm_frame"] is None:
        return (), ("NO_ARM_FRAME",)
    ores = {ore["id"]: ore for ore in record["ores"]}
    found = tuple(_target(ores[id], rank) for rank, id in enumerate(record["targets"], 1))
    usable = tuple(target for target in found if target)
    return usable, () if len(usable) == len(found) else ("TARGET_INCOMPLETE",)


def _target(ore: JsonMapping, rank: int) -> Target | None:
    """None for an ore whose strike is not fully known: half a target is none."""
    if ore["strike"] is None or (best := _place(ore["strike"])) is None:
        return None
    others = (_place(other) for other in ore["strike"]["alternates"][:MOST_ALTERNATES])
    centre = ore["centre_of_gravity"] or {}
    return Target(
        ore["id"],
        best.position_m,
        best.direction,
        _whole(ore["size_m"]),
        ore["oversize"],
        best.score,
        ore["volume_m3"],
        _whole(centre.get("sigma_m")),
        _whole(centre.get("arm")),
        _whole(ore.get("volume_bounds_m3")),
        tuple(other for other in others if other),
        rank,
        ore["track"]["number"] if ore.get("track") else None,
    )


def _place(strike: JsonMapping) -> Alternate | None:
    """Where and how a strike hits in the arm's frame; None where a part of that is unknown."""
    point, direction = _whole(strike["point"]["arm"]), _whole(strike["direction"]["arm"])
    if point is None or direction is None or strike["score"] is None:
        return None
    return Alternate(point, direction, strike["score"])


def _whole(values: list[float] | None) -> Any:
    """A tuple; None for what is not known or not in full."""
    return None if values is None or None in values else tuple(values)


def transform_id(T_arm_camera: F64 | None) -> str | None:
    """Twelve hexadecimal digits that change with the transform; None without one."""
    return (
        None
        if T_arm_camera is None
        else hashlib.sha256(T_arm_camera.astype("<f8").tobytes()).hexdigest()[:12]
    )
