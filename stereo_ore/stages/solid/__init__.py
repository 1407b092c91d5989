"""The solid a lump is: its visible surface closed by a stated model of the sides that no camera
saw.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import find_objects

from stereo_ore.config.models import SolidConfig
from stereo_ore.stages.solid.cues import DIMENSIONS, Cues, gather_cues
from stereo_ore.stages.solid.measure import longest_calliper
from stereo_ore.stages.solid.prior import Estimate, load_prior
from stereo_ore.stages.solid.sight import Sight, look_at_lumps
from stereo_ore.types import F64, Grizzly, OreMap, Reason, Solid, Surface

__all__ = [
    "METHOD", "Cues", "Sight", "is_oversize", "looks", "over_hole", "solids", "unknown_within",
]  # fmt: skip

METHOD = "grounded hull corrected by a shape prior"
FARTHEST, _LARGEST = 1.5, 2.5
"""Bounds of the correction: shift of the centre over the lump's size, logarithm of the volume's
ratio."""
CUT_FACTOR = 2.0
"""How much less sure all is of a lump that the image's border cuts."""
_DOUBTED = 0.25
"""Within so many standard deviations of the volume's logarithm a lump may be larger or smaller than
the opening; the middle dimension's own is 0.42 of that."""

Openings = tuple[float, ...] | None
"""Clear sides [m] of the holes of a screen: one of a slot, two of a rectangle; None: unknown."""


def solids(
    surface: Surface, ore_map: OreMap, grizzly: Grizzly, config: SolidConfig
) -> tuple[Solid | None, ...]:
    """Close every lump to a body.

    The visible surface is closed by a shrunken footprint on the screen (the grounded hull). How far
    that is from the truth depends on what the camera saw: the outline, what carries or hides the
    lump, the bars under it, the view. A small network of such cues, fitted to scenes with known
    truth, gives centre of gravity, volume and dimensions with their uncertainties.

    Parameters
    ----------
    surface
        Kept points as an image crop, camera frame, metres.
    ore_map
        Lumps in the whole image, ids 1…n.
    grizzly
        The screen they lie on; bars and opening sharpen the estimate when they are known.

    Returns
    -------
    tuple
        Entry i is the solid of id i + 1, None when too little was seen of it to make one.
    """
    return tuple(
        _solid(*looked, grizzly.openings_m, number in ore_map.cut, config) if looked else None
        for number, looked in enumerate(looks(surface, ore_map, grizzly, config), 1)
    )


def looks(
    surface: Surface, ore_map: OreMap, grizzly: Grizzly, config: SolidConfig
) -> tuple[tuple[Sight, Cues] | None, ...]:
    """What the camera saw of every lump, as `solids` judges it; None when it is too little."""
    h, w = surface.sigma_z.shape
    labels = ore_map.labels[surface.y0 : surface.y0 + h, surface.x0 : surface.x0 + w]
    count = int(ore_map.labels.max(initial=0))
    found: list[tuple[Sight, Cues] | None] = []
    for number, box in enumerate(find_objects(labels, max_label=count) if count else [], 1):
        sight = (
            look_at_lumps(surface, labels, box, number, grizzly.plane, config.min_points)
            if box
            else None
        )
        cues = gather_cues(sight, grizzly.bars, grizzly.opening_m) if sight else None
        found.append((sight, cues) if sight and cues else None)
    return tuple(found)


