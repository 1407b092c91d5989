"""What flows from one stage to the next: pairs, disparity, clouds, masks, the screen, labels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from stereo_ore.types.arrays import F32, F64, I16, I32, U8, Mask, check_shape
from stereo_ore.types.geometry import Plane, Region, Rig, on_rays

StampSource = Literal[
    "header", "csv", "container", "file name", "modification time", "arrival", "options"
]
"""Where a frame's stamp comes from: a message's header, a table of stamps beside the images
(EuRoC), a video's or bag's own time, a name, a file, the clock of this machine, or ``--start-time``
and ``--fps``."""


@dataclass(frozen=True)
class StereoPair:
    """One recorded pair as read: BGR images, (H, W, 3) uint8, of one size; its stamp in ns since
    1970, UTC.
    """

    left: U8
    right: U8
    name: str = "pair"
    index: int = 0
    stamp_ns: int | None = None
    stamp_source: StampSource | None = None

    def __post_init__(self) -> None:
        check_shape(self, "left", self.left, None, None, 3)
        check_shape(self, "right", self.right, *self.left.shape)


@dataclass(frozen=True)
class RectifiedPair:
    """Row-aligned BGR images and their geometry."""

    left: U8
    right: U8
    rig: Rig

    def __post_init__(self) -> None:
        check_shape(self, "left", self.left, self.rig.height, self.rig.width, 3)
        check_shape(self, "right", self.right, self.rig.height, self.rig.width, 3)


@dataclass(frozen=True)
class Disparity:
    """Left-to-right disparity, (H, W) float32 [px], NaN where there is none, with the matcher's
    doubts.

    `confidence` (H, W) float32 is the probability that a disparity is within a pixel of the truth,
    NaN where there is none. `measured` (H, W) float32 [px] holds those too that are less likely
    than `matching.min_confidence`; None: there are no others. `cues` maps names of `CUES` to (h, w)
    float32 arrays of the region's pixels (any subset); `diagnostics` are counts and settings used.
    """

    values: F32
    region: Region
    confidence: F32
    cues: Mapping[str, F32] = field(default_factory=dict)
    diagnostics: Mapping[str, Any] = field(default_factory=dict)
    measured: F32 | None = None

    def __post_init__(self) -> None:
        check_shape(self, "values", self.values, None, None)
        check_shape(self, "confidence", self.confidence, *self.values.shape)
        for name, cue in self.cues.items():
            check_shape(self, f"cues[{name!r}]", cue, *self.values[self.region.slices].shape)
        if self.measured is not None:
            check_shape(self, "measured", self.measured, *self.values.shape)

    def is_known(self, pixel: I32) -> Mask:
        """Whether flat pixel indices (N,) have a value that is likely enough."""
        return np.isfinite(self.values.ravel()[pixel])

    def unsifted(self) -> Disparity:
        """The same with all that was measured as its values: what the filter judges."""
        return self if self.measured is None else replace(self, values=self.measured, measured=None)


@dataclass(frozen=True)
class Background:
    """The empty screen: median disparity (H, W) float32 [px], NaN = none, its noise [px], and from
    how many frames.
    """

    disparity: F32
    sigma: F32
    frames: int

    def __post_init__(self) -> None:
        check_shape(self, "disparity", self.disparity, None, None)
        check_shape(self, "sigma", self.sigma, *self.disparity.shape)


@dataclass(frozen=True)
class PointCloud:
    """Points of one image: xyz (N, 3) float32 [m], flat pixel index v·W + u (N,), BGR (N, 3), depth
    sigma (N,) [m].

    `image_shape` is (H, W). Points are in ascending pixel order.
    """

    xyz: F32
    pixel: I32
    bgr: U8
    sigma_z: F32
    image_shape: tuple[int, int]

    def __post_init__(self) -> None:
        check_shape(self, "xyz", self.xyz, None, 3)
        for name in ("pixel", "sigma_z"):
            check_shape(self, name, getattr(self, name), len(self.xyz))
        check_shape(self, "bgr", self.bgr, len(self.xyz), 3)

    def __len__(self) -> int:
        return len(self.xyz)


@dataclass(frozen=True)
class VoxelCloud:
    """Points gathered in an anchored grid, sorted by voxel key.

    xyz (M, 3) float32 [m] is the mean of a voxel's points, `count` (M,) how many, `inverse` (N,)
    the voxel of each point. `sigma_z` (M,) [m] is the depth noise expected of one of its points.
    `pixel_m` (M,) [m] is the size of a pixel at its depth. `cues` maps names of `CUES` to (M,)
    means over the points, and is empty for a cloud that no camera made (`sigma_z` and `pixel_m` are
    then zero).
    """

    xyz: F32
    count: I32
    inverse: I32
    size_m: float
    sigma_z: F32
    pixel_m: F32
    cues: Mapping[str, F32] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_shape(self, "xyz", self.xyz, None, 3)
        for name in ("count", "sigma_z", "pixel_m"):
            check_shape(self, name, getattr(self, name), len(self.xyz))
        for name, cue in self.cues.items():
            check_shape(self, f"cues[{name!r}]", cue, len(self.xyz))

    def __len__(self) -> int:
        return len(self.xyz)


def single_voxels(points: F32) -> VoxelCloud:
    """Return a cloud that no camera of ours made, (N, 3) [m], with each point a voxel of its
    own.
    """
    zero, rows = np.zeros(len(points), np.float32), np.arange(len(points), dtype=np.int32)
    return VoxelCloud(points, np.ones(len(points), np.int32), rows, 0.0, zero, zero)


def centred_cloud(xyz: F64) -> VoxelCloud:
    """Return `single_voxels` of points (N, 3) [m] of any origin.

    The cloud lies about its own middle, so that float32 loses nothing to a far origin.
    """
    finite = np.isfinite(xyz).all(1)
    middle = np.median(xyz[finite], axis=0) if finite.any() else np.zeros(3)
    with np.errstate(over="ignore"):
        return single_voxels((xyz - middle).astype(np.float32))


@dataclass(frozen=True)
class FilterResult:
    """Which points to keep and how noisy each looks: keep (M,) bool, score (M,) float32, higher is
    noisier.
    """

    keep: Mask
    score: F32
    diagnostics: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_shape(self, "keep", self.keep, None)
        check_shape(self, "score", self.score, len(self.keep))


@dataclass(frozen=True)
class Bars:
    """The bars of a grizzly in its plane: each bar's centre line is direction·s + across·(phase +
    n·pitch).

    `direction` and `across` are unit vectors (3,) in the plane (camera frame); `phase_m` is
    measured along `across` from the camera frame's origin projected into the plane.
    """

    direction: F64
    across: F64
    pitch_m: float
    phase_m: float
    width_m: float

    def beside(self, point: F64) -> float:
        """How far [m] a point (3,) lies across the middle of the bar nearest to it."""
        off = float(self.across @ point) - self.phase_m
        return off - self.pitch_m * round(off / self.pitch_m)


@dataclass(frozen=True)
class Registration:
    """How the bars' disparity differs from that of the plane where they are known to be.

    `field_px` (3,) is the difference c·(1, x, y) [px] at x = (u − cx)/fx, y = (v − cy)/fy;
    `offset_m` how far the bars seem to lie above that plane, in the median; `tilt_rad` the angle
    between both planes; `worst_m` the largest distance between them over the bars that were seen;
    `sigma_m` the largest standard deviation of the measured plane's height over the screen in view;
    `px_m` the height that a pixel of disparity is there. `slide_m` is how far bars lie to the side
    of the one that the site knows, along normal × direction and less whole pitches, and `turn_rad`
    how they are turned about the normal; None where it knows none.
    """

    field_px: F64
    offset_m: float
    tilt_rad: float
    worst_m: float
    sigma_m: float
    px_m: float
    slide_m: float | None = None
    turn_rad: float | None = None

    def __post_init__(self) -> None:
        check_shape(self, "field_px", self.field_px, 3)


@dataclass(frozen=True)
class Grizzly:
    """The screen: plane of the bar tops, where it came from, its residual, and the bars when they
    are known.

    `opening_m` is the clear distance between the bars, `cross_opening_m` that between the bars that
    run across them in a grid, `cross_bars`.
    """

    plane: Plane
    source: Literal["site", "auto", "background"]
    rms_m: float | None = None
    bars: Bars | None = None
    opening_m: float | None = None
    diagnostics: Mapping[str, Any] = field(default_factory=dict)
    registration: Registration | None = None
    cross_opening_m: float | None = None
    cross_bars: Bars | None = None

    @property
    def openings_m(self) -> tuple[float, ...] | None:
        """Clear sides of the holes [m]: one of slots, two of a grid; None where unknown."""
        if self.opening_m is None:
            return None
        cross = self.cross_opening_m
        return (self.opening_m,) if cross is None else (self.opening_m, cross)


@dataclass(frozen=True)
class Surface:
    """Kept points laid back into the image, cropped to the matched rectangle whose corner is (x0,
    y0).

    xyz (h, w, 3) float32 [m], NaN where no point was kept; bgr (h, w, 3); sigma_z (h, w) float32
    [m]. Full-image pixel of crop pixel (row i, column j): (u, v) = (x0 + j, y0 + i).
    """

    xyz: F32
    bgr: U8
    sigma_z: F32
    x0: int
    y0: int
    rig: Rig

    def __post_init__(self) -> None:
        check_shape(self, "xyz", self.xyz, None, None, 3)
        check_shape(self, "bgr", self.bgr, *self.xyz.shape)
        check_shape(self, "sigma_z", self.sigma_z, *self.xyz.shape[:2])

    def slopes(self, step: int = 1) -> tuple[F64, F64]:
        """x/z (w,) and y/z (h,) of the rays of every `step`-th pixel."""
        h, w = self.sigma_z.shape
        x = (self.x0 + np.arange(0, w, step) - self.rig.cx) / self.rig.fx
        y = (self.y0 + np.arange(0, h, step) - self.rig.cy) / self.rig.fy
        return np.asarray(x), np.asarray(y)

    def on_rays(self, vector: F64, step: int = 1) -> F32:
        """Product of a vector with the rays (x/z, y/z, 1) of every `step`-th pixel, (h, w)."""
        return on_rays(vector, *self.slopes(step))


@dataclass(frozen=True)
class OreMap:
    """Lumps in the image: labels (H, W) int16, 0 = no ore, filled silhouettes; ids 1…n without
    gaps.

    `cut` are the ids whose outline the image border cuts; `diagnostics` counts what was dropped and
    why.
    """

    labels: I16
    cut: frozenset[int] = frozenset()
    diagnostics: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_shape(self, "labels", self.labels, None, None)
