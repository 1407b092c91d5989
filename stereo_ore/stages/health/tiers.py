"""Whether the working volume holds another tier of bars above the site's plane.

A site has one plane. Bars that lie higher are ore to it, and no other check tells them: they are
straight, lie still, and match well. But they are a comb: narrow tops of one height, parallel to
the bars that are known or across them, evenly spaced, and one sees through between them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, product

import cv2
import numpy as np

from stereo_ore.types import F32, F64, Bars, Grizzly, Mask, Plane, Reason, Surface, Volume

_PIXELS = 12_000
"""Pixels that heights are looked for in."""
_LEAST_RISE, _LEAST_SIGMAS, _BIN = 0.12, 2.5, 0.04
"""Height from which on bars are another tier's [openings, standard deviations of a height], and
bins of height [openings]."""
_LEVELS, _NARROW, _WIDE = 3, 3, 15
"""Heights looked at, and bins over which they stand out from those around."""
_SIGMAS, _FLAT, _MOST = 1.5, 0.04, 0.5
"""What is within so many standard deviations of a height and so many openings of a level lies on
it, at most within this share of its height."""
_CELL, _MOST_CELLS = 0.4, 500
"""Edge of the cells that a level is seen in [widths of a bar], unless that were more cells than
`_MOST_CELLS` in a row."""
_LONG, _WIDEST, _LEAST_CELLS = 1.5, 0.6, 1.5
"""Least length and greatest width of a bar's top [openings], and its least width [cells]."""
_FAR, _UNEVEN, _UNLIKE = 3.0, 0.15, 1.8
"""Greatest distance of neighbours [openings]; by how much of it three may be uneven, and how many
times as wide as another a top may be."""
_BESIDE, _OPEN, _TELLS = 0.5, 0.6, 0.3
"""Share of the shorter one's length by which neighbours lie side by side; of what is seen between
them that is beneath them, and of what lies there that must be seen."""


def tier_doubts(surface: Surface, screen: Grizzly, volume: Volume | None) -> Iterator[Reason]:
    """OTHER_TIER where the working volume shows a comb of bars above the site's plane.

    Parameters
    ----------
    surface : Surface
        What is kept of the cloud, with the bars in the screen's plane; what is missing is taken for
        a way through.
    screen : Grizzly
        Plane and bars; nothing is said of one that was found in the frame itself.
    volume : Volume or None
        Where bars would be taken for ore.
    """
    bars, opening = screen.bars, screen.opening_m
    if volume is None or bars is None or opening is None or screen.source == "auto":
        return
    view = _View(surface, screen.plane, volume, opening)
    for level in view.levels():
        if any(patch.has_comb() for patch in view.patches(level, bars)):
            text = f"bars are seen {1000 * level.height_m:.0f} mm above the screen's plane"
            remedy = "give each tier a site file with a working_volume that ends where it ends"
            yield Reason("OTHER_TIER", f"{text}, within working_volume: {remedy}")
            return


@dataclass(frozen=True)
class _Level:
    """A height [m] at which much is seen, and points (N, 3) [m] that are seen there."""

    height_m: float
    seen: F64


@dataclass(frozen=True)
class _View:
    """What is seen, and the plane, volume and opening [m] that it is looked at with."""

    surface: Surface
    plane: Plane
    volume: Volume
    opening: float

    def levels(self) -> list[_Level]:
        """Heights at which more is seen than a little above and below, clearest first."""
        xyz, height = self._raised()
        if not len(height):
            return []
        bins = (height / (_BIN * self.opening)).astype(np.intp)
        # What is far is seen by fewer pixels.
        count = np.bincount(bins, xyz[:, 2] ** 2).astype(np.float32)[:, None]
        narrow, wide = (
            cv2.blur(count, (1, size), borderType=cv2.BORDER_CONSTANT)[:, 0]
            for size in (_NARROW, _WIDE)
        )
        clear = narrow - wide
        found: list[_Level] = []
        while len(found) < _LEVELS and clear.max() > 0:
            best = int(clear.argmax())
            near = np.abs(bins - best) <= _NARROW // 2
            found.append(_Level(float(np.median(height[near])), xyz[near]))
            clear[max(0, best - _NARROW) : best + _NARROW + 1] = 0
        return found

    def _raised(self) -> tuple[F64, F64]:
        """Points (N, 3) in the volume that may be another tier's, and their heights (N,) [m]."""
        every = self.surface.xyz[:: self._step, :: self._step]
        xyz = every[np.isfinite(every[..., 2])].astype(np.float64)
        height = self.plane.height(xyz)
        least = np.maximum(_LEAST_RISE * self.opening, _LEAST_SIGMAS * self._sigma(xyz[:, 2]))
        xyz, height = xyz[height > least], height[height > least]
        inside = self.volume.contains(xyz)
        return xyz[inside], height[inside]

    def _sigma(self, depth: F64 | F32) -> F64 | F32:
        """Standard deviation [m] of heights at depths [m]: that of a depth grows with its square,
        and |offset| / z of it is along the normal.
        """
        return depth * np.float32(self._noise * abs(self.plane.offset))

    @property
    def _step(self) -> int:
        return max(1, round(float(np.sqrt(self.surface.sigma_z.size / _PIXELS))))

    @cached_property
    def _noise(self) -> float:
        """Standard deviation of a depth over its square [1/m]."""
        every = np.s_[:: self._step, :: self._step]
        noise = self.surface.sigma_z[every] / self.surface.xyz[..., 2][every] ** 2
        known = noise[np.isfinite(noise)]
        return float(np.median(known)) if len(known) else 0.0

    def patches(self, level: _Level, bars: Bars) -> Iterator[_Patch]:
        """A level as seen from above, its rows along the bars, and then across them."""
        offset = self.plane.offset + level.height_m
        axes = np.stack([bars.across, bars.direction], 1)
        places = (level.seen - level.height_m * self.plane.normal) @ axes
        ends, extent = places.min(0), np.ptp(places, axis=0)
        cell = max(_CELL * bars.width_m, float(extent.max()) / _MOST_CELLS)
        counts = [int(length / cell) + 1 for length in extent]
        corner = offset * self.plane.normal + ends[0] * bars.across + ends[1] * bars.direction
        # Column and row of a cell, 1 → a point of the level.
        to_level = np.stack([cell * bars.across, cell * bars.direction, corner], 1)
        on, beneath = self._seen_from_above(to_level, (counts[0], counts[1]), level.height_m)
        yield _Patch(on, beneath, self.opening / cell)
        yield _Patch(on.T, beneath.T, self.opening / cell)

    def _seen_from_above(
        self, to_level: F64, size: tuple[int, int], height_m: float
    ) -> tuple[Mask, Mask]:
        """Which cells (rows, columns) of a level show something on it, and which something beneath
        it or nothing, the way through.
        """
        rig, how = self.surface.rig, cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
        corner = rig.cx - self.surface.x0, rig.cy - self.surface.y0
        K = np.array([[rig.fx, 0, corner[0]], [0, rig.fy, corner[1]], [0, 0, 1]])
        xyz, nothing = self.surface.xyz, (float("nan"),) * 3
        seen = cv2.warpPerspective(xyz, K @ to_level, size, flags=how, borderValue=nothing)[..., 2]
        depth = _over_cells(to_level[2], size)
        depth[depth <= 0] = np.nan
        over = np.float32(self.plane.offset + height_m) * (seen / depth - 1)
        within = _SIGMAS * self._sigma(depth) + np.float32(_FLAT * self.opening)
        inside = self._inside(to_level, size) & np.isfinite(depth)
        on = inside & (np.abs(over) < np.minimum(within, np.float32(_MOST * height_m)))
        return on, inside & ~on & ~(over > 0)

    def _inside(self, to_level: F64, size: tuple[int, int]) -> Mask:
        """Which cells lie in the working volume."""
        volume, inside = self.volume, np.ones(size[::-1], np.bool_)
        for row, low, high in zip(volume.T_box_camera, volume.min_m, volume.max_m, strict=False):
            place = _over_cells(row[:3] @ to_level, size)
            inside &= cv2.inRange(place, float(low - row[3]), float(high - row[3])) > 0
        return inside


