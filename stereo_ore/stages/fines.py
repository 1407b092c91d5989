"""How much of the screen lies under fines and mud: what is neither bar, nor open, nor a lump.

What stands over the top of a bar covers it; what lies in a gap at the bars' height, or higher,
closes it. Ties between bars close gaps as well, but in bands that are too narrow to be fines.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from stereo_ore.rays import contained
from stereo_ore.types import F32, Bars, Grizzly, Mask, OreMap, Plane, Surface, Volume

_PIXELS = 25_000
"""Pixels looked at."""
_MARGIN, _BEAM = 0.5, 0.5
"""Width that is left out along the volume's faces, and length at either end of the gaps, as far as
they are closed all across: beams of the frame stand there [openings]."""
_HALO = 0.15
"""Width about lumps and bodies over which their depth is smeared [openings]."""
_BAR, _GAP, _CROSSING = 0.6, 0.5, 1.6
"""Inner shares of the widths of a bar and of a gap that are looked at, since depth is smeared over
edges and in the rest of a gap one sees bars' sides; and widths over which a bar crosses a gap."""
ON, _SIGMAS, CLOSES = 0.06, 3.0, 0.2
"""Height over its top from which on a bar is covered [openings], and the least [standard deviations
of a depth]; and depth beneath the tops down to which a gap is closed [openings]."""
_CELL, _TIE = 0.1, 0.6
"""Lengths along the bars of the cells of a gap, and of what closes it and is no tie [openings]."""
_FEWEST, _LEAST_PX = 100, 3.0
"""Pixels of bars, and of gaps, that tell, and of those looked at that an opening spans."""
_STEEP, _TINY = 0.5, 1e-9
"""Cosine of the angle from the plane's normal up to which a face of the volume stands on it."""


@dataclass(frozen=True)
class _View:
    """Every `step`-th pixel of a surface, (h, w) each: depth of the plane [m], height over it [m]
    and its standard deviation [m], NaN where nothing was measured, and whether it shows the screen.
    """

    surface: Surface
    step: int
    depth: F32
    height: F32
    sigma: F32
    free: Mask

    def along(self, axis: np.ndarray) -> F32:
        """Coordinate along an axis of where rays meet the plane [m]."""
        return np.asarray(self.surface.on_rays(axis, self.step) * self.depth)

    def off_centre(self, bars: Bars) -> F32:
        """Distance from the middle of the nearest bar [m]."""
        turns = (self.along(bars.across) - np.float32(bars.phase_m)) / np.float32(bars.pitch_m)
        return np.asarray(np.abs(turns - np.round(turns)) * np.float32(bars.pitch_m))


def fines_share(
    surface: Surface, screen: Grizzly, volume: Volume | None, ore_map: OreMap, foreign: Mask
) -> float | None:
    """Share 0…1 of the screen's visible area that fines and mud cover; None where it can't be told.

    With the shares f of the bars' tops that are covered and of the gaps that are closed it is
    ``s·f_bars + (1 − s)·f_gaps``, where s = 1 − Π(1 − width/pitch) over the directions of bars is
    the share that is steel.

    Parameters
    ----------
    surface : Surface
        Kept points in the image.
    screen : Grizzly
        Plane and bars.
    volume : Volume or None
        The screen is where its plane lies inside it; without one it is not known where it ends.
    ore_map : OreMap
        Lumps, which hide the screen.
    foreign : (h, w) bool
        Pixels of the surface that show bodies, which hide it too.
    """
    bars, opening_m = screen.bars, screen.opening_m
    if bars is None or volume is None or opening_m is None:
        return None
    view = _view(surface, screen, volume, opening_m, (ore_map, foreign))
    if view is None:
        return None
    both = [each for each in (bars, screen.cross_bars) if each is not None]
    on_bar = np.logical_or.reduce([view.off_centre(b) < _BAR * b.width_m / 2 for b in both])
    gap = view.off_centre(bars) > bars.pitch_m / 2 - _GAP * (bars.pitch_m - bars.width_m) / 2
    for across in both[1:]:
        gap &= view.off_centre(across) > _CROSSING * across.width_m / 2
    on_bar &= view.free
    gap &= view.free
    if min(on_bar.sum(), gap.sum()) < _FEWEST:
        return None
    f_gaps, (first, last) = _closed(view, gap, bars, opening_m)
    along = view.along(bars.direction)
    on_bar &= (along >= first) & (along <= last)
    # What was not measured is NaN, compares false, and covers nothing.
    least = np.maximum(np.float32(ON * opening_m), np.float32(_SIGMAS) * view.sigma)
    weight = view.depth**3
    seen = max(float(weight[on_bar].sum()), _TINY)
    f_bars = float(weight[on_bar & (view.height > least)].sum()) / seen
    steel = 1 - float(np.prod([1 - each.width_m / each.pitch_m for each in both]))
    return steel * f_bars + (1 - steel) * f_gaps


