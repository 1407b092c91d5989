"""The site: where the camera looks, the arm, and where nothing is ore."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
import numpy.typing as npt

from stereo_ore.types.arrays import F64, Mask, check_shape
from stereo_ore.types.geometry import Plane, Volume

BarProfile = Literal["flat", "round"]
"""What a bar's top is like; rails and rounds are measured on their ridge alone."""


@dataclass(frozen=True)
class Capsule:
    """All within `radius_m` of the line from `start` to `end` (3,) [m], camera frame; with `flat`
    ends a cylinder.
    """

    start: F64
    end: F64
    radius_m: float
    flat: bool = False

    def __post_init__(self) -> None:
        check_shape(self, "start", self.start, 3)
        check_shape(self, "end", self.end, 3)

    def distance(self, xyz: npt.NDArray[Any]) -> F64:
        """Distance [m] of (..., 3) points from the body, 0 inside and inf beyond flat ends."""
        axis = self.end - self.start
        along = (xyz - self.start) @ axis / (axis @ axis)
        nearest = self.start + np.clip(along, 0, 1)[..., None] * axis
        away = np.maximum(np.linalg.norm(xyz - nearest, axis=-1) - self.radius_m, 0)
        return np.where((along < 0) | (along > 1), np.inf, away) if self.flat else away

    def contains(self, xyz: npt.NDArray[Any]) -> Mask:
        """True for each of (..., 3) camera-frame points inside; NaN is outside."""
        return np.asarray(self.distance(xyz) <= 0)


@dataclass(frozen=True)
class Polygon:
    """A part of the left rectified image: corners (K, 2) [px]."""

    corners_px: F64

    def __post_init__(self) -> None:
        check_shape(self, "corners_px", self.corners_px, None, 2)


@dataclass(frozen=True)
class KeepOut:
    """A named place where nothing is ore: a body (camera frame) or a part of the image; who says
    so.
    """

    name: str
    body: Volume | Capsule | Polygon
    source: Literal["site", "arm"] = "site"


@dataclass(frozen=True, eq=False)
class Posture:
    """Where the arm's parts were at a time [ns since 1970], camera frame."""

    stamp_ns: int
    bodies: tuple[KeepOut, ...]


class Postures(Protocol):
    """What tells of the arm's posture."""

    def around(self, stamp_ns: int) -> tuple[Posture, ...]:
        """The last posture at or before a time and the first after it, where there are any."""


@dataclass(frozen=True)
class PostureLink:
    """Where postures come from, a file, an address to listen on or our OPC UA server, into which
    the arm writes (`opcua`), and how far [s] one may be from a frame.
    """

    max_age_s: float
    file: Path | None = None
    listen: tuple[str, int] | None = None
    opcua: bool = False


@dataclass(frozen=True)
class BarLine:
    """Where one bar of a screen lies: a point (3,) [m] on the middle of its top, and the unit
    vector (3,) along which it runs; camera frame.
    """

    point: F64
    direction: F64

    def __post_init__(self) -> None:
        check_shape(self, "point", self.point, 3)
        check_shape(self, "direction", self.direction, 3)

    def seen_from(self, T_given_other: F64) -> BarLine:
        """The same in another frame, whose pose in that of the line is `T_given_other`."""
        R, t = T_given_other[:3, :3], T_given_other[:3, 3]
        return BarLine(R.T @ (self.point - t), R.T @ self.direction)


@dataclass(frozen=True)
class Survey:
    """With which camera a site was surveyed, by the fingerprint of its calibration, and whether a
    person has confirmed what was found.
    """

    calibration: str
    camera: str
    image_size: tuple[int, int]
    confirmed: bool


@dataclass(frozen=True)
class Site:
    """Where the camera looks, and the arm; every part may be unknown (None). Plane and volume and
    the bodies of `keep_out` are in the camera frame.

    `opening_m` is the clear distance of the bars, `cross_opening_m` that of bars across them, in a
    grid; None where there are none or nobody has said so; `bar` where one of them lies, which tells
    a camera that slid along the screen. `reach_min_m` and `reach_max_m` (3,)
    bound the tool's tip in the arm frame.
    """

    T_arm_camera: F64 | None = None
    volume: Volume | None = None
    plane: Plane | None = None
    opening_m: float | None = None
    bar_width_m: float | None = None
    background: Path | None = None
    reach_min_m: F64 | None = None
    reach_max_m: F64 | None = None
    keep_out: tuple[KeepOut, ...] = ()
    survey: Survey | None = None
    posture: PostureLink | None = None
    cross_opening_m: float | None = None
    bar_profile: BarProfile = "flat"
    bar: BarLine | None = None

    def __post_init__(self) -> None:
        if self.T_arm_camera is not None:
            check_shape(self, "T_arm_camera", self.T_arm_camera, 4, 4)