def _solid(sight: Sight, cues: Cues, openings_m: Openings, cut: bool, config: SolidConfig) -> Solid:
    estimate, s = load_prior().estimate(cues.even, cues.odd), sight.size
    base = cues.body
    shift = (
        np.array([estimate.mean[axis] for axis in "xyz"]) * s
        + [0.0, 0.0, cues.support]
        - base.centroid
    )
    shift *= min(1.0, FARTHEST * s / max(float(np.linalg.norm(shift)), 1e-12))
    ratio = np.clip(estimate.mean["volume"] - np.log(base.volume / s**3), -_LARGEST, _LARGEST)
    volume = float(np.exp(ratio) * base.volume)
    factor = CUT_FACTOR if cut else 1.0
    centre, spread = base.centroid + shift, config.volume_sigmas * estimate.sigma["volume"] * factor
    size = np.sort([s * np.exp(estimate.mean[name]) for name in DIMENSIONS])[::-1]
    bounds = (float(volume * np.exp(-spread)), float(volume * np.exp(spread)))
    vertices = centre + np.exp(ratio / 3) * (base.vertices - base.centroid)
    box_length = float(cues.box.extent[0] * size[0] / longest_calliper(base.vertices))
    return Solid(
        centre_of_gravity=sight.to_camera(centre),
        sigma_m=_sigma(sight, estimate, factor, config),
        volume_m3=volume,
        volume_bounds_m3=bounds,
        box_centre=sight.to_camera(centre + np.exp(ratio / 3) * (cues.box.centre - base.centroid)),
        axes=cues.box.axes @ sight.axes,
        extent_m=np.array([max(size[1], box_length), size[1], size[2]]),
        size_m=size,
        method=METHOD,
        vertices=sight.to_camera(vertices).astype(np.float32),
        oversize=is_oversize(size, openings_m, cut, unknown_within(bounds, config)),
        reasons=(Reason("CUT_BY_IMAGE", "the image's border cuts the lump; it may be larger"),)
        if cut
        else (),
    )


def _sigma(sight: Sight, estimate: Estimate, factor: float, config: SolidConfig) -> F64:
    """Standard deviation (3,) [m] along the camera's axes: the model's error, and a bias common to
    all disparities.
    """
    model = np.array([estimate.sigma[axis] for axis in "xyz"]) * sight.size * factor
    bias = sight.sigma_z * config.bias_share * sight.view
    variance = (model**2) @ sight.axes**2 + (bias @ sight.axes) ** 2
    return np.asarray(np.sqrt(variance))


def is_oversize(
    size_m: Sequence[float] | F64, openings_m: Openings, cut: bool, margin: float
) -> bool | None:
    """Whether a lump is too large for the openings; None when unknown or within the margin.

    Parameters
    ----------
    size_m : (3,) sequence
        Longest, middle and shortest dimension [m].
    openings_m : tuple or None
        Clear sides of the holes [m].
    cut : bool
        The image's border cuts the lump, which may be larger.
    margin : float
        Share of the opening within which nothing is said.
    """
    if openings_m is None:
        return None
    excess = over_hole(size_m, openings_m) - 1.0
    if cut and excess <= margin:
        return None
    return None if abs(excess) <= margin else bool(excess > 0)


def unknown_within(volume_bounds_m3: Sequence[float], config: SolidConfig) -> float:
    """Share of the opening within which it is unknown whether a lump passes: `oversize_margin`, or
    `_DOUBTED` of the standard deviation of the volume's logarithm, by its bounds.
    """
    low, high = volume_bounds_m3
    sigma = np.log(high / max(low, 1e-12)) / (2 * config.volume_sigmas)
    return max(config.oversize_margin, float(np.expm1(_DOUBTED * sigma)))


def over_hole(size_m: Sequence[float] | F64, openings_m: tuple[float, ...]) -> float:
    """How many times larger a hole would have to be for a lump just to pass.

    A slot of width a stops a lump by its middle dimension b: b/a, for lumps lie on their flat side.
    A rectangle a ≤ b lets a lump through that stands up, as an ellipse of its middle and shortest
    dimension M and S at any turn: S ≤ a and M² + S² ≤ a² + b². Of a square that is the sieve's law
    (M² + S²)/2 ≤ a² (Church, McLean and Wolcott 1987).
    """
    middle, shortest = float(size_m[1]), float(size_m[2])
    if len(openings_m) == 1:
        return middle / openings_m[0]
    low, high = sorted(openings_m)
    turned = float(np.hypot(middle, shortest) / np.hypot(low, high))
    return max(shortest / low, turned)
