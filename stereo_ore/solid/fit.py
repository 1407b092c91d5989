"""Fit the coefficients of `stereo_ore.solid.prior` to scenes whose truth is known.

    python -m stereo_ore.solid.fit OUT.json SCENES_DIR[*WEIGHT]…

A scene is a folder with calib.json, gt.json and gt.npz, as `stereo-ore synth` writes them; it is used in each of the
appearances of `stereo_ore.solid.scenes`. Scenes with a weight are those that the model shall serve: they also set its
constants, so that the median of their errors is zero.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np

from stereo_ore.solid.prior import DOUBTS, REACH, TARGETS
from stereo_ore.solid.scenes import Appearance, Sample, samples
from stereo_ore.types import F64

RIDGE, RIDGE_ODD = 100.0, 0.03
FOLDS = 5


def fit(found: Sequence[Sample]) -> dict[str, Any]:
    """Coefficients as the document that `prior.load` reads; errors are those of folds left out."""
    residuals = {name: np.zeros(len(found)) for name in (*TARGETS, "y")}
    fold = np.array([sample.fold for sample in found]) % FOLDS
    for k in range(FOLDS):
        model = _model([s for s, f in zip(found, fold, strict=True) if f != k])
        for i in np.nonzero(fold == k)[0].tolist():
            for name, value in _predict(model, found[i]).items():
                residuals[name][i] = value - found[i].truth[name]
    return _model(found) | {"sigma": {name: _spread(found, error) for name, error in residuals.items()}}


def _model(found: Sequence[Sample]) -> dict[str, Any]:
    """The regression, its constants set on the scenes that have a weight."""
    model = _ridge(found)
    served = [sample for sample in found if sample.weight != 1.0]
    if served:
        errors = [_predict(model, sample) for sample in served]
        for name in TARGETS:
            bias = np.median([error[name] - sample.truth[name] for error, sample in zip(errors, served, strict=True)])
            model["constant"][name] = round(model["constant"][name] - float(bias), 5)
    return model


def _ridge(found: Sequence[Sample]) -> dict[str, Any]:
    """Weighted ridge regression on standardised even cues, and one without constant on the odd ones."""
    names, odd_names = list(found[0].even), list(found[0].odd)
    w = np.array([s.weight for s in found])
    X, Z = (np.array([[getattr(s, kind)[n] for n in keys] for s in found]) for kind, keys in
            (("even", names), ("odd", odd_names)))  # fmt: skip
    Y = np.array([[s.truth[t] for t in TARGETS] for s in found])
    mean, scale, middle = np.average(X, 0, w), X.std(0) + 1e-9, np.average(Y, 0, w)
    S = (X - mean) / scale
    weights = np.linalg.solve(S.T @ (w[:, None] * S) + RIDGE * np.eye(len(names)), S.T @ (w[:, None] * (Y - middle)))
    y = np.array([s.truth["y"] for s in found])
    odd = np.linalg.solve(Z.T @ (w[:, None] * Z) + RIDGE_ODD * np.eye(len(odd_names)), Z.T @ (w * y))
    return {
        "constant": dict(zip(TARGETS, middle.round(5).tolist(), strict=True)),
        "even": {
            n: {"mean": round(m, 5), "scale": round(s, 5)} | dict(zip(TARGETS, row.round(5).tolist(), strict=True))
            for n, m, s, row in zip(names, mean.tolist(), scale.tolist(), weights, strict=True)
        },
        "odd": dict(zip(odd_names, odd.round(5).tolist(), strict=True)),
    }


def _predict(model: Mapping[str, Any], sample: Sample) -> dict[str, float]:
    cues = [(v, np.clip((sample.even[n] - v["mean"]) / v["scale"], -REACH, REACH)) for n, v in model["even"].items()]
    found = {t: float(model["constant"][t] + sum(v[t] * x for v, x in cues)) for t in TARGETS}
    return found | {"y": sum(weight * sample.odd[n] for n, weight in model["odd"].items())}


def _spread(found: Sequence[Sample], error: F64) -> dict[str, float]:
    """Log-linear model of an error's standard deviation, raised until two of them hold 95 % of the errors."""
    w = np.array([s.weight for s in found])
    D = np.array([[1.0, *(min(s.doubts[d], 1.0) for d in DOUBTS)] for s in found])
    target = np.log(np.abs(error) + 0.1 * np.abs(error).mean())
    row = np.linalg.solve(D.T @ (w[:, None] * D) + np.diag([0.0, *[1.0] * len(DOUBTS)]), D.T @ (w * target))
    ratio = np.abs(error) / np.exp(D @ row)
    order = np.argsort(ratio)
    held = np.cumsum(w[order]) / w.sum()
    row[0] += np.log(ratio[order][np.searchsorted(held, 0.95)] / 2.0)
    return dict(zip(("constant", *DOUBTS), row.round(4).tolist(), strict=True))


def main(arguments: Sequence[str]) -> None:
    """Read the scenes named on the command line, fit, and write the coefficients."""
    found: list[Sample] = []
    for argument in arguments[1:]:
        name, _, weight = argument.partition("*")
        for fold, file in enumerate(sorted(Path(name).glob("*/gt.json"))):
            for seen_as in get_args(Appearance):
                found += samples(file.parent, seen_as, float(weight or 1), fold)
    text = json.dumps({"lumps": len(found)} | fit(found), indent=None, separators=(", ", ": "))
    Path(arguments[0]).write_text(text.replace("}, ", "},\n  ") + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
