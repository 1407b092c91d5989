"""What stands or hangs over the screen and is no ore: far higher over all around it than it is
wide.

Ore rests on the screen or on ore: from above one sees it down to its widest part, and what carries
it close below. A hammer, a chain, a post or a person show a part whose lowest visible point is
higher above everything around than the part is wide.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from stereo_ore.config import ForeignConfig
from stereo_ore.types import F32, F64, I32, Grizzly, Mask, Surface

_PIXELS = 60_000
"""Pixels looked at, about."""
_LEVELS = (0.75, 1.0, 1.4, 1.9, 2.5, 3.3, 4.3, 5.6)
"""Heights over the screen [openings] at which it is cut for parts that stand alone."""
LONG, LONG_WIDTH = 2.5, 1.5
"""From this ratio of length to width on a part is long, and so many widths are its size."""
_FEWEST, FEWEST_AROUND = 20, 15
"""Pixels that a part, and what is known around it, must have."""
LEAST_STANCE, LEAST_SIZE = 2.0, 0.12
"""Height over what is around in openings, times that in the part's own widths, and size [openings]:
a clump of wrong matches is small, too, and low."""
_AROUND = 0.7
"""Width of the ring around a part, in openings."""
HIGH_QUANTILE, LOW_QUANTILE = 75, 5
"""Percentiles of heights: what lies around a part, and its lowest point."""
BRIDGED = 5
"""Pixels without a depth that part no body."""
_THICKER = 1.4
"""Radius of the rod about a part's axis that belongs to it, over what its own points have."""


@dataclass(frozen=True)
class _Grid:
    """Every `step`-th pixel: points (h, w, 3), heights (h, w), in which pixels they are finite."""

    xyz: F32
    height: F32
    seen: Mask
    pixel_m: F32
    step: int


def standing(surface: Surface, screen: Grizzly, opening_m: float, config: ForeignConfig) -> I32:
    """Label what is no ore by its stance (h, w): 0 for all else, then 1…n from the largest on.

    Parameters
    ----------
    surface : Surface
        Kept points in the image.
    screen : Grizzly
        Its plane.
    opening_m : float
        Clear distance between bars, or the scale that stands for it.
    config : ForeignConfig
        How much higher than wide a part must stand.
    """
    grid = _grid(surface, screen)
    found = np.zeros(grid.seen.shape, np.bool_)
    for level in _LEVELS:
        for part in _parts(grid, level * opening_m):
            if not found[part].all() and _stands_alone(grid, part, opening_m, config):
                found |= _whole(grid, part)
    if not found.any():
        return np.zeros(surface.sigma_z.shape, np.int32)
    return _full(_largest_first(found), surface, grid.step)


def _grid(surface: Surface, screen: Grizzly) -> _Grid:
    step = max(1, round(float(np.sqrt(surface.sigma_z.size / _PIXELS))))
    xyz = surface.xyz[::step, ::step]
    height = screen.plane.height(xyz).astype(np.float32)
    pixel_m = xyz[..., 2] * np.float32(step / surface.rig.fx)
    return _Grid(xyz, height, np.isfinite(height), pixel_m, step)


def _parts(grid: _Grid, level_m: float) -> Iterator[Mask]:
    """Connected pixels above a level."""
    above = grid.seen & (grid.height > level_m)
    if not above.any():
        return
    count, labels, stats, _ = cv2.connectedComponentsWithStats(
        above.astype(np.uint8), connectivity=4
    )
    for number in range(1, count):
        if stats[number, cv2.CC_STAT_AREA] >= _FEWEST:
            yield labels == number


