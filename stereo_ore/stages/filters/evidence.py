"""What is known of each point of a cloud, made anew for each pass of a scorer: density at several
K, and surfaces.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from stereo_ore.stages.filters.neighbours import Index, by_neighbour, columns, search
from stereo_ore.stages.filters.surface import LEAST, SCALES, Voters, fit_weighted_planes, log_odds
from stereo_ore.threads import map_rows, pool
from stereo_ore.types import F32

Rows = npt.NDArray[np.int64]

DENSITY_FEATURES = (
    "mean distance, K = 3", "mean distance, K = 8", "mean distance, all K",
    "neighbours' mean distance, mean",
    "neighbours' mean distance, least", "neighbours' mean distance, deviation", "times chosen",
    "neighbours chosen",
)  # fmt: skip
PLANE_FEATURES = (
    "residual",
    "aside",
    "thickness",
    "width",
    "length",
    "weight",
    "residual over thickness",
)
VOTE_FEATURES = ("near votes", "far votes", "mean vote distance")
ODDS_FEATURES = ("odds", "neighbours' odds")
NEAR_FEATURES = (
    "residual to neighbours'", "residual to theirs", "mean distance, K = 8, to spacing",
    "mean distance, K = 3, to spacing", "neighbours' residual to spacing",
    "neighbours' thickness to spacing",
    "thickness to neighbours'", "residual to spacing",
)  # fmt: skip
"""Logarithms of ratios; the spacing is the local one."""

RESIDUAL_AT, DENSITY_AT, THICKNESS_AT = (
    (0.1, 0.25, 0.5, 0.75, 0.9, 0.97),
    (0.25, 0.5, 0.75, 0.9),
    (0.25, 0.5, 0.75),
)
ODDS_AT = (0.25, 0.5, 0.75, 0.9)
WHOLE_FEATURES = (
    *(f"cloud's residual to spacing, {at:.0%}" for at in RESIDUAL_AT),
    *(f"cloud's mean distance to spacing, {at:.0%}" for at in DENSITY_AT),
    *(f"cloud's thickness to spacing, {at:.0%}" for at in THICKNESS_AT),
    *(f"cloud's odds, {at:.0%}" for at in ODDS_AT), "cloud's noise", "cloud's vote scale",
)  # fmt: skip
"""Quantiles over the cloud; the same for all its points."""

_SURE = 0.01
"""A point below this probability of either verdict is not judged again."""


@dataclass(frozen=True)
class Questions:
    """What a pass is asked: the rows to judge, features (W,) that all share, features (n, F) of a
    slice of the rows.
    """

    rows: Rows
    whole: F32
    table: Callable[[slice], F32]


class Evidence(Protocol):
    """What a scorer's passes are told; the first pass may take fewer features than there are."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of all features, those of the whole cloud last."""

    @property
    def prior(self) -> F32:
        """A first noise probability (M,)."""

    def ask(self, noise: F32, number: int) -> Questions:
        """The questions of pass `number`, after noise probabilities (M,)."""


@dataclass(frozen=True)
class BareEvidence:
    """Of a cloud without cues: points in spacings (M, 3), neighbours (M, k), density features (M,
    8), first guess.

    `here` (M,) is the logarithm of the spacing around a point: the mean over its neighbours of
    their least d(8).
    """

    points: F32
    index: Index
    density: F32
    prior: F32
    here: F32

    names = (
        *DENSITY_FEATURES,
        *PLANE_FEATURES,
        *VOTE_FEATURES,
        *ODDS_FEATURES,
        *NEAR_FEATURES,
        *WHOLE_FEATURES,
    )

    def ask(self, noise: F32, number: int) -> Questions:
        """Density, planes through the neighbours and their votes, weighted by how likely each is to
        be surface.

        The same is then held against the surroundings, and against the cloud as a whole: a rough
        surface and a smooth one with noise differ in that, where single points of both look alike.
        After the first pass only those are judged again that it was not `_SURE` of.
        """
        weight, odds = 1 - noise, log_odds(noise)
        every = number == 0
        rows = (
            np.arange(len(noise))
            if every
            else np.flatnonzero((noise > _SURE) & (noise < 1 - _SURE))
        )
        planes = fit_weighted_planes(self.points, self.index, weight, self.points)
        scales = vote_scales(np.exp(planes.shape[:, 0]), weight)
        voters = Voters.of(self.points, weight, planes)
        rough = mean_of(weight * planes.shape[:, 0], self.index) / (
            mean_of(weight, self.index) + np.float32(1e-3)
        )

        def table(part: slice) -> F32:
            at = part if every else rows[part]
            near = by_neighbour(self.index, at)
            own = (self.density[at], planes.shape[at], voters.votes(near, self.points[at], scales))
            thick = planes.shape[:, 2].take(near).mean(0)
            compared = self._compared(at, planes.shape, rough[at], rough.take(near).mean(0), thick)
            return columns(*own, odds[at], odds.take(near).mean(0), *compared)

        return Questions(rows, self._whole(planes.shape, noise, odds, scales), table)

    def _compared(
        self, at: Rows | slice, shape: F32, rough: F32, rough2: F32, thick2: F32
    ) -> tuple[F32, ...]:
        """`NEAR_FEATURES`, each (n,): the point against its neighbours, and both against the
        spacing around.
        """
        residual, thick, here = shape[at, 0], shape[at, 2], self.here[at]
        d3, d8 = self.density[at, 0], self.density[at, 1]
        return (
            residual - rough, residual - rough2, d8 - here, d3 - here,
            rough2 - here, thick2 - here, thick - thick2, residual - here,
        )  # fmt: skip

    def _whole(self, shape: F32, noise: F32, odds: F32, scales: tuple[float, float]) -> F32:
        """`WHOLE_FEATURES` (19,), over all points, so that their order does not matter."""
        d8, here = self.density[:, 1], self.here
        spread = (
            lambda: quantiles(shape[:, 0] - here, RESIDUAL_AT),
            lambda: quantiles(d8 - here, DENSITY_AT),
            lambda: quantiles(shape[:, 2] - here, THICKNESS_AT),
            lambda: quantiles(odds, ODDS_AT),
        )
        found = np.concatenate(list(pool().map(lambda item: item(), spread)))
        return np.array([*found, noise.mean(dtype=np.float64), np.log(scales[0])], np.float32)


