"""Where things are: cameras, the rectified rig, planes, volumes, the site."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from stereo_ore.types.arrays import F32, F64, Mask, check_shape


@dataclass(frozen=True)
class CameraModel:
    """Pinhole intrinsics of one eye: fx, fy, cx, cy [px] and OpenCV distortion coefficients (0, 4,
    5, 8, 12 or 14).

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

    @property
    def fingerprint(self) -> str:
        """Twelve hexadecimal digits that change with any number of the calibration, in any format
        that it is written in; not with the name of the camera.
        """
        eyes = [
            (eye.focal_px, eye.principal_point_px, eye.distortion, eye.projection)
            for eye in (self.left, self.right)
        ]
        turn = np.round(np.concatenate([self.R_right_left.ravel(), self.t_right_left]), 9) + 0.0
        numbers = (self.image_size, eyes, turn.tolist(), self.images, self.disparity_offset_px)
        return hashlib.sha256(repr(numbers).encode()).hexdigest()[:12]

    def __post_init__(self) -> None:
        check_shape(self, "R_right_left", self.R_right_left, 3, 3)
        check_shape(self, "t_right_left", self.t_right_left, 3)


@dataclass(frozen=True)
class Rig:
    """Geometry of a rectified pair: rows aligned, depth z = fx·B / (d + doffs), doffs = cx_right −
    cx.

    `disparity_offset_px` is the calibration's own correction: it is added to each measured
    disparity by the matcher, so a `Disparity` already holds it.
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

    @property
    def shift_px(self) -> float:
        """What turns a disparity as it is measured into fx·B / z [px]: what lies at infinity is
        measured at minus this.
        """
        return self.doffs_px + self.disparity_offset_px

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
        return (
            np.asarray(depth_m, dtype=np.float64) ** 2
            / (self.fx * self.baseline_m)
            * disparity_sigma_px
        )

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
class Plane:
    """Points p with normal·p = offset [m]; the unit normal points towards the camera."""

    normal: F64
    offset: float

    def __post_init__(self) -> None:
        check_shape(self, "normal", self.normal, 3)

    def height(self, xyz: npt.ArrayLike) -> F64:
        """Signed distance [m] of (..., 3) points, positive on the camera's side."""
        return np.asarray(xyz, dtype=np.float64) @ self.normal - self.offset


def on_rays(vector: F64, x: F64, y: F64) -> F32:
    """Product of a vector with the rays (x, y, 1) of slopes x (w,) and y (h,), (h, w): linear in
    the pixel.
    """
    across, down = (
        (vector[0] * x).astype(np.float32),
        (vector[1] * y + vector[2]).astype(np.float32),
    )
    return np.asarray(across[None, :] + down[:, None])


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
        inside = np.ones(xyz.shape[:-1], bool)
        # Row by row: for thin matrices that is faster than a product, which would also wake a pool
        # of threads.
        for row, low, high in zip(
            self.T_box_camera.astype(xyz.dtype), self.min_m, self.max_m, strict=False
        ):
            p = xyz[..., 0] * row[0] + xyz[..., 1] * row[1] + xyz[..., 2] * row[2] + row[3]
            inside &= (p >= low) & (p <= high)
        return inside

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
