"""What a frame gave: solids, strikes, ores, and the whole result."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from stereo_ore.transforms import rotate, transform_points
from stereo_ore.types.arrays import F32, F64, I32, check_shape
from stereo_ore.types.stages import (
    Disparity,
    FilterResult,
    Grizzly,
    OreMap,
    PointCloud,
    RectifiedPair,
    StampSource,
    Surface,
    VoxelCloud,
)

Status = Literal["ok", "degraded", "empty", "failed", "skipped"]
"""Only an "ok" frame has targets; a "degraded" one has a cloud, but something speaks against acting
on it; a "skipped" one, of a live run, was not looked at."""


@dataclass(frozen=True)
class Reason:
    """Why something is missing or doubtful: a stable code and a sentence."""

    code: str
    detail: str


@dataclass(frozen=True)
class Solid:
    """A lump as a body: all of it, with a stated model of the sides that no camera saw (camera
    frame, metres).

    `axes` (3, 3) are the box's unit axes as rows, longest first; `extent_m` the box's lengths along
    them; `size_m` longest, middle and shortest dimension. `sigma_m` (3,) is the standard deviation
    of the centre of gravity. `vertices` (V, 3) is the convex hull of the modelled solid, for
    pictures. `arm` is the same solid in the arm's frame, where that is known.
    """

    centre_of_gravity: F64
    sigma_m: F64
    volume_m3: float
    volume_bounds_m3: tuple[float, float]
    box_centre: F64
    axes: F64
    extent_m: F64
    size_m: F64
    method: str
    vertices: F32
    oversize: bool | None = None
    reasons: tuple[Reason, ...] = ()
    arm: Solid | None = None

    def moved(self, T_target_camera: F64) -> Solid:
        """Return the solid in another frame.

        The deviations are taken to be independent along the camera's axes: σ'² = (R∘R) σ².
        """
        return replace(
            self,
            centre_of_gravity=transform_points(T_target_camera, self.centre_of_gravity),
            sigma_m=np.sqrt(T_target_camera[:3, :3] ** 2 @ self.sigma_m**2),
            box_centre=transform_points(T_target_camera, self.box_centre),
            axes=rotate(T_target_camera, self.axes),
            vertices=transform_points(T_target_camera, self.vertices).astype(np.float32),
        )


@dataclass(frozen=True)
class Strike:
    """Where and along which unit vector the tool moves into the rock (camera frame).

    `arm` is the same strike in the arm's frame, where that is known.
    """

    point: F64
    direction: F64
    slope_rad: float
    flatness_m: float
    score: float
    arm: Strike | None = None

    def moved(self, T_target_camera: F64) -> Strike:
        """Return the strike in another frame."""
        point = transform_points(T_target_camera, self.point)
        return replace(self, point=point, direction=rotate(T_target_camera, self.direction))


@dataclass(frozen=True)
class StrikePlan:
    """The best strike of a lump and its ranked alternates, or none and why."""

    strikes: tuple[Strike, ...]
    reasons: tuple[Reason, ...] = ()


@dataclass(frozen=True)
class Ore:
    """One lump: its visible surface, the solid it belongs to, and where to strike.

    `carries` and `carried_by` are ids of lumps that lie on it and that it lies on. `arm` is the
    same lump in the arm's frame, where that is known.
    """

    id: int
    points: int
    pixels: int
    cut: bool
    surface_centroid: F64
    solid: Solid | None
    plan: StrikePlan
    reasons: tuple[Reason, ...] = ()
    arm: Ore | None = None
    carries: tuple[int, ...] = ()
    carried_by: tuple[int, ...] = ()

    @property
    def strike(self) -> Strike | None:
        """Best strike, or None: `plan.reasons` say why."""
        return self.plan.strikes[0] if self.plan.strikes else None

    @property
    def oversize(self) -> bool | None:
        """Whether the lump is too large for the opening; None where that is not known."""
        return self.solid.oversize if self.solid else None

    def located(self, T_arm_camera: F64 | None) -> Ore:
        """Return the lump with itself, its solid and its strikes in the arm's frame too."""
        if T_arm_camera is None:
            return self
        solid = self.solid and replace(self.solid, arm=self.solid.moved(T_arm_camera))
        strikes = (replace(strike, arm=strike.moved(T_arm_camera)) for strike in self.plan.strikes)
        plan = replace(self.plan, strikes=tuple(strikes))
        arm = replace(
            self,
            surface_centroid=transform_points(T_arm_camera, self.surface_centroid),
            solid=solid and solid.arm,
            plan=replace(plan, strikes=tuple(s.arm for s in plan.strikes if s.arm is not None)),
        )
        return replace(self, solid=solid, plan=plan, arm=arm)


@dataclass(frozen=True)
class ForeignBody:
    """Something in view that is no ore.

    `source` is "site" for a place of the site's `keep_out` in which something was seen, "arm" for a
    part of the arm where its posture has it, "image" for what looks like no ore; `pixels` it
    covers, which are the `share` of the part of the image that was looked at; `outline_px` (K, 2)
    of its largest part in the left rectified image.
    """

    name: str
    source: Literal["site", "arm", "image"]
    pixels: int
    share: float
    outline_px: I32

    def __post_init__(self) -> None:
        check_shape(self, "outline_px", self.outline_px, None, 2)


@dataclass(frozen=True)
class FrameResult:
    """All that one frame gave, with the arrays that pictures and stage files are made from (None
    when not reached).

    `fines_share` 0…1 of the screen's visible area is under fines and mud, None where it can't be
    told; `withheld` are the codes of `reasons` for which an "ok" frame has no targets.
    """

    name: str
    index: int
    stamp_ns: int | None
    status: Status
    reasons: tuple[Reason, ...]
    counts: Mapping[str, int]
    grizzly: Grizzly | None = None
    ores: tuple[Ore, ...] = ()
    targets: tuple[int, ...] = ()
    pair: RectifiedPair | None = None
    disparity: Disparity | None = None
    cloud: PointCloud | None = None
    voxels: VoxelCloud | None = None
    filtered: FilterResult | None = None
    surface: Surface | None = None
    ore_map: OreMap | None = None
    foreign: tuple[ForeignBody, ...] = ()
    stages_ms: Mapping[str, float] = field(default_factory=dict)
    stamp_source: StampSource | None = None
    withheld: tuple[str, ...] = ()
    fines_share: float | None = None
