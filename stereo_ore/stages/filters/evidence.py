"""What is known of each point of a cloud, made anew for each pass of a scorer: density at several K, and surfaces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from stereo_ore.stages.filters.neighbours import Index, Neighbours, by_neighbour, columns, search
from stereo_ore.stages.filters.surface import LEAST, fit_planes, log_odds, votes
from stereo_ore.threads import map_rows
from stereo_ore.types import F32

Rows = npt.NDArray[np.int64]

DENSITY_FEATURES = (
    "mean distance, K = 3", "mean distance, K = 8", "mean distance, all K", "neighbours' mean distance, mean",
    "neighbours' mean distance, least", "neighbours' mean distance, deviation", "times chosen", "neighbours chosen",
)  # fmt: skip
PLANE_FEATURES = ("residual", "aside", "thickness", "width", "length", "weight", "residual over thickness")
VOTE_FEATURES = ("near votes", "far votes", "mean vote distance")
ODDS_FEATURES = ("odds", "neighbours' odds")


class Evidence(Protocol):
    """What a scorer's passes are told; the first pass may take fewer features than there are."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of all features."""

    @property
    def prior(self) -> F32:
        """A first noise probability (M,)."""

    def undecided(self, noise: F32) -> Rows:
        """The rows that the next pass judges, after noise probabilities (M,)."""

    def features(self, noise: F32, rows: Rows, number: int) -> F32:
        """Features (len(rows), F) for pass `number`, after noise probabilities (M,)."""


@dataclass(frozen=True)
class BareEvidence:
    """Of a cloud without cues: points in spacings (M, 3), neighbours (M, k), density features (M, 8), first guess."""

    points: F32
    index: Index
    density: F32
    prior: F32

    names = (*DENSITY_FEATURES, *PLANE_FEATURES, *VOTE_FEATURES, *ODDS_FEATURES)

    def undecided(self, noise: F32) -> Rows:
        """All rows: without cues every decision hangs on the neighbours'."""
        return np.arange(len(noise))

    def features(self, noise: F32, rows: Rows, number: int) -> F32:
        """Density, planes through the neighbours and their votes, weighted by how likely each is to be surface."""
        weight, odds = 1 - noise, log_odds(noise)
        planes = fit_planes(self.points, self.index, weight, self.points)
        support = votes(self.points, self.index, weight, planes, self.points)
        table = columns(self.density, planes.shape, support, odds, mean_of(odds, self.index))
        # A copy of all rows of a large cloud would be the greatest memory that there is.
        return table if len(rows) == len(table) else table[rows]


def gather(xyz: F32, k: int) -> BareEvidence:
    """Search the k neighbours of points (M, 3), and measure densities.

    With d_i(K) = 1/ρ = mean distance to the K nearest (equation 2) in units of s, the 20 % quantile of d(8) over the
    cloud: log d(3), log d(8), log d(k); mean, least and deviation (equation 3) of log d(8) over the neighbours; how
    often a point is chosen as a neighbour, and how often its neighbours are. Several K side by side let the scorer
    choose K by the point's own situation, which is what equation 5 is for.

    The first noise probability is 1 − min(1, (s/d(8))³).
    """
    neighbours = search(xyz, k)
    means = mean_distances(neighbours.distance)
    spacing = max(float(np.quantile(means[:, 1], 0.2)), float(np.finfo(np.float32).tiny))
    density = _density(neighbours, means / np.float32(spacing))
    prior = 1 - np.minimum(1, np.exp(-3 * density[:, 1]))
    points = columns((xyz - np.median(xyz, axis=0)) / spacing)
    return BareEvidence(points, neighbours.index, density, prior)


def mean_distances(distance: F32) -> F32:
    """Mean distances (M, 3) to the nearest 3, 8 and all of k sorted neighbours (M, k)."""
    return map_rows(lambda rows: columns(*(distance[rows, :n].mean(1) for n in (3, 8, None))), len(distance))


def mean_of(values: F32, index: Index) -> F32:
    """Mean of values (N,) over the neighbours (M, k) of each point, (M,)."""
    return map_rows(lambda rows: values.take(by_neighbour(index, rows)).mean(0), len(index))


def _density(neighbours: Neighbours, means: F32) -> F32:
    """Density features (M, 8) from mean distances (M, 3) in spacings."""
    index = neighbours.index
    own = np.log(means + np.float32(LEAST))
    chosen = (np.bincount(index.ravel("K"), minlength=len(index)) / neighbours.k).astype(np.float32)

    def around(rows: slice) -> F32:
        near = by_neighbour(index, rows)
        d = own[:, 1].take(near)
        return columns(d.mean(0), d.min(0), d.std(0), np.log(chosen[rows] + LEAST), chosen.take(near).mean(0))

    return columns(own, map_rows(around, len(index)))
