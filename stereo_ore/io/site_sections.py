"""What a site file may hold: its sections, and what can be wrong with single entries of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated, Literal

import numpy as np
from pydantic import BeforeValidator, Field

from stereo_ore.config.fields import Number, Section
from stereo_ore.io import keep_out as places
from stereo_ore.io.posture import PostureSection
from stereo_ore.transforms import rotation_fault
from stereo_ore.types import F64, BarProfile

FORMAT = "stereo_ore/site"
_FARTHEST_M = 25.0
"""Coordinates of camera, volume, reach and plane: a screen has a few metres, a great arm twenty."""

_OPENING_M, _BAR_WIDTH_M = (0.005, 3.0), (0.001, 1.0)
"""Clear distances between bars, and their widths, that can be."""

_TYPED_TOLERANCE = 1e-3
"""A rotation typed with three to four decimals is made exact; what is further off is an error."""

_Length = Annotated[Number, Field(gt=0)]
_Vector = tuple[Number, Number, Number]
_Row = tuple[Number, Number, Number, Number]
_Frame = Literal["arm", "camera"]


class _Box(Section):
    min_m: _Vector
    max_m: _Vector


class _Volume(_Box):
    frame: _Frame | Literal["screen"]


class PlaneSection(Section):
    """The plane of the bar tops: points X of it have ``normal · X = offset_m``."""

    frame: _Frame
    normal: _Vector
    offset_m: Number


class BarSection(Section):
    """Where one bar lies: a point on the middle of its top, and where it runs."""

    frame: _Frame
    point_m: _Vector
    direction: _Vector


def _plane_or_auto(value: object) -> object:
    """``auto`` leaves the plane to be found."""
    return None if value == "auto" else value


class _Grizzly(Section):
    opening_m: _Length | None = None
    openings_m: tuple[_Length, _Length] | None = None
    bar_profile: BarProfile = "flat"
    bar_width_m: _Length | None = None
    plane: Annotated[PlaneSection | None, BeforeValidator(_plane_or_auto)] = None
    bar: BarSection | None = None


class HandEyeRecord(Section):
    """How `arm_from_camera` was found, and how well it fits; for the reader of the file."""

    method: str
    used: int
    dropped: tuple[str, ...] = ()
    rms_mm: Number
    max_mm: Number


class SurveyRecord(Section):
    """With which camera a screen was surveyed by `stereo-ore site`, and whether a person has
    looked at what was found.
    """

    confirmed: bool
    calibration: str
    camera: str = ""
    image_size: tuple[int, int]
    frames: int
    bars_seen: int
    rms_m: Number


class SiteFile(Section):
    """The whole file, as it is written."""

    format: Literal["stereo_ore/site"]
    version: Literal[1]
    arm_from_camera: tuple[_Row, _Row, _Row, _Row] | None = None
    tool_from_camera: tuple[_Row, _Row, _Row, _Row] | None = None
    screen_from_camera: tuple[_Row, _Row, _Row, _Row] | None = None
    working_volume: _Volume | None = None
    grizzly: _Grizzly = _Grizzly()
    background: str | None = None
    reach: _Box | None = None
    keep_out: Annotated[tuple[places.Entry, ...], Field(max_length=64)] = ()
    hand_eye: HandEyeRecord | None = None
    survey: SurveyRecord | None = None
    posture: PostureSection | None = None


def entry_faults(file: SiteFile) -> list[str]:
    """What is wrong with single entries."""
    found = []
    for name, rows in _transforms(file):
        found += [] if rows is None else _transform_faults(name, np.array(rows))
    found += _length_faults(file)
    for name, box in (("working_volume", file.working_volume), ("reach", file.reach)):
        if box and not all(low < high for low, high in zip(box.min_m, box.max_m, strict=True)):
            found.append(
                f"{name}: each of min_m {list(box.min_m)} must be less than max_m {list(box.max_m)}"
            )
    if file.grizzly.plane and not any(file.grizzly.plane.normal):
        found.append("grizzly.plane.normal: must not be zero")
    if file.grizzly.opening_m is not None and file.grizzly.openings_m is not None:
        found.append("grizzly: opening_m is of slots, openings_m of a grid: give one of them")
    bar = file.grizzly.bar
    if bar and not any(bar.direction):
        found.append("grizzly.bar.direction: must not be zero")
    for name, part in (
        ("working_volume", file.working_volume),
        ("grizzly.plane", file.grizzly.plane),
        ("grizzly.bar", bar),
    ):
        if part and part.frame == "arm" and file.arm_from_camera is None:
            found.append(f"{name}: is in the arm frame, but arm_from_camera is not given")
    volume = file.working_volume
    if volume and volume.frame == "screen" and file.screen_from_camera is None:
        found.append(
            "working_volume: is in the screen's frame, but screen_from_camera is not given"
        )
    if file.posture and file.arm_from_camera is None:
        found.append("posture: is in the arm frame, but arm_from_camera is not given")
    found += places.faults(file.keep_out, file.arm_from_camera is not None)
    return found


def _transforms(file: SiteFile) -> Iterator[tuple[str, tuple[_Row, ...] | None]]:
    for name in ("arm_from_camera", "tool_from_camera", "screen_from_camera"):
        yield name, getattr(file, name)


def _transform_faults(name: str, T: F64) -> list[str]:
    found = []
    if fault := rotation_fault(T[:3, :3], _TYPED_TOLERANCE):
        found.append(f"{name}: the upper left 3×3 part {fault}")
    if not np.array_equal(T[3], (0, 0, 0, 1)):
        found.append(f"{name}: the last row must be [0, 0, 0, 1], not {T[3].tolist()}")
    return found


def _length_faults(file: SiteFile) -> list[str]:
    """Lengths that no site has: each is asked for its unit."""
    lengths = [
        (f"{name}.{end}", getattr(box, end), 0.0, _FARTHEST_M)
        for name, box in (("working_volume", file.working_volume), ("reach", file.reach))
        if box
        for end in ("min_m", "max_m")
    ]
    for name, rows in _transforms(file):
        lengths += [] if rows is None else [(name, [row[3] for row in rows[:3]], 0.0, _FARTHEST_M)]
    lengths += [(*entry, 0.0, _FARTHEST_M) for entry in places.lengths(file.keep_out)]
    grizzly = file.grizzly
    if grizzly.plane and any(grizzly.plane.normal):
        lengths.append(("grizzly.plane.offset_m", [_offset(grizzly.plane)], 0.0, _FARTHEST_M))
    if grizzly.bar:
        lengths.append(("grizzly.bar.point_m", grizzly.bar.point_m, 0.0, _FARTHEST_M))
    for name, value, limits in (
        ("opening_m", grizzly.opening_m, _OPENING_M),
        *(("openings_m", side, _OPENING_M) for side in grizzly.openings_m or ()),
        ("bar_width_m", grizzly.bar_width_m, _BAR_WIDTH_M),
    ):
        lengths += [] if value is None else [(f"grizzly.{name}", [value], *limits)]
    found = [_length_fault(*length) for length in lengths]
    return [fault for fault in found if fault]


def _offset(plane: PlaneSection) -> float:
    """Distance [m] of the plane from the origin of its frame."""
    return plane.offset_m / float(np.linalg.norm(plane.normal))


def _length_fault(key: str, values: Sequence[float], least: float, greatest: float) -> str:
    size = max(abs(value) for value in values)
    if least <= size <= greatest:
        return ""
    shown = list(values) if len(values) > 1 else values[0]
    if size < least:
        return f"{key}: {shown} m is less than {least:g} m; is it in metres?"
    return (
        f"{key}: {shown} m is more than {greatest:g} m; millimetres (centimetres) given for metres?"
    )
