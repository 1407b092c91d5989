"""The arm's posture: where its parts are at a time, as JSON lines (`config schema posture`)."""

from __future__ import annotations

import json
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, StrictInt, model_validator

from stereo_ore.config.fields import Number, Positive, Section
from stereo_ore.config.validation import validate
from stereo_ore.errors import ConfigError
from stereo_ore.transforms import inverse, transform_points
from stereo_ore.types import F64, Capsule, KeepOut, Posture, PostureLink, Site

MOST_LINE_BYTES = 65_536
"""A posture of 64 bodies has some 10 kB."""
_FARTHEST_M = 25.0

_Coordinate = Annotated[Number, Field(ge=-_FARTHEST_M, le=_FARTHEST_M)]
_Point = tuple[_Coordinate, _Coordinate, _Coordinate]
_Address = Annotated[str, Field(pattern=r"^[\w.-]+:\d{1,5}$")]


class PostureSection(Section):
    """`posture` of a site file: a file of lines, an address at which the arm's side leaves them, or
    the OPC UA server's variables, into which it writes.
    """

    file: str | None = None
    listen: _Address | None = None
    opcua: Literal[True] | None = None
    max_age_s: Annotated[Positive, Field(le=60)] = 0.2

    @model_validator(mode="after")
    def _one(self) -> PostureSection:
        if [self.file, self.listen, self.opcua].count(None) != 2:
            raise ValueError("give one of file, listen and opcua")
        return self

    def link(self, folder: Path) -> PostureLink:
        """The same with a path that is seen from the site file, and an address in two parts."""
        if self.file is not None:
            return PostureLink(self.max_age_s, file=folder / self.file)
        if self.listen is None:
            return PostureLink(self.max_age_s, opcua=True)
        host, _, port = self.listen.rpartition(":")
        return PostureLink(self.max_age_s, listen=(host, int(port)))


def posture_document(link: PostureLink, file: str | None) -> dict[str, Any]:
    """What `PostureSection` reads back as the same."""
    where: dict[str, Any] = {"file": file}
    if link.listen is not None:
        where = {"listen": "{}:{}".format(*link.listen)}
    elif link.opcua:
        where = {"opcua": True}
    return {**where, "max_age_s": link.max_age_s}


class _Body(Section):
    name: Annotated[str, Field(min_length=1, max_length=60)]
    from_m: _Point
    to_m: _Point
    radius_m: Annotated[Positive, Field(le=_FARTHEST_M)]

    @model_validator(mode="after")
    def _long(self) -> _Body:
        if self.from_m == self.to_m:
            raise ValueError(f"from_m and to_m are one point {list(self.from_m)}")
        return self


class PostureLine(Section):
    """Where the arm's parts are at a time: capsules in the arm frame, metres."""

    format: Literal["stereo_ore/posture/1"] = Field(alias="schema")
    stamp_ns: Annotated[StrictInt, Field(ge=0, lt=2**63)]
    bodies: Annotated[tuple[_Body, ...], Field(max_length=64)]


def parse_posture(line: bytes, T_arm_camera: F64, where: str) -> Posture:
    """A posture in the camera frame.

    Raises
    ------
    ConfigError
        Naming `where` and what is wrong with the line.
    """
    if len(line) > MOST_LINE_BYTES:
        raise ConfigError(f"a line has more than {MOST_LINE_BYTES} bytes", file=where)
    try:
        data = json.loads(line)
    except ValueError as fault:
        raise ConfigError(f"is no JSON: {fault}", file=where) from None
    return read_posture(data, T_arm_camera, where)


def read_posture(data: Any, T_arm_camera: F64, where: str) -> Posture:
    """A posture in the camera frame, from what a line of JSON holds.

    Raises
    ------
    ConfigError
        Naming `where` and what is wrong with it.
    """
    found = validate(PostureLine, data, where, ConfigError)
    back = inverse(T_arm_camera)
    bodies = (
        KeepOut(
            body.name,
            Capsule(
                transform_points(back, np.array(body.from_m)),
                transform_points(back, np.array(body.to_m)),
                body.radius_m,
            ),
            "arm",
        )
        for body in found.bodies
    )
    return Posture(found.stamp_ns, tuple(bodies))


@dataclass(frozen=True)
class PostureFile:
    """Postures of a file in the order of their stamps [ns]; can be sent to another process."""

    path: Path
    T_arm_camera: F64
    stamps: tuple[int, ...]
    lines: tuple[bytes, ...]

    def around(self, stamp_ns: int) -> tuple[Posture, ...]:
        """The last posture at or before a time and the first after it, where there are any."""
        after = bisect_right(self.stamps, stamp_ns)
        near = self.lines[max(after - 1, 0) : after + 1]
        return tuple(parse_posture(line, self.T_arm_camera, str(self.path)) for line in near)


def recorded_postures(site: Site | None) -> PostureFile | None:
    """The file of postures that a site names; None where it names none.

    Raises
    ------
    ConfigError
        For a file that can't be read, a line that is no posture, stamps that do not grow, and a
        site whose postures come live.
    """
    if site is None or site.posture is None or site.T_arm_camera is None:
        return None
    path = site.posture.file
    if path is None:
        way = "opcua" if site.posture.opcua else "listen"
        raise ConfigError(
            "the arm's posture comes while it works, and only `serve` takes it in",
            key=f"posture.{way}",
            remedy="Give posture.file with the recorded lines",
        )
    try:
        lines = tuple(line for line in path.read_bytes().splitlines() if line.strip())
    except OSError as fault:
        raise ConfigError(f"can't be read: {fault.strerror}", file=path) from None
    stamps = tuple(_stamps(path, lines, site.T_arm_camera))
    return PostureFile(path, site.T_arm_camera, stamps, lines)


def _stamps(path: Path, lines: tuple[bytes, ...], T_arm_camera: F64) -> Iterator[int]:
    last = -1
    for number, line in enumerate(lines, 1):
        where = f"{path}: line {number}"
        stamp = parse_posture(line, T_arm_camera, where).stamp_ns
        if stamp <= last:
            raise ConfigError(
                f"{stamp} is not after {last}, that of the line before", file=where, key="stamp_ns"
            )
        yield (last := stamp)
