"""What a frame gave: solids, strikes, ores, and the whole result."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from stereo_ore.types.arrays import F32, F64
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


@dataclass(frozen=True)
class Reason:
    """Why something is missing or doubtful: a stable code and a sentence."""

    code: str
    detail: str


@dataclass(frozen=True)
class Solid:
    """A lump as a body: all of it, with a stated model of the sides that no camera saw (camera frame, metres).

    `axes` (3, 3) are the box's unit axes as rows, longest first; `extent_m` the box's lengths along them; `size_m`
    longest, middle and shortest dimension. `sigma_m` (3,) is the standard deviation of the centre of gravity.
    `vertices` (V, 3) is the convex hull of the modelled solid, for pictures.
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


@dataclass(frozen=True)
class Strike:
    """Where and along which unit vector the tool moves into the rock (camera frame)."""

    point: F64
    direction: F64
    slope_rad: float
    flatness_m: float
    score: float


@dataclass(frozen=True)
class StrikePlan:
    """The best strike of a lump and its ranked alternates, or none and why."""

    strikes: tuple[Strike, ...]
    reasons: tuple[Reason, ...] = ()


@dataclass(frozen=True)
class Ore:
    """One lump: its visible surface, the solid it belongs to, and where to strike."""

    id: int
    points: int
    pixels: int
    cut: bool
    surface_centroid: F64
    solid: Solid | None
    plan: StrikePlan
    reasons: tuple[Reason, ...] = ()


@dataclass(frozen=True)
class FrameResult:
    """All that one frame gave, with the arrays that pictures and stage files are made from (None when not reached)."""

    name: str
    index: int
    stamp_ns: int | None
    status: Literal["ok", "degraded", "empty", "failed"]
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
    stages_ms: Mapping[str, float] = field(default_factory=dict)
    stamp_source: StampSource | None = None