def _stands_alone(grid: _Grid, part: Mask, opening_m: float, config: ForeignConfig) -> bool:
    """Whether a part is higher over what is around it than it is wide."""
    size, low = _size(grid, part), float(np.percentile(grid.height[part], LOW_QUANTILE))

    def is_high(gap_m: float) -> bool:
        in_widths = gap_m / size
        return in_widths > config.min_stance and in_widths * gap_m / opening_m > LEAST_STANCE

    # Nearly all parts are too low even over the bars.
    if size < LEAST_SIZE * opening_m or not is_high(low):
        return False
    width_px = max(3, round(_AROUND * opening_m / float(np.median(grid.pixel_m[part]))))
    kernel = np.ones((2 * width_px + 1, 2 * width_px + 1), np.uint8)
    near = (cv2.dilate(part.astype(np.uint8), kernel) > 0) & ~part & grid.seen
    if near.sum() < FEWEST_AROUND:
        return False
    around = max(0.0, float(np.percentile(grid.height[near], HIGH_QUANTILE)))
    return low > around and is_high(low - around)


def _size(grid: _Grid, part: Mask) -> float:
    """Side [m] of the square as large as a part's hull in the image; of a long one its width, and
    a half more. Holes where nothing was measured make no part thinner.
    """
    pixel_m = float(np.median(grid.pixel_m[part]))
    pixels = np.argwhere(part)[:, ::-1].astype(np.int32)
    area = cv2.contourArea(cv2.convexHull(pixels)) * pixel_m**2
    length = float(np.ptp(_axis(grid.xyz[part].astype(np.float64))[1]))
    width = area / max(length, 1e-9)
    return LONG_WIDTH * width if length > LONG * width else float(np.sqrt(area))


def _axis(points: F64) -> tuple[F64, F64]:
    """Direction (3,) in which points (N, 3) extend most, and their coordinates along it (N,)."""
    centred = points - points.mean(0)
    # Without BLAS, whose sums depend on the number of threads.
    axis = np.linalg.eigh(np.einsum("ni,nj->ij", centred, centred))[1][:, 2]
    return axis, np.einsum("ni,i->n", centred, axis)


def _whole(grid: _Grid, part: Mask) -> Mask:
    """The part, and what of the scene lies within the rod that goes on along its axis: a chisel
    down to what it strikes, a post down to its foot.
    """
    points = grid.xyz[part].astype(np.float64)
    axis, along = _axis(points)
    middle = points.mean(0)
    away = points - middle - along[:, None] * axis
    radius = _THICKER * float(np.percentile(np.linalg.norm(away, axis=1), 90))
    rest = grid.xyz - middle.astype(np.float32)
    reach = np.einsum("hwi,i->hw", rest, axis.astype(np.float32))
    with np.errstate(invalid="ignore"):
        across = np.sqrt(np.maximum(np.einsum("hwi,hwi->hw", rest, rest) - reach**2, 0))
        rod = (across < radius) & (grid.height > np.float32(radius))
    # Of the rod only what hangs together with the part, or nearly so.
    whole = rod | part
    labels = _nearly_connected(whole)[1]
    return np.asarray(whole & np.isin(labels, np.unique(labels[part])))


def _largest_first(found: Mask) -> I32:
    count, labels = _nearly_connected(found)
    sizes = np.bincount(labels[found], minlength=count)
    number = np.zeros(count, np.int32)
    number[1 + np.argsort(-sizes[1:], kind="stable")] = np.arange(1, count)
    return np.where(found, number[labels], 0).astype(np.int32)


def _nearly_connected(mask: Mask) -> tuple[int, I32]:
    """Number of labels and labels of a mask whose parts are one when less than `BRIDGED` pixels
    are between them.
    """
    wide = cv2.dilate(mask.astype(np.uint8), np.ones((BRIDGED, BRIDGED), np.uint8))
    count, labels = cv2.connectedComponents(wide, connectivity=8)
    return count, np.asarray(labels, np.int32)


def _full(labels: I32, surface: Surface, step: int) -> I32:
    """Labels of the grid for all pixels of the surface."""
    height, width = surface.sigma_z.shape
    rows, columns = np.arange(height) // step, np.arange(width) // step
    return np.asarray(labels[np.ix_(rows, columns)], np.int32)
