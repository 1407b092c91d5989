"""The grizzly: bars, cross ties and frame; the pit with rubble under it and the floor around it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_ore.lab.synth.mesh import Mesh, box, merge, prism, rectangle
from stereo_ore.lab.synth.rocks import random_rotation, rock
from stereo_ore.types import F64

_ROUND_SIDES = 24


@dataclass(frozen=True)
class Screen:
    """A grizzly in its own frame: origin in the middle of the bar tops, bars along y, z up; all
    lengths in metres.

    `size` is the clear inside of the frame (x, y), whose top lies `rise` above the bars. With a
    `cross_opening` bars run across these too, as wide and as high, so far apart: a grid, without
    ties. `round` bars are as deep as wide. With a `step` it has two tiers: what lies at x < 0 is so
    much lower.
    """

    opening: float
    bar_width: float
    bar_depth: float
    size: tuple[float, float]
    frame_width: float
    ties: int
    pit_depth: float
    rise: float = 0.0
    cross_opening: float | None = None
    round: bool = False
    step: float = 0.0

    @property
    def bar_centres(self) -> F64:
        """Positions x of the bars' middles: as many as fit, one pitch apart, symmetric."""
        return self._centres(self.size[0], self.opening)

    @property
    def cross_centres(self) -> F64:
        """Positions y of the middles of the bars across, likewise."""
        return (
            self._centres(self.size[1], self.cross_opening) if self.cross_opening else np.empty(0)
        )

    @property
    def openings(self) -> tuple[float, ...]:
        """Clear sides of a hole: one of a slot, two of a grid."""
        return (self.opening, self.cross_opening) if self.cross_opening else (self.opening,)

    def _centres(self, length: float, opening: float) -> F64:
        pitch = opening + self.bar_width
        count = int((length - opening) / pitch + 1e-9)
        return np.asarray((np.arange(count) - (count - 1) / 2) * pitch, np.float64)

    @property
    def cell(self) -> float:
        """Edge of the cells that faces are divided into, so that light can vary along them."""
        return max(self.size) / 60


def bars(screen: Screen) -> Mesh:
    """Bars, those across them in a grid, else ties between them with their tops a little lower."""
    x, y = np.array(screen.size) / 2
    parts = [
        _lowered(_bar(screen, np.array([at, -y]), np.array([at, y])), screen.step * (at < 0))
        for at in screen.bar_centres
    ]
    tiers = ((-x, x, 0.0),) if not screen.step else ((-x, 0.0, screen.step), (0.0, x, 0.0))
    for left, right, drop in tiers:
        for at in screen.cross_centres:
            bar = _bar(screen, np.array([left, at]), np.array([right, at]))
            parts.append(_lowered(bar, drop))
        parts += [_lowered(tie, drop) for tie in _ties(screen, left, right)]
    return merge(parts)


def _ties(screen: Screen, left: float, right: float) -> list[Mesh]:
    """Ties between two places x; none in a grid."""
    y, depth, thick = screen.size[1] / 2, screen.bar_depth, 0.2 * screen.bar_width
    count = 0 if screen.cross_opening else screen.ties
    return [
        box((left, at - thick, -0.45 * depth), (right, at + thick, -0.12 * depth), screen.cell)
        for at in (np.arange(count) + 1) / (count + 1) * 2 * y - y
    ]


def _lowered(mesh: Mesh, drop: float) -> Mesh:
    return mesh.moved(np.eye(3), np.array([0.0, 0.0, -drop])) if drop else mesh


def _bar(screen: Screen, start: F64, end: F64) -> Mesh:
    """A bar along x or y between two places, its top at height 0."""
    half = screen.bar_width / 2
    if screen.round:
        low, high = (np.array([*at, -half]) for at in (start, end))
        return prism(low, high, half, _ROUND_SIDES)
    wide = half * (end - start == 0)
    low, high = start - wide, end + wide
    return box((low[0], low[1], -screen.bar_depth), (high[0], high[1], 0), screen.cell)


def frame(screen: Screen) -> Mesh:
    """Four beams around the screen, as high as the bars."""
    (x, y), w, d = np.array(screen.size) / 2, screen.frame_width, -1.2 * screen.bar_depth
    low_high = [
        ((-x - w, -y - w), (-x, y + w)),
        ((x, -y - w), (x + w, y + w)),
        ((-x, y), (x, y + w)),
        ((-x, -y - w), (x, -y)),
    ]
    return merge([box((*low, d), (*high, screen.rise), screen.cell) for low, high in low_high])


def legs(screen: Screen) -> Mesh:
    """Four legs under the frame's corners, down to the floor."""
    (x, y), w = np.array(screen.size) / 2, screen.frame_width
    corners = [(sx * (x + w / 2), sy * (y + w / 2)) for sx in (-1, 1) for sy in (-1, 1)]
    low = (-screen.pit_depth, -screen.bar_depth)
    return merge(
        [
            box((a - w / 2, b - w / 2, low[0]), (a + w / 2, b + w / 2, low[1]), 0.1)
            for a, b in corners
        ]
    )


def ground(screen: Screen, level: float, reach: float) -> Mesh:
    """The floor around the frame, `level` below the bar tops, out to `reach`."""
    x, y = np.array(screen.size) / 2 + screen.frame_width * 0.5
    sides = [
        ((-reach, -reach), (-x, reach)),
        ((x, -reach), (reach, reach)),
        ((-x, y), (x, reach)),
        ((-x, -reach), (x, -y)),
    ]
    return merge([_flat(low, high, -level, reach / 40) for low, high in sides])


def pit(screen: Screen) -> Mesh:
    """Walls and bottom of the pit."""
    (x, y), d, cell = (
        np.array(screen.size) / 2 + screen.frame_width * 0.4,
        screen.pit_depth,
        screen.cell,
    )
    up = np.array([0, 0, d])
    corners = np.array([(-x, -y, -d), (x, -y, -d), (x, y, -d), (-x, y, -d)])
    walls = [
        rectangle(a, b - a, up, cell, flip=True)
        for a, b in zip(corners, np.roll(corners, -1, 0), strict=True)
    ]
    return merge([*walls, _flat((-x, -y), (x, y), -d, cell)])


def rubble(screen: Screen, rng: np.random.Generator, size: float, count: int, heap: float) -> Mesh:
    """Stones about `size` long on the bottom, heaped up to `heap` times the pit's depth around a
    random middle.
    """
    shapes = [rock(rng, kind, 1.0, 2) for kind in ("chunk", "block", "slab", "chunk", "long")]
    half, stones = np.array(screen.size) / 2, []
    middle = rng.uniform(-0.4, 0.4, 2) * half
    for _ in range(count):
        xy = rng.uniform(-1, 1, 2) * half
        height = heap * screen.pit_depth * np.exp(-(((xy - middle) / (0.6 * half)) ** 2).sum())
        at = np.array([*xy, height - screen.pit_depth + rng.uniform(0, 0.5) * size])
        scale = size * rng.uniform(0.6, 1.6)
        stones.append(shapes[rng.integers(len(shapes))].moved(scale * random_rotation(rng), at))
    return merge(stones)


def _flat(low: tuple[float, float], high: tuple[float, float], z: float, cell: float) -> Mesh:
    return rectangle(
        np.array([*low, z]),
        np.array([high[0] - low[0], 0.0, 0.0]),
        np.array([0.0, high[1] - low[1], 0.0]),
        cell,
    )
