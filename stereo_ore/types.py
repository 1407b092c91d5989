"""The values that flow from stage to stage: frozen, their shapes checked when they are made.

Units are metres, pixels, radians and nanoseconds. The frame is the rectified left camera (x right, y down, z forward)
unless a name says otherwise. A missing measurement is NaN.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
I32 = npt.NDArray[np.int32]
I16 = npt.NDArray[np.int16]
U8 = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

CUES = ("valid_share", "spread_px", "lr_diff_px", "texture", "photometric", "median_diff_px")
"""What the matcher knows about a pixel beside its disparity; `Disparity.cues` and `VoxelCloud.cues` are keyed by these.

valid_share     share of pixels with a disparity in a window around it, 0…1
spread_px       local spread of disparity (robust standard deviation in a window), px
lr_diff_px      |left-right − right-left| disparity difference, px
texture         root mean square of the horizontal image gradient in a window, grey levels a px
photometric     mean absolute grey difference of the matched windows over the texture, dimensionless
median_diff_px  |disparity − its local median|, px
"""


def check_shape(owner: object, name: str, array: npt.NDArray[Any], *shape: int | None) -> None:
    """Raise ValueError saying what was expected and what came, where None stands for any length."""
    fits = array.ndim == len(shape) and all(want in (None, have) for want, have in zip(shape, array.shape, strict=True))
    if not fits:
        wanted = ", ".join("any" if want is None else str(want) for want in shape)
        raise ValueError(f"{type(owner).__name__}.{name} must have shape ({wanted}), not {array.shape}")


@dataclass(frozen=True)
class StereoPair:
    """One recorded pair as read: BGR images, (H, W, 3) uint8, of one size."""

    name: str
    index: int
    left: U8
    right: U8
    stamp_ns: int | None = None

    def __post_init__(self) -> None:
        check_shape(self, "left", self.left, None, None, 3)
        check_shape(self, "right", self.right, *self.left.shape)


@dataclass(frozen=True)
class CameraModel:
    """Pinhole intrinsics of one eye: fx, fy, cx, cy [px] and OpenCV distortion coefficients (0, 4, 5 or 8).

    `projection` "equidistant" takes 4 coefficients of the Kannala-Brandt model (`cv2.fisheye`).
    """

    focal_px: tuple[float, float]
    principal_point_px: tuple[float, float]
    distortion: tuple[float, ...] = ()
    projection: Literal["pinhole", "equidistant"] = "pinhole"

    @property
    def K(self) -> F64:  # noqa: N802 - the field's symbol
        """The (3, 3) camera matrix."""
        (fx, fy), (cx, cy) = self.focal_px, self.principal_point_px
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], float)


@dataclass(frozen=True)
class StereoCalibration:
    """A stereo rig: X_right = R_right_left · X_left + t_right_left [m]."""

    image_size: tuple[int, int]
    left: CameraModel
    right: CameraModel
    R_right_left: F64
    t_right_left: F64
    images: Literal["rectified", "raw"] = "rectified"
    disparity_offset_px: float = 0.0
    camera: str = ""

    def __post_init__(self) -> None:
        check_shape(self, "R_right_left", self.R_right_left, 3, 3)
        check_shape(self, "t_right_left", self.t_right_left, 3)


@dataclass(frozen=True)
class Rig:
    """Geometry of a rectified pair: rows aligned, depth z = fx·B / (d + doffs), doffs = cx_right − cx.

    `disparity_offset_px` is the calibration's own correction: it is added to each measured disparity by the matcher,
    so a `Disparity` already holds it.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    baseline_m: float
    doffs_px: float = 0.0
    disparity_offset_px: float = 0.0

    def depth(self, disparity_px: npt.ArrayLike) -> F64:
        """Depth z [m]; NaN where the disparity is NaN or stands for no finite positive depth."""
        d = np.asarray(disparity_px, dtype=np.float64) + self.doffs_px
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(d > 0, self.fx * self.baseline_m / d, np.nan)

    def disparity(self, depth_m: npt.ArrayLike) -> F64:
        """Disparity [px] of points at depth z > 0 [m]."""
        return self.fx * self.baseline_m / np.asarray(depth_m, dtype=np.float64) - self.doffs_px

    def depth_sigma(self, depth_m: npt.ArrayLike, disparity_sigma_px: float) -> F64:
        """Standard deviation of depth [m]: σ_z = z² / (fx·B) · σ_d."""
        return np.asarray(depth_m, dtype=np.float64) ** 2 / (self.fx * self.baseline_m) * disparity_sigma_px

    def project(self, xyz: npt.ArrayLike) -> F64:
        """Pixel coordinates (u, v) of (..., 3) points; NaN behind the camera."""
        p = np.asarray(xyz, dtype=np.float64)
        z = np.where(p[..., 2] > 0, p[..., 2], np.nan)
        return np.stack([self.fx * p[..., 0] / z + self.cx, self.fy * p[..., 1] / z + self.cy], -1)

    def back_project(self, u: npt.ArrayLike, v: npt.ArrayLike, depth_m: npt.ArrayLike) -> F64:
        """Points (..., 3) [m] seen at pixels (u, v) at depth z."""
        z = np.asarray(depth_m, dtype=np.float64)
        x = (np.asarray(u, dtype=np.float64) - self.cx) * z / self.fx
        y = (np.asarray(v, dtype=np.float64) - self.cy) * z / self.fy
        return np.stack(np.broadcast_arrays(x, y, z), -1)


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
class Plane:
    """Points p with normal·p = offset [m]; the unit normal points towards the camera."""

    normal: F64
    offset: float

    def __post_init__(self) -> None:
        check_shape(self, "normal", self.normal, 3)

    def height(self, xyz: npt.ArrayLike) -> F64:
        """Signed distance [m] of (..., 3) points, positive on the camera's side."""
        return np.asarray(xyz, dtype=np.float64) @ self.normal - self.offset