def _over_cells(terms: F64, size: tuple[int, int]) -> F32:
    """What is linear in column and row of cells, with a constant, (rows, columns)."""
    across = terms[0] * np.arange(size[0], dtype=np.float32)
    along = terms[1] * np.arange(size[1], dtype=np.float32)
    return np.asarray((across[None] + (along + terms[2])[:, None]), np.float32)


@dataclass(frozen=True)
class _Top:
    """The top of a bar in the cells of a patch: its middle across, its ends along, and its
    width.
    """

    at: float
    low: int
    high: int
    width: float


@dataclass(frozen=True)
class _Patch:
    """What is seen of a level in cells, bars running along the columns: what lies on it, and where
    one sees beneath it; and the opening [cells].
    """

    on: Mask
    beneath: Mask
    opening: float

    def has_comb(self) -> bool:
        """Whether three tops are alike and evenly spaced, side by side, and one sees through
        between them.
        """
        pairs = [pair for pair in combinations(self._tops(), 2) if self._are_neighbours(*pair)]
        return any(
            b is second and _is_even(a, b, c) for (a, b), (second, c) in product(pairs, pairs)
        )

    def _tops(self) -> list[_Top]:
        """Narrow, long and straight tops, from left to right."""
        long = max(2, round(_LONG * self.opening))
        runs, holes = np.ones((long, 1), np.uint8), np.ones((3, 1), np.uint8)
        filled = cv2.morphologyEx(self.on.astype(np.uint8), cv2.MORPH_CLOSE, holes)
        # Nothing runs on beyond the patch.
        padded = cv2.copyMakeBorder(filled, long, long, 0, 0, cv2.BORDER_CONSTANT)
        straight = cv2.morphologyEx(padded, cv2.MORPH_OPEN, runs)[long:-long]
        _, _, stats, centres = cv2.connectedComponentsWithStats(straight, connectivity=4)
        tops = []
        for (_, low, _, length, area), (at, _) in zip(stats[1:], centres[1:], strict=True):
            width = float(area / length)
            if _LEAST_CELLS <= width < _WIDEST * self.opening:
                tops.append(_Top(float(at), int(low), int(low + length), width))
        return sorted(tops, key=lambda top: top.at)

    def _are_neighbours(self, left: _Top, right: _Top) -> bool:
        widths, step = (left.width, right.width), right.at - left.at
        alike = max(widths) < _UNLIKE * min(widths)
        apart = max(widths) / _WIDEST < step < _FAR * self.opening
        return alike and apart and self._is_open_between(left, right)

    def _is_open_between(self, left: _Top, right: _Top) -> bool:
        low, high = max(left.low, right.low), min(left.high, right.high)
        if high - low < _BESIDE * min(left.high - left.low, right.high - right.low):
            return False
        first, last = left.at + left.width / 2 + 1, right.at - right.width / 2
        part = np.s_[low:high, round(first) : round(last)]
        beneath, on = int(self.beneath[part].sum()), int(self.on[part].sum())
        told = beneath + on
        return told > _TELLS * self.on[part].size and beneath > _OPEN * told


def _is_even(a: _Top, b: _Top, c: _Top) -> bool:
    steps = b.at - a.at, c.at - b.at
    return abs(steps[1] - steps[0]) < _UNEVEN * min(steps)