def _view(
    surface: Surface,
    screen: Grizzly,
    volume: Volume,
    opening_m: float,
    hidden: tuple[OreMap, Mask],
) -> _View | None:
    """None where an opening is too small in the image to be looked into."""
    step = max(1, round(float(np.sqrt(surface.sigma_z.size / _PIXELS))))
    slope = surface.on_rays(screen.plane.normal, step)
    depth = np.float32(screen.plane.offset) / slope
    height = surface.xyz[::step, ::step, 2] * slope - np.float32(screen.plane.offset)
    sigma = surface.sigma_z[::step, ::step] * np.abs(slope)
    px_m = step * float(np.median(depth)) / surface.rig.fx
    if not 0 < px_m * _LEAST_PX < opening_m:
        return None
    ore_map, foreign = hidden
    h, w = foreign.shape
    labels = ore_map.labels[surface.y0 : surface.y0 + h, surface.x0 : surface.x0 + w]
    inner = _narrowed(volume, screen.plane, _MARGIN * opening_m)
    free = (depth > 0) & contained(inner, depth, *surface.slopes(step))
    halo = min(round(_HALO * opening_m / px_m), max(depth.shape))
    wide = np.ones((2 * halo + 1, 2 * halo + 1), np.uint8)
    lumps = (labels[::step, ::step] > 0) | foreign[::step, ::step]
    free &= cv2.dilate(lumps.astype(np.uint8), wide) == 0
    return _View(surface, step, depth, height, sigma, free)


def _narrowed(volume: Volume, plane: Plane, margin_m: float) -> Volume:
    """The volume less a margin along those of its faces that stand on the plane."""
    standing = np.abs(volume.T_box_camera[:3, :3] @ plane.normal) < _STEEP
    margin = np.where(standing, margin_m, 0.0)
    return replace(volume, min_m=volume.min_m + margin, max_m=volume.max_m - margin)


def _closed(
    view: _View, gap: Mask, bars: Bars, opening_m: float
) -> tuple[float, tuple[float, float]]:
    """Share of the gaps' area that is closed over more than a tie's length, in plan, and between
    which coordinates along the bars [m] no beam is.
    """
    cell_m = _CELL * opening_m
    across = (view.along(bars.across)[gap] - bars.phase_m) / bars.pitch_m
    cell = np.floor(np.stack([across, view.along(bars.direction)[gap] / cell_m], 1)).astype(np.intp)
    first = cell.min(0)
    cell -= first
    shape = tuple(cell.max(0) + 1)
    place = np.ravel_multi_index((cell[:, 0], cell[:, 1]), shape)
    seen = np.bincount(place, minlength=shape[0] * shape[1]).reshape(shape)
    closed = view.height[gap] > -CLOSES * opening_m
    shut = np.bincount(place, closed, shape[0] * shape[1]).reshape(shape)
    # What lumps hide does not end a stretch.
    full = 2 * shut >= seen
    low, high = _between_beams(2 * (full & (seen > 0)).sum(0) >= (seen > 0).sum(0))
    tie = np.ones((1, round(_TIE / _CELL) + 1), np.uint8)
    long = cv2.morphologyEx(full[:, low:high].astype(np.uint8), cv2.MORPH_OPEN, tie)
    share = (shut[:, low:high] * long).sum() / max(seen[:, low:high].sum(), 1)
    return float(share), ((first[1] + low) * cell_m, (first[1] + high) * cell_m)


def _between_beams(closed: Mask) -> tuple[int, int]:
    """First line across the gaps (n,) that is not the frame's, and the one after the last."""
    most = min(round(_BEAM / _CELL), len(closed) // 2)
    ends = (closed[:most], closed[::-1][:most])
    low, high = (most if end.all() else int(end.argmin()) for end in ends)
    return low, len(closed) - high
