"""The frame around the bars: it may stand above their tops and must not be taken for ore."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from stereo_ore.stages.segment.relief import Relief, bar_coordinates, measure_relief
from stereo_ore.types import F32, F64, Bars, Grizzly, Mask, Surface

CELLS_PER_BAR = 2
"""Cells of the plan view across a bar's width."""
_I64 = npt.NDArray[np.int64]
PLAN_PIXELS = 50_000
"""Pixels looked at."""
CLOSED = 0.5
"""Share of a row of the plan view that is covered where the frame runs."""
FLAT = 0.6
"""Largest median deviation of a frame row's heights, in cells; rows of ore deviate more."""


@dataclass(frozen=True)
class _Side:
    """The frame against one coordinate: `height` (n,) [m] at `low + i·cell`, NaN between the
    frame's two sides.
    """

    low: float
    cell: float
    height: F64

    @property
    def inner(self) -> tuple[float, float]:
        """Between which coordinates [m] the screen is open."""
        open_rows = np.flatnonzero(np.isnan(self.height))
        first, last = (open_rows[0], open_rows[-1] + 1) if len(open_rows) else (0, len(self.height))
        return self.low + self.cell * float(first), self.low + self.cell * float(last)


@dataclass(frozen=True)
class _Frame:
    """The frame's sides against the coordinate across the bars and the one along them."""

    sides: tuple[_Side, _Side]

    def inside(self, c: F32, s: F32) -> F32:
        """Distance [m] of points from the nearest side, negative outside."""
        depth = [
            np.minimum(x - side.inner[0], side.inner[1] - x)
            for side, x in zip(self.sides, (c, s), strict=True)
        ]
        return np.asarray(np.minimum(depth[0], depth[1]), dtype=np.float32)


def find_frame(surface: Surface, relief: Relief, grizzly: Grizzly, bars: Bars) -> _Frame:
    """The frame around the bars.

    The screen is looked at in plan, along and across its bars. Coming from outside, rows of cells
    are closed (floor, frame) up to the first row one sees through: what lies outside that row at
    the row's median height is frame.
    """
    step = max(1, round(np.sqrt(relief.px.size / PLAN_PIXELS)))
    depth = surface.xyz[::step, ::step, 2]
    height = relief.height_m(relief.px[::step, ::step], depth)
    # What is NaN compares false.
    closed = height > -np.maximum(3 * surface.sigma_z[::step, ::step], np.float32(bars.width_m / 4))
    if not closed.any():
        none = _Side(0.0, 1.0, np.array([np.nan]))
        return _Frame((none, none))
    on_plane = np.float32(grizzly.plane.offset) / surface.on_rays(grizzly.plane.normal, step)
    cell = bars.width_m / CELLS_PER_BAR
    coordinates = bar_coordinates(surface, bars, np.where(closed, depth, on_plane), step)
    plan = [_cells(coordinate, coordinate[closed], cell) for coordinate in coordinates]
    inside = np.logical_and.reduce([(index >= 0) & (index < count) for index, _, count in plan])
    i, j = (index[inside].astype(np.intp) for index, _, _ in plan)
    shape = plan[0][2], plan[1][2]
    seen = np.bincount(i * shape[1] + j, minlength=shape[0] * shape[1]).reshape(shape)
    full = np.bincount(i * shape[1] + j, closed[inside], shape[0] * shape[1]).reshape(shape)
    reach = int(np.ceil((bars.pitch_m - bars.width_m) / cell))
    occupied, visible = full * 2 > seen, seen > 0
    low = height[inside] < -bars.width_m / 4
    sides = []
    for axis, (row, other) in enumerate(((i, j), (j, i))):
        through = _span(other[low], shape[1 - axis])
        share = np.take(occupied, through, 1 - axis).sum(1 - axis)
        share = share / np.maximum(np.take(visible, through, 1 - axis).sum(1 - axis), 1)
        at_row = row[closed[inside]]
        heights = _row_heights(share >= CLOSED, at_row, height[inside & closed], reach, cell)
        sides.append(_Side(plan[axis][1], cell, heights))
    return _Frame((sides[0], sides[1]))


def _span(cells: _I64, count: int) -> _I64:
    """The cells between the outermost ones through which one sees; all when one sees through
    none.
    """
    low, high = np.percentile(cells, (2, 98)).astype(int) if len(cells) else (0, count - 1)
    return np.arange(low, high + 1)


def _cells(coordinate: F32, of_points: F32, cell: float) -> tuple[F32, float, int]:
    """Cell index of each pixel, where the cells begin [m], and how many there are between the
    outermost points.
    """
    low, high = np.percentile(of_points, (0.5, 99.5))
    return np.floor((coordinate - low) / cell), float(low), max(int((high - low) / cell), 1)


def _row_heights(closed: Mask, row: np.ndarray, heights: F32, reach: int, cell: float) -> F64:
    """Median height of the flat rows outside the first row that is open, from both ends; NaN
    elsewhere.
    """
    out = np.full(len(closed), np.nan)
    for order in (np.arange(len(closed)), np.arange(len(closed))[::-1]):
        start = np.flatnonzero(closed[order][: reach + 1])
        if not len(start):
            continue
        opening = np.flatnonzero(~closed[order][start[0] :])
        if not len(opening):
            continue
        for r in order[: start[0] + opening[0] + 1]:
            mine = heights[row == r]
            if not len(mine):
                continue
            middle = np.median(mine)
            if np.median(np.abs(mine - middle)) < FLAT * cell and abs(middle) < reach * cell / 2:
                out[r] = middle
    return out


def inside_screen(surface: Surface, grizzly: Grizzly, opening_m: float) -> F32:
    """How far (h, w) [openings, −1…1] points lie inside the screen's sides; 0 where none is.

    All is inside where the bars are not known.
    """
    if (bars := grizzly.bars) is None:
        return np.ones(surface.sigma_z.shape, np.float32)
    relief = measure_relief(surface, grizzly)
    inside = np.zeros(relief.px.shape, np.float32)
    at = np.flatnonzero(np.isfinite(relief.px))
    c, s = bar_coordinates(surface, bars, surface.xyz[..., 2].ravel()[at], at=at)
    frame = find_frame(surface, relief, grizzly, bars)
    inside.ravel()[at] = np.clip(frame.inside(c, s) / opening_m, -1, 1)
    return inside