def quantiles(values: F32, at: tuple[float, ...]) -> F32:
    """Quantiles of values (M,), M > 0; a sort is faster than a partition about several places."""
    ordered = np.sort(values)
    place = np.array(at) * (len(ordered) - 1)
    low = place.astype(np.int64)
    high = np.minimum(low + 1, len(ordered) - 1)
    return np.asarray(ordered[low] + (ordered[high] - ordered[low]) * (place - low), np.float32)


def vote_scales(residual: F32, weight: F32) -> tuple[float, float]:
    """`surface.SCALES`, widened with the cloud's roughness: strict is not less than σ of the
    residuals.

    σ of a normal is 3.1 times the lower quartile of |residual|, which outliers hardly move.
    """
    sure = residual[weight > 0.5]
    quartile = float(quantiles(sure if len(sure) > 50 else residual, (0.25,))[0])
    widen = max(1.0, 3.1 * quartile / SCALES[0])
    return SCALES[0] * widen, SCALES[1] * widen


def bare_evidence(xyz: F32, k: int) -> BareEvidence:
    """Search the k neighbours of points (M, 3), and measure densities.

    With d_i(K) = 1/ρ = mean distance to the K nearest (equation 2) in units of s, the 20 % quantile
    of d(8) over the cloud: log d(3), log d(8), log d(k); mean, least and deviation (equation 3) of
    log d(8) over the neighbours; how often a point is chosen as a neighbour, and how often its
    neighbours are. Several K side by side let the scorer choose K by the point's own situation,
    which is what equation 5 is for.

    The first noise probability is 1 − min(1, (s/d(8))³).
    """
    neighbours = search(xyz, k)
    means, index = mean_distances(neighbours.distance), neighbours.index
    # Of a large cloud the distances are among the greatest arrays that there are.
    del neighbours
    spacing = max(float(np.quantile(means[:, 1], 0.2)), float(np.finfo(np.float32).tiny))
    density = _density(index, means / np.float32(spacing))
    prior = 1 - np.minimum(1, np.exp(-3 * density[:, 1]))
    points = columns((xyz - np.median(xyz, axis=0)) / spacing)
    here = mean_of(density[:, DENSITY_FEATURES.index("neighbours' mean distance, least")], index)
    return BareEvidence(points, index, density, prior, here)


def mean_distances(distance: F32) -> F32:
    """Mean distances (M, 3) to the nearest 3, 8 and all of k sorted neighbours (M, k)."""
    return map_rows(
        lambda rows: columns(*(distance[rows, :n].mean(1) for n in (3, 8, None))), len(distance)
    )


def mean_of(values: F32, index: Index) -> F32:
    """Mean of values (N,) over the neighbours (M, k) of each point, (M,)."""
    return map_rows(lambda rows: values.take(by_neighbour(index, rows)).mean(0), len(index))


def _density(index: Index, means: F32) -> F32:
    """Density features (M, 8) from mean distances (M, 3) in spacings."""
    own = np.log(means + np.float32(LEAST))
    chosen = (np.bincount(index.ravel("K"), minlength=len(index)) / index.shape[1]).astype(
        np.float32
    )

    def around(rows: slice) -> F32:
        near = by_neighbour(index, rows)
        d = own[:, 1].take(near)
        return columns(
            d.mean(0), d.min(0), d.std(0), np.log(chosen[rows] + LEAST), chosen.take(near).mean(0)
        )

    return columns(own, map_rows(around, len(index)))
