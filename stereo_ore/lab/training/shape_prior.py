"""Fitting of the solids' shape prior to samples: linear models with a robust loss, judged on scenes
left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from stereo_ore.lab.training.solids import SolidSample
from stereo_ore.stages.solid.prior import DOUBTS, TARGETS, Linear, Prior
from stereo_ore.types import F64, Mask

CENTRE, _VOLUME, LONGEST = [0, 1, 6], 2, 3
"""Columns of errors, which are in the order of `TARGETS`, then y."""
_FOLDS = 10
"""Scenes are left out by tenths; of up to ten that come first, each alone."""
_RIDGE, RIDGE_PRODUCTS, RIDGE_ODD = 100.0, 1100.0, 30.0
"""Penalties of squared weights, in samples, of cues, of products of cues, and of odd cues. Errors
on scenes left out are flat there."""
INTERACTING = (
    "tilt", "support", "top", "low", "ring_50", "ring_90", "near", "hidden", "surface_z",
    "outline_z", "frontal",
    "facing", "grounded_volume", "solidity", "across", "on_bars",
)  # fmt: skip
"""Cues of which every product counts; of the others their squares."""
HUBER, _ROUNDS = 1.0, 5
"""Errors beyond so many standard deviations count by their size instead of its square, for medians
are what counts."""
_LEAST_SCALE = 1e-3
"""A cue that varies less than this is not stretched: in few scenes some are constant."""
HELD = 0.95
"""Share of the errors that two sigma hold."""
JUDGED = ("measured", "unplaced")
"""Appearances as the program has them: sigmas describe their errors."""


@dataclass(frozen=True)
class _Quality:
    """Medians over lumps: shift of the centre over the longest dimension, relative errors of volume
    and of the longest.

    `inside` is the share of coordinates of the centre, and `bounded` of volumes, within two sigma.
    """

    lumps: int
    shift: float
    volume: float
    longest: float
    inside: float
    bounded: float

    def __str__(self) -> str:
        medians = (
            f"centre of gravity {self.shift:.1%}, volume {self.volume:.1%}, longest"
            f" {self.longest:.1%}"
        )
        return (
            f"{medians}, within two sigma {self.inside:.1%} and {self.bounded:.1%} ({self.lumps}"
            " lumps)"
        )


@dataclass(frozen=True)
class _Table:
    """Samples as arrays: even (N, K) and odd (N, J) cues, doubts (N, D) after a one, truth (N, 7),
    weights (N,).
    """

    even: F64
    odd: F64
    doubts: F64
    truth: F64
    weight: F64

    @classmethod
    def of(cls, found: Sequence[SolidSample]) -> _Table:
        even, odd = (
            np.array([list(getattr(s.cues, kind).values()) for s in found])
            for kind in ("even", "odd")
        )
        doubts = np.array(
            [[1.0, *(min(s.cues.doubts[name], 1.0) for name in DOUBTS)] for s in found]
        )
        truth = np.array([[s.truth[name] for name in (*TARGETS, "y")] for s in found])
        return cls(even, odd, doubts, truth, np.array([s.weight for s in found]))

    def __getitem__(self, rows: Mask) -> _Table:
        return _Table(
            *(getattr(self, name)[rows] for name in ("even", "odd", "doubts", "truth", "weight"))
        )


def train_prior(found: Sequence[SolidSample]) -> tuple[Prior, F64]:
    """Fit the prior to samples, those of scenes that shall be left out one at a time first.

    Returns
    -------
    Prior
        Its sigmas hold the errors on scenes that were left out of the fit.
    array (N, 7)
        Those errors: the `TARGETS`, then y.
    """
    table, fold = _Table.of(found), _folds(found)
    names = tuple(found[0].cues.even), tuple(found[0].cues.odd)
    errors = np.zeros_like(table.truth)
    for k in np.unique(fold):
        seen, held = table[fold != k], table[fold == k]
        even, odd = _fit(seen, names) if len(seen.truth) else _fit(table, names)
        errors[fold == k] = np.column_stack([even(held.even), odd(held.odd)]) - held.truth
    judged = np.array([sample.seen_as in JUDGED for sample in found])
    sigma = {
        name: _spread(table[judged], errors[judged, t]) for t, name in enumerate((*TARGETS, "y"))
    }
    return Prior(*_fit(table, names), sigma), errors


def prior_quality(found: Sequence[SolidSample], errors: F64, prior: Prior) -> _Quality:
    """Of samples, by their errors (N, 7) and the prior's sigmas."""
    size = np.array([sample.size for sample in found])
    shift = np.linalg.norm(errors[:, CENTRE], axis=1) / size
    volume, longest = np.abs(np.expm1(errors[:, [_VOLUME, LONGEST]])).T
    doubts = _Table.of(found).doubts
    held = np.abs(errors) <= 2 * np.exp(
        doubts @ np.array([prior.sigma[name] for name in (*TARGETS, "y")]).T
    )
    shares = held[:, CENTRE].mean(), held[:, _VOLUME].mean()
    return _Quality(
        len(found), *(float(v) for v in (*map(np.median, (shift, volume, longest)), *shares))
    )


