"""`keep_out` of a site file: where nothing is ore, as it is written and in the camera frame."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from stereo_ore.config.fields import Number, Positive, Section
from stereo_ore.transforms import inverse, transform_points
from stereo_ore.types import F64, Capsule, KeepOut, Polygon, Volume

_Vector = tuple[Number, Number, Number]
Pixel = tuple[Number, Number]
_Frame = Literal["arm", "camera"]
Name = Annotated[str, Field(min_length=1, max_length=60)]


class BoxOut(Section):
    """A box along the axes of its frame."""

    name: Name
    shape: Literal["box"]
    frame: _Frame
    min_m: _Vector
    max_m: _Vector


class RodOut(Section):
    """A capsule, or with flat ends a cylinder, about a line."""

    name: Name
    shape: Literal["capsule", "cylinder"]
    frame: _Frame
    from_m: _Vector
    to_m: _Vector
    radius_m: Positive


class PolygonOut(Section):
    """A part of the left rectified image."""

    name: Name
    shape: Literal["polygon"]
    points_px: Annotated[tuple[Pixel, ...], Field(min_length=3, max_length=1000)]


Entry = Annotated[BoxOut | RodOut | PolygonOut, Field(discriminator="shape")]


def faults(entries: tuple[Entry, ...], has_arm: bool) -> Iterator[str]:
    """What is wrong with entries, each with its place and name."""
    for place, entry in enumerate(entries):
        key = f"keep_out.{place} ({entry.name})"
        if not isinstance(entry, PolygonOut) and entry.frame == "arm" and not has_arm:
            yield f"{key}: is in the arm frame, but arm_from_camera is not given"
        if isinstance(entry, BoxOut) and not np.less(entry.min_m, entry.max_m).all():
            low, high = list(entry.min_m), list(entry.max_m)
            yield f"{key}: each of min_m {low} must be less than max_m {high}"
        if isinstance(entry, RodOut) and entry.from_m == entry.to_m:
            yield f"{key}: from_m and to_m are one point {list(entry.from_m)}"
    names = [entry.name for entry in entries]
    for name in sorted({name for name in names if names.count(name) > 1}):
        yield f"keep_out: the name {name!r} is there {names.count(name)} times"


def lengths(entries: tuple[Entry, ...]) -> Iterator[tuple[str, list[float]]]:
    """Keys and coordinates [m], to be asked for their unit."""
    for place, entry in enumerate(entries):
        if isinstance(entry, BoxOut):
            yield f"keep_out.{place} ({entry.name})", [*entry.min_m, *entry.max_m]
        if isinstance(entry, RodOut):
            yield f"keep_out.{place} ({entry.name})", [*entry.from_m, *entry.to_m, entry.radius_m]


def in_camera(entry: Entry, T_arm_camera: F64 | None) -> KeepOut:
    """The entry in the camera frame."""
    if isinstance(entry, PolygonOut):
        return KeepOut(entry.name, Polygon(np.array(entry.points_px, float)))
    T = T_arm_camera if entry.frame == "arm" and T_arm_camera is not None else np.eye(4)
    if isinstance(entry, BoxOut):
        return KeepOut(entry.name, Volume(T, np.array(entry.min_m), np.array(entry.max_m)))
    start, end = (transform_points(inverse(T), point) for point in (entry.from_m, entry.to_m))
    return KeepOut(entry.name, Capsule(start, end, entry.radius_m, entry.shape == "cylinder"))


def document(place: KeepOut) -> dict[str, Any]:
    """What `in_camera` reads back as the same place, for a box of the camera's or the arm's
    frame; rods are written in the camera frame.
    """
    body = place.body
    if isinstance(body, Polygon):
        return {"name": place.name, "shape": "polygon", "points_px": body.corners_px.tolist()}
    if isinstance(body, Volume):
        frame = "camera" if np.array_equal(body.T_box_camera, np.eye(4)) else "arm"
        ends = {"min_m": body.min_m.tolist(), "max_m": body.max_m.tolist()}
        return {"name": place.name, "shape": "box", "frame": frame} | ends
    shape = "cylinder" if body.flat else "capsule"
    ends = {"from_m": body.start.tolist(), "to_m": body.end.tolist(), "radius_m": body.radius_m}
    return {"name": place.name, "shape": shape, "frame": "camera"} | ends
