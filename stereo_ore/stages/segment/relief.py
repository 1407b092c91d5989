"""The relief: how far each pixel stands out of the screen's plane, in pixels of disparity.

In disparity space a plane is a linear function of the pixel and a convex body a concave one (a
chord of the body lies behind its surface, and disparity is linear along the image of a line), while
noise is the same everywhere. So touching lumps are told apart there, not in metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from stereo_ore.types import F32, Bars, Grizzly, Surface

I64 = npt.NDArray[np.int64]

SAMPLED = 60_000
"""Pixels that the middle depth and the noise are taken from."""
OCCLUSION_SLACK, OCCLUSION_EXTRA = 1.3, 2
"""A half occlusion is as wide as the step in disparity beside it; a matcher makes it a little wider
[factor, px]."""


@dataclass(frozen=True)
class Relief:
    """Heights over the screen in the image crop.

    `px` (h, w) float32 is the disparity minus the plane's [px], NaN where none. `sigma_px` is the
    standard deviation of a disparity, `pixel_m` the size of a pixel at the scene's middle depth,
    `px_per_m` what a metre of height makes in disparity there, `per_depth` the height over the
    depth that a pixel of disparity makes anywhere.
    """

    px: F32
    sigma_px: float
    pixel_m: float
    px_per_m: float
    per_depth: float

    def height_m(self, px: F32, depth_m: F32) -> F32:
        """Distance [m] from the plane of points of this relief and depth.

        n·p − offset, with p on a ray whose plane depth is known: −offset · (disparity over the
        plane) / disparity.
        """
        return px * depth_m * np.float32(self.per_depth)


def measure_relief(surface: Surface, grizzly: Grizzly) -> Relief:
    """Relief of a surface with at least one point over the grizzly's plane."""
    rig, plane = surface.rig, grizzly.plane
    focal_baseline = rig.fx * rig.baseline_m
    scale = focal_baseline / plane.offset
    z = surface.xyz[..., 2]
    px = np.float32(focal_baseline) / z
    px -= surface.on_rays(scale * plane.normal)
    step = max(1, round(np.sqrt(z.size / SAMPLED)))
    valid = np.isfinite(z[::step, ::step])
    if not valid.any():
        step, valid = 1, np.isfinite(z)
    some, sigma_z = z[::step, ::step][valid], surface.sigma_z[::step, ::step][valid]
    middle = float(np.median(some))
    sigma = float(np.median(sigma_z / some**2)) * focal_baseline
    return Relief(px, sigma, middle / rig.fx, focal_baseline / middle**2, -1.0 / scale)


def bar_coordinates(
    surface: Surface, bars: Bars, depth_m: F32, step: int = 1, at: I64 | None = None
) -> tuple[F32, F32]:
    """Coordinates across and along the bars [m] of points at these depths on every `step`-th
    pixel's ray.

    `depth_m` is (h, w), or (N,) at the flat indices `at`.
    """
    rays = (surface.on_rays(axis, step) for axis in (bars.across, bars.direction))
    across, along = (ray if at is None else ray.ravel()[at] for ray in rays)
    across *= depth_m
    across -= np.float32(bars.phase_m)
    along *= depth_m
    return across, along


def bar_clearance(across: F32, bars: Bars) -> F32:
    """Distance [m] from the nearest bar's edge, negative over a bar, of coordinates across the bars
    [m].
    """
    pitch = np.float32(bars.pitch_m)
    return np.asarray(
        np.abs(across - pitch * np.round(across / pitch)) - np.float32(bars.width_m / 2),
        dtype=np.float32,
    )


def fill_occlusions(px: F32) -> F32:
    """The relief with half occlusions filled from the farther side, which is what an occluded pixel
    shows.

    A row's gap is filled when it is no wider than the step in disparity to its right can have
    hidden from the right eye.
    """
    width = px.shape[1]
    valid = np.isfinite(px).ravel()
    # A gap lies between a measured pixel and the next one in its row that are no neighbours.
    change = np.flatnonzero(valid[1:] != valid[:-1])[0 if valid[0] else 1 :]
    before, after = change[0 : len(change) // 2 * 2 : 2], change[1::2] + 1
    same_row = before // width == after // width
    before, after = before[same_row], after[same_row]
    far, near = px.ravel()[before], px.ravel()[after]
    length = after - before - 1
    fits = length <= OCCLUSION_SLACK * np.maximum(near - far, 0) + OCCLUSION_EXTRA
    first, length = before[fits] + 1, length[fits]
    inside = np.arange(length.sum()) - np.repeat(np.cumsum(length) - length, length)
    out = px.copy()
    out.ravel()[np.repeat(first, length) + inside] = np.repeat(np.minimum(near, far)[fits], length)
    return out
