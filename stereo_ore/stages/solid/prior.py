"""The linear models that turn cues into a solid; ``stereo-ore tune --train solids`` makes their
coefficients.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from stereo_ore.types import F64

TARGETS = ("x", "z", "volume", "longest", "middle", "shortest")
"""What is estimated from even cues: centre of gravity over size, z over the support, logarithms of
volume over size³ and of dimensions over size. The sideways coordinate y comes from odd cues alone,
for a mirrored lump must give a mirrored answer."""
DOUBTS = ("tilt", "hidden", "others", "depth_noise")
"""What the logarithm of an error's standard deviation is linear in."""
REACH = 4.0
"""How many standard deviations a cue may differ from those that the model was made from."""
PAIR_REACH = 2.5
"""The same in products of cues, which would take a model farther astray."""
_SHIPPED = Path(__file__).with_name("prior.json")


@dataclass(frozen=True)
class Estimate:
    """Means and standard deviations by target (`TARGETS` and y), over the lump's size or as
    logarithms.
    """

    mean: Mapping[str, float]
    sigma: Mapping[str, float]


@dataclass(frozen=True)
class Linear:
    """Targets as `constant` (T,) + terms · `weights` (K + P, T).

    The terms are the K cues less `mean`, over `scale`, held within ±`REACH`, and products of P
    `pairs` of those.
    """

    cues: tuple[str, ...]
    pairs: tuple[tuple[str, str], ...]
    mean: F64
    scale: F64
    weights: F64
    constant: F64

    def __call__(self, values: F64) -> F64:
        """Targets (..., T) of cues (..., K)."""
        return np.asarray(self.constant + self.terms(values) @ self.weights)

    def terms(self, values: F64) -> F64:
        """Terms (..., K + P) of cues (..., K)."""
        standard = np.clip((values - self.mean) / self.scale, -REACH, REACH)
        near = np.clip(standard, -PAIR_REACH, PAIR_REACH)
        one, other = self._places
        return np.concatenate([standard, near[..., one] * near[..., other]], -1)

    @functools.cached_property
    def _places(self) -> npt.NDArray[np.intp]:
        """Columns (2, P) of the pairs."""
        place = {name: k for k, name in enumerate(self.cues)}
        return (
            np.array([[place[name] for name in pair] for pair in self.pairs], np.intp)
            .reshape(-1, 2)
            .T
        )


@dataclass(frozen=True)
class Prior:
    """Models of the `TARGETS` from even cues and of y from odd ones; weights (5,) of each sigma's
    logarithm.
    """

    even: Linear
    odd: Linear
    sigma: Mapping[str, F64]

    def estimate(
        self, even: Mapping[str, float], odd: Mapping[str, float], doubts: Mapping[str, float]
    ) -> Estimate:
        """Apply the models to cues by name."""
        values = [*self.even(_row(even, self.even.cues)), *self.odd(_row(odd, self.odd.cues))]
        mean = dict(zip((*TARGETS, "y"), map(float, values), strict=True))
        doubt = np.array([1.0, *(min(doubts[name], 1.0) for name in DOUBTS)])
        return Estimate(
            mean, {name: float(np.exp(row @ doubt)) for name, row in self.sigma.items()}
        )

    def to_json(self) -> str:
        """A line a cue, five decimals: readable, and more than the estimate needs."""
        document = {
            "even": _document(self.even, TARGETS),
            "odd": _document(self.odd, ("y",)),
            "sigma": {name: _named(("constant", *DOUBTS), row) for name, row in self.sigma.items()},
        }
        return json.dumps(document, separators=(", ", ": ")).replace("}, ", "},\n  ") + "\n"


def _row(cues: Mapping[str, float], names: tuple[str, ...]) -> F64:
    return np.array([cues[name] for name in names])


def _document(model: Linear, targets: tuple[str, ...]) -> dict[str, dict[str, float]]:
    terms = (*model.cues, *(f"{one}*{other}" for one, other in model.pairs))
    document = {term: _named(targets, row) for term, row in zip(terms, model.weights, strict=True)}
    for cue, *row in zip(model.cues, model.mean, model.scale, strict=True):
        document[cue] = _named(("mean", "scale"), np.array(row)) | document[cue]
    return {"constant": _named(targets, model.constant)} | document


def _named(names: tuple[str, ...], row: F64) -> dict[str, float]:
    return dict(zip(names, row.round(5).tolist(), strict=True))


@functools.cache
def load_prior(file: Path = _SHIPPED) -> Prior:
    """Read the coefficients that ship with the package, or others."""
    document = json.loads(file.read_text(encoding="utf-8"))
    sigma = {
        name: np.array([row["constant"], *(row[d] for d in DOUBTS)])
        for name, row in document["sigma"].items()
    }
    return Prior(_linear(document["even"], TARGETS), _linear(document["odd"], ("y",)), sigma)


def _linear(document: Mapping[str, Mapping[str, float]], targets: tuple[str, ...]) -> Linear:
    constant, *weights = (
        np.array([row[target] for target in targets]) for row in document.values()
    )
    cues = tuple(name for name, row in document.items() if "mean" in row)
    pairs = tuple(
        (one, other) for one, star, other in (name.partition("*") for name in document) if star
    )
    mean, scale = (np.array([document[cue][key] for cue in cues]) for key in ("mean", "scale"))
    return Linear(cues, pairs, mean, scale, np.array(weights), constant)
