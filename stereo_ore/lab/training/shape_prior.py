"""Fitting of the solids' shape prior to samples: small networks by Laplace's likelihood, judged on
scenes left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stereo_ore.lab.training.solids import JUDGED, SolidSample
from stereo_ore.stages.solid.prior import MIRRORED, TARGETS, Prior
from stereo_ore.types import F32, F64, Mask

_CENTRE, _VOLUME, _LONGEST = [0, 1, 6], 2, 3
"""Columns of errors, which are in the order of `TARGETS`."""
_FOLDS = 4
"""Scenes are left out by quarters; of up to four that come first, each alone."""
NETWORKS, _UNITS = 6, 12
"""Networks whose mean is taken, and hidden units of each: their mean is one network with all
units."""
DESCENTS, _BATCH, _RATE, _DECAY = 2500, 256, 4e-3, 0.03
"""Of Adam with decoupled decay of the weights; the rate rises over a tenth of the steps, then
falls to zero."""
_CUE_NOISE, _SIGMA_RANGE = 0.1, (-3.0, 2.0)
"""Deviation of what is added to each cue, and logarithms within which sigmas are learned, both in
standard deviations."""
_LEAST_SCALE = 1e-3
"""A cue that varies less than this is not stretched: in few scenes some are constant."""
HELD = 0.95
"""Share of the errors that two sigma hold."""
_T = len(TARGETS)


@dataclass(frozen=True)
class _Quality:
    """Medians over lumps: shift of the centre over the longest dimension, relative errors of volume
    and of the longest.

    `far` is the shift's 90th percentile, `inside` the share of coordinates of the centre, and
    `bounded` that of volumes, within two sigma.
    """

    lumps: int
    shift: float
    far: float
    volume: float
    longest: float
    inside: float
    bounded: float

    def __str__(self) -> str:
        return (
            f"centre of gravity {self.shift:.1%}, a tenth beyond {self.far:.1%}, volume"
            f" {self.volume:.1%}, longest {self.longest:.1%}, within two sigma {self.inside:.1%}"
            f" and {self.bounded:.1%} ({self.lumps} lumps)"
        )


@dataclass(frozen=True)
class _Table:
    """Samples as arrays: cues (N, F), even before odd ones, truth (N, T), weights (N,)."""

    cues: F64
    truth: F64
    weight: F64

    @classmethod
    def of(cls, found: Sequence[SolidSample]) -> _Table:
        cues = [[*s.cues.even.values(), *s.cues.odd.values()] for s in found]
        truth = [[s.truth[name] for name in TARGETS] for s in found]
        return cls(np.array(cues), np.array(truth), np.array([s.weight for s in found]))

    def __getitem__(self, rows: Mask) -> _Table:
        return _Table(self.cues[rows], self.truth[rows], self.weight[rows])


def train_prior(found: Sequence[SolidSample]) -> tuple[Prior, F64]:
    """Fit the prior to samples, those of scenes that shall be left out one at a time first.

    Returns
    -------
    Prior
        Its sigmas hold the errors on scenes that were left out of the fit, on scene folders where
        there are some.
    array (N, 2, T)
        Those errors, of the `TARGETS`, and the sigmas that the prior gives.
    """
    table, fold = _Table.of(found), _folds(found)
    names = tuple(found[0].cues.even), tuple(found[0].cues.odd)
    errors = np.zeros((len(found), 2, _T))
    for k in np.unique(fold):
        rest, held = table[fold != k], fold == k
        said = _fit(rest if len(rest.truth) else table, names)(table.cues[held]).reshape(-1, 2, _T)
        errors[held, 0] = said[:, 0] - table.truth[held]
        errors[held, 1] = np.exp(said[:, 1])
    judged = np.array([sample.seen_as in JUDGED for sample in found])
    folders = judged & np.array([sample.recorded for sample in found])
    judged = folders if folders.any() else judged
    ratio = np.abs(errors[judged, 0]) / errors[judged, 1]
    wider = np.quantile(ratio, HELD, axis=0) / 2
    errors[:, 1] *= wider
    prior = _fit(table, names)
    constant = prior.constant + np.r_[np.zeros(_T), np.log(wider)]
    return replace(prior, constant=constant), errors


def prior_quality(found: Sequence[SolidSample], errors: F64) -> _Quality:
    """Of samples, by their errors and sigmas (N, 2, T)."""
    size = np.array([sample.size for sample in found])
    shift = np.linalg.norm(errors[:, 0, _CENTRE], axis=1) / size
    volume, longest = np.abs(np.expm1(errors[:, 0, [_VOLUME, _LONGEST]])).T
    held = np.abs(errors[:, 0]) <= 2 * errors[:, 1]
    medians = (np.median(shift), np.quantile(shift, 0.9), np.median(volume), np.median(longest))
    shares = held[:, _CENTRE].mean(), held[:, _VOLUME].mean()
    return _Quality(len(found), *map(float, (*medians, *shares)))


def _folds(found: Sequence[SolidSample]) -> F64:
    """Fold of each sample; samples of one scene share it."""
    number = {name: i for i, name in enumerate(dict.fromkeys(sample.scene for sample in found))}
    return np.array([number[sample.scene] % _FOLDS for sample in found])


def _fit(table: _Table, names: tuple[tuple[str, ...], tuple[str, ...]]) -> Prior:
    """The mean of `NETWORKS` networks as one."""
    even = len(names[0])
    mean = np.r_[table.cues[:, :even].mean(0), np.zeros(len(names[1]))]
    scale = np.maximum(np.sqrt(((table.cues - mean) ** 2).mean(0)), _LEAST_SCALE)
    none = np.zeros(0)
    prior = Prior(*names, mean, scale, none, none, none, none, none)
    cues = prior.standard(table.cues).astype(np.float32)
    middle = np.average(table.truth, 0, table.weight) * (MIRRORED[:_T] > 0)
    spread = table.truth.std(0)
    truth = ((table.truth - middle) / spread).astype(np.float32)
    signs = np.where(np.arange(cues.shape[1]) < even, 1, -1).astype(np.float32)
    made = [
        _descend(cues, truth, table.weight, signs, np.random.default_rng([k, 60]))
        for k in range(NETWORKS)
    ]
    straight, units, bias, outputs, constant = zip(*made, strict=True)
    stretch = np.r_[spread, np.ones(_T)]
    return replace(
        prior,
        straight=np.mean(straight, 0, np.float64) * stretch,
        units=np.hstack(units).astype(np.float64),
        bias=np.hstack(bias).astype(np.float64),
        outputs=np.vstack(outputs) * stretch / NETWORKS,
        constant=np.mean(constant, 0, np.float64) * stretch + np.r_[middle, np.log(spread)],
    )


def _descend(cues: F32, truth: F32, weight: F64, signs: F32, rng: np.random.Generator) -> list[F32]:
    """Weights of one network, in the order of `Prior`'s, by Adam; half of the samples are shown
    mirrored.
    """
    inputs = cues.shape[1]
    weights = [
        np.zeros((inputs, 2 * _T), np.float32),
        rng.standard_normal((inputs, _UNITS), np.float32) * np.float32(np.sqrt(2 / inputs)),
        np.zeros(_UNITS, np.float32),
        rng.standard_normal((_UNITS, 2 * _T), np.float32) * np.float32(0.3 / np.sqrt(_UNITS)),
        np.zeros(2 * _T, np.float32),
    ]
    first, second = ([np.zeros_like(w) for w in weights] for _ in range(2))
    shown = rng.choice(len(cues), (DESCENTS, _BATCH), p=weight / weight.sum())
    for step, rows in enumerate(shown):
        turned = rng.random((_BATCH, 1)) < 0.5
        x = np.where(turned, signs, np.float32(1)) * cues[rows]
        x += np.float32(_CUE_NOISE) * rng.standard_normal(x.shape, np.float32)
        y = np.where(turned, MIRRORED[:_T].astype(np.float32), np.float32(1)) * truth[rows]
        rate = (
            _RATE * min(1.0, 10 * (step + 1) / DESCENTS) * (1 + np.cos(np.pi * step / DESCENTS)) / 2
        )
        for k, slope in enumerate(_slopes(weights, x, y)):
            first[k] += 0.1 * (slope - first[k])
            second[k] += 0.01 * (slope**2 - second[k])
            seen = 1 - 0.9 ** (step + 1), 1 - 0.99 ** (step + 1)
            move = first[k] / seen[0] / (np.sqrt(second[k] / seen[1]) + 1e-6)
            decay = _DECAY * weights[k] if weights[k].ndim == 2 else 0.0
            weights[k] -= np.float32(rate) * (move + decay)
    return weights


def _slopes(weights: list[F32], x: F32, y: F32) -> list[F32]:
    """Gradient of the mean of |error|/s + log s over a batch, s from the network's second half."""
    straight, units, bias, outputs, constant = weights
    hidden = np.maximum(x @ units + bias, 0)
    said = x @ straight + hidden @ outputs + constant
    error, raw = said[:, :_T] - y, said[:, _T:]
    logarithm = np.clip(raw, *_SIGMA_RANGE)
    pull = np.exp(-logarithm)
    slope = np.hstack([np.sign(error) * pull, (1 - np.abs(error) * pull) * (raw == logarithm)])
    slope /= np.float32(len(x))
    back = (slope @ outputs.T) * (hidden > 0)
    return [x.T @ slope, x.T @ back, back.sum(0), hidden.T @ slope, slope.sum(0)]