@dataclass(frozen=True)
class Volume:
    """An axis-aligned box of frame `T_box_camera`: min ≤ T_box_camera·X ≤ max [m]."""

    T_box_camera: F64
    min_m: F64
    max_m: F64

    def __post_init__(self) -> None:
        check_shape(self, "T_box_camera", self.T_box_camera, 4, 4)
        check_shape(self, "min_m", self.min_m, 3)
        check_shape(self, "max_m", self.max_m, 3)

    def contains(self, xyz: npt.NDArray[Any]) -> Mask:
        """True for each of (..., 3) camera-frame points inside."""
        T = self.T_box_camera
        p = xyz @ T[:3, :3].T.astype(xyz.dtype) + T[:3, 3].astype(xyz.dtype)
        return np.asarray(((p >= self.min_m) & (p <= self.max_m)).all(-1))

    @property
    def corners(self) -> F64:
        """The eight corners in the camera frame, (8, 3) [m]."""
        lo_hi = np.stack([self.min_m, self.max_m])
        grid = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(-1, 3)
        box = lo_hi[grid, np.arange(3)]
        return np.asarray((box - self.T_box_camera[:3, 3]) @ self.T_box_camera[:3, :3])


@dataclass(frozen=True)
class Region:
    """Where to match: an image rectangle [px] and the disparities that can occur in it."""

    x0: int
    y0: int
    x1: int
    y1: int
    min_disparity: int
    num_disparities: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """Rows and columns of the rectangle."""
        return slice(self.y0, self.y1), slice(self.x0, self.x1)


@dataclass(frozen=True)
class Disparity:
    """Left-to-right disparity, (H, W) float32 [px], NaN where there is none, with the matcher's doubts.

    `cues` maps names of `CUES` to (H, W) float32 arrays (any subset); `diagnostics` are counts and settings used.
    """

    values: F32
    region: Region
    cues: Mapping[str, F32] = field(default_factory=dict)
    diagnostics: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_shape(self, "values", self.values, None, None)
        for name, cue in self.cues.items():
            check_shape(self, f"cues[{name!r}]", cue, *self.values.shape)


@dataclass(frozen=True)
class PointCloud:
    """Points of one image: xyz (N, 3) float32 [m], flat pixel index v·W + u (N,), BGR (N, 3), depth sigma (N,) [m].

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

    xyz (M, 3) float32 [m] is the mean of a voxel's points, `count` (M,) how many, `inverse` (N,) the voxel of each
    point. `sigma_z` (M,) [m] is the depth noise expected of one of its points. `pixel_m` (M,) [m] is the size of a
    pixel at its depth. `cues` maps names of `CUES` to (M,) means over the points, and is empty for a cloud that no
    camera made (`sigma_z` and `pixel_m` are then zero).
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


@dataclass(frozen=True)
class FilterResult:
    """Which points to keep and how noisy each looks: keep (M,) bool, score (M,) float32, higher is noisier."""

    keep: Mask
    score: F32
    diagnostics: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_shape(self, "keep", self.keep, None)
        check_shape(self, "score", self.score, len(self.keep))


@dataclass(frozen=True)
class Bars:
    """The bars of a grizzly in its plane: each bar's centre line is direction·s + across·(phase + n·pitch).

    `direction` and `across` are unit vectors (3,) in the plane (camera frame); `phase_m` is measured along `across`
    from the camera frame's origin projected into the plane.
    """

    direction: F64
    across: F64
    pitch_m: float
    phase_m: float
    width_m: float


@dataclass(frozen=True)
class Grizzly:
    """The screen: plane of the bar tops, where it came from, its residual, and the bars when they are known."""

    plane: Plane
    source: Literal["site", "auto", "background"]
    rms_m: float | None = None
    bars: Bars | None = None
    opening_m: float | None = None
    diagnostics: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Site:
    """Where the camera looks, and the arm; every part may be unknown (None). Plane and volume are in the camera frame.

    `reach_min_m` and `reach_max_m` (3,) bound the tool's tip in the arm frame.
    """

    T_arm_camera: F64 | None = None
    volume: Volume | None = None
    plane: Plane | None = None
    opening_m: float | None = None
    bar_width_m: float | None = None
    background: Path | None = None
    reach_min_m: F64 | None = None
    reach_max_m: F64 | None = None

    def __post_init__(self) -> None:
        if self.T_arm_camera is not None:
            check_shape(self, "T_arm_camera", self.T_arm_camera, 4, 4)


@dataclass(frozen=True)
class Surface:
    """Kept points laid back into the image, cropped to the matched rectangle whose corner is (x0, y0).

    xyz (h, w, 3) float32 [m], NaN where no point was kept; bgr (h, w, 3); sigma_z (h, w) float32 [m].
    Full-image pixel of crop pixel (row i, column j): (u, v) = (x0 + j, y0 + i).
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


@dataclass(frozen=True)
class OreMap:
    """Lumps in the image: labels (H, W) int16, 0 = no ore, filled silhouettes; ids 1…n without gaps.

    `cut` are the ids whose outline the image border cuts; `diagnostics` counts what was dropped and why.
    """

    labels: I16
    cut: frozenset[int] = frozenset()
    diagnostics: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_shape(self, "labels", self.labels, None, None)


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
    ore_map: OreMap | None = None
    stages_ms: Mapping[str, float] = field(default_factory=dict)
