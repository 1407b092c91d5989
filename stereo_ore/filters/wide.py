"""The wider surroundings of a point, where a clump of noise no longer looks like a surface.

A patch of wrong disparities is smooth inside. Planes through every 16th point, four times as far away, show that it
stands off the surface around it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_ore.filters.neighbours import Index, by_neighbour, columns, map_rows, nearest
from stereo_ore.filters.surface import LEAST, fit_planes, log_odds, votes
from stereo_ore.types import F32

STEP, K = 16, 12
SCALES = (0.5, 1.5)
"""As `surface.SCALES`, for planes through points four times as far away."""

DEEPEST = 20.0
"""Steps in depth beyond this many spacings are all alike."""

FEATURES = (
    "wide residual", "wide aside", "wide thickness", "wide width", "wide length", "wide weight",
    "wide residual over thickness", "wide near votes", "wide far votes", "wide mean vote distance", "wide side",
    "wide distance", "step behind", "step before", "wide odds",
)  # fmt: skip


@dataclass(frozen=True)
class Surroundings:
    """Rows (S,) of the thinned cloud; for each point the nearest of them: index (M, K) into rows, distance (M, K)."""

    rows: Index
    index: Index
    distance: F32


def survey(points: F32) -> Surroundings:
    """Find the K nearest among every 16th of points (M, 3) whose order keeps near ones together."""
    rows = np.arange(min(STEP // 2, len(points) - 1), len(points), STEP)
    return Surroundings(rows, *nearest(points[rows], points, min(K, len(rows))))


def features(points: F32, wide: Surroundings, noise: F32) -> F32:
    """The 15 wide `FEATURES` (M, 15) after noise probabilities (M,).

    The first ten are those of `surface` with the thinned points as neighbours. The side is sign(h)·log(1 + 5|h|) of the
    plane's height h over the point along depth; then the logarithm of the mean distance, the largest steps of the
    neighbours to either side in depth, and the mean of their odds.
    """
    thinned, weight = points[wide.rows], 1 - noise
    at_all = fit_planes(thinned, wide.index, weight[wide.rows], points)
    support = votes(thinned, wide.index, weight[wide.rows], at_all.take(wide.rows), points, SCALES)
    height = at_all.height * np.sign(at_all.normal[:, 2])
    odds, depth = log_odds(noise)[wide.rows], np.ascontiguousarray(thinned[:, 2])

    def around(part: slice) -> F32:
        index = by_neighbour(wide.index, part)
        step = depth.take(index) - points[part, 2]
        return columns(step.min(0), step.max(0), odds.take(index).mean(0))

    steps = map_rows(around, len(points))
    side = np.sign(height) * np.log1p(5 * np.abs(height))
    distance = np.log(wide.distance.mean(1) + LEAST)
    steps[:, :2] = np.clip(steps[:, :2], -DEEPEST, DEEPEST)
    return columns(at_all.shape, support, side, distance, steps)
