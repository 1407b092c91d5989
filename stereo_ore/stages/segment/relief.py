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

_I64 = npt.NDArray[np.int64]

SAMPLED = 60_000
"""Pixels that the middle depth and the noise are taken from."""


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
    surface: Surface, bars: Bars, depth_m: F32, step: int = 1, at: _I64 | None = None
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