def _folds(found: Sequence[SolidSample]) -> npt.NDArray[np.intp]:
    """Fold of each sample; samples of one scene share it."""
    number = {name: i for i, name in enumerate(dict.fromkeys(sample.scene for sample in found))}
    return np.array([number[sample.scene] % _FOLDS for sample in found])


def _fit(table: _Table, names: tuple[tuple[str, ...], tuple[str, ...]]) -> tuple[Linear, Linear]:
    """Models of the targets from even cues, and of y, without a constant, from odd ones."""
    mean, scale = (
        np.average(table.even, 0, table.weight),
        np.maximum(table.even.std(0), _LEAST_SCALE),
    )
    even = Linear(names[0], _pairs(names[0]), mean, scale, np.zeros(0), np.zeros(0))
    penalty = np.repeat([0.0, _RIDGE, RIDGE_PRODUCTS], [1, len(even.cues), len(even.pairs)])
    terms = np.insert(even.terms(table.even), 0, 1.0, axis=1)
    rows = np.array([_ridge(terms, y, table.weight, penalty) for y in table.truth[:, :-1].T]).T
    scale = np.maximum(np.sqrt((table.odd**2).mean(0)), _LEAST_SCALE)
    odd = Linear(names[1], (), np.zeros(len(scale)), scale, np.zeros(0), np.zeros(1))
    penalty = np.full(len(scale), RIDGE_ODD)
    weights = _ridge(odd.terms(table.odd), table.truth[:, -1], table.weight, penalty)
    return replace(even, weights=rows[1:], constant=rows[0]), replace(odd, weights=weights[:, None])


def _pairs(cues: tuple[str, ...]) -> tuple[tuple[str, str], ...]:
    """Pairs of cues whose products count, squares among them."""
    return tuple(
        (one, other)
        for k, one in enumerate(cues)
        for other in cues[k:]
        if one == other or (one in INTERACTING and other in INTERACTING)
    )


def _ridge(X: F64, y: F64, weight: F64, penalty: F64) -> F64:
    """Weights (K,) of columns that make y (N,) under Huber's loss, by reweighting."""
    w = weight
    for _ in range(_ROUNDS):
        row = np.linalg.solve(X.T @ (w[:, None] * X) + np.diag(penalty), X.T @ (w * y))
        error = np.abs(y - X @ row)
        w = weight * np.minimum(1.0, HUBER * 1.4826 * np.median(error) / np.maximum(error, 1e-12))
    return np.asarray(row)


def _spread(table: _Table, error: F64) -> F64:
    """Log-linear model of an error's standard deviation, raised until two of them hold `HELD` of
    the errors.
    """
    D, w = table.doubts, table.weight
    target = np.log(np.abs(error) + 0.1 * np.abs(error).mean())
    penalty = np.diag([0.0, *[1.0] * len(DOUBTS)])
    row = np.linalg.solve(D.T @ (w[:, None] * D) + penalty, D.T @ (w * target))
    ratio = np.abs(error) / np.exp(D @ row)
    order = np.argsort(ratio)
    held = np.cumsum(w[order]) / w.sum()
    row[0] += np.log(ratio[order][np.searchsorted(held, HELD)] / 2.0)
    return np.asarray(row)
