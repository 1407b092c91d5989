"""The solid a lump is: its visible surface closed by a stated model of the sides that no camera saw."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull

from stereo_ore.config.models import SolidConfig
from stereo_ore.solid.measure import convex_body, longest_calliper, smallest_box
from stereo_ore.transforms import frame_from_normal
from stereo_ore.types import F64, Grizzly, Mask, OreMap, Solid, Surface

__all__ = ["solids"]


def solids(surface: Surface, ore_map: OreMap, grizzly: Grizzly, config: SolidConfig) -> tuple[Solid | None, ...]:
    """Close every lump to a body.

    Parameters
    ----------
    surface
        Kept points as an image crop, camera frame, metres.
    ore_map
        Lumps in the whole image, ids 1…n.
    grizzly
        The screen they lie on.

    Returns
    -------
    tuple
        Entry i is the solid of id i + 1, None when too few points were seen to make one.
    """
    h, w = surface.sigma_z.shape
    labels = ore_map.labels[surface.y0 : surface.y0 + h, surface.x0 : surface.x0 + w]
    seen = np.isfinite(surface.xyz[..., 2]) & (labels > 0)
    return tuple(
        _solid(surface, seen & (labels == i), grizzly, config) for i in range(1, int(ore_map.labels.max()) + 1)
    )


def _solid(surface: Surface, mask: Mask, grizzly: Grizzly, config: SolidConfig) -> Solid | None:
    points = surface.xyz[mask].astype(np.float64)
    if len(points) < config.min_points:
        return None
    axes = frame_from_normal(grizzly.plane.normal, np.array([1.0, 0.0, 0.0]))
    origin = grizzly.plane.normal * grizzly.plane.offset
    local = (points[:: max(1, len(points) // 3000)] - origin) @ axes.T
    body = convex_body(np.vstack([local, _footprint(local, 0.6)]))
    if body is None:
        return None
    centre, box, extent = smallest_box(body)
    longest = longest_calliper(body.vertices)
    size = np.array([longest, extent[1], extent[2]])
    sigma = 0.05 * longest * np.ones(3)
    return Solid(
        centre_of_gravity=body.centroid @ axes + origin,
        sigma_m=sigma,
        volume_m3=body.volume,
        volume_bounds_m3=(0.6 * body.volume, 1.6 * body.volume),
        box_centre=centre @ axes + origin,
        axes=box @ axes,
        extent_m=extent,
        size_m=size,
        method="hull",
        vertices=(body.vertices @ axes + origin).astype(np.float32),
        oversize=_oversize(extent[1], grizzly.opening_m, config.oversize_margin),
    )


def _footprint(local: F64, shrink: float) -> F64:
    """Outline of (N, 3) points from above, shrunk about its middle and laid on the plane z = 0."""
    outline = local[ConvexHull(local[:, :2]).vertices, :2]
    middle = outline.mean(0)
    return np.column_stack([middle + shrink * (outline - middle), np.zeros(len(outline))])


def _oversize(middle: float, opening: float | None, margin: float) -> bool | None:
    if opening is None or abs(middle / opening - 1.0) < margin:
        return None
    return bool(middle > opening)
