"""The linear model that turns cues into a solid, and its coefficients, which `stereo_ore.solid.fit` makes."""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stereo_ore.types import F64

TARGETS = ("x", "z", "volume", "longest", "middle", "shortest")
"""What is estimated from even cues: centre of gravity over size, z over the support, logarithms of volume over size³
and of dimensions over size. The sideways coordinate y comes from odd cues alone, for a mirrored lump must give a
mirrored answer."""
DOUBTS = ("tilt", "hidden", "others", "depth_noise")
"""What the logarithm of an error's standard deviation is linear in."""
REACH = 5.0
"""How many standard deviations a cue may differ from those that the model was made from."""
SHIPPED = Path(__file__).with_name("prior.json")


@dataclass(frozen=True)
class Estimate:
    """Means and standard deviations by target (`TARGETS` and y), over the lump's size or as logarithms."""

    mean: Mapping[str, float]
    sigma: Mapping[str, float]


@dataclass(frozen=True)
class Prior:
    """Coefficients: `even` cues (K,) with mean, scale and weights (K, 6), `odd` weights, weights (5,) of each sigma."""

    even: tuple[str, ...]
    mean: F64
    scale: F64
    weights: F64
    constant: F64
    odd: Mapping[str, float]
    sigma: Mapping[str, F64]

    def estimate(self, even: Mapping[str, float], odd: Mapping[str, float], doubts: Mapping[str, float]) -> Estimate:
        """Apply the model; cues are held within `REACH` of those it was made from."""
        cues = (np.array([even[name] for name in self.even]) - self.mean) / self.scale
        mean = dict(zip(TARGETS, (self.constant + np.clip(cues, -REACH, REACH) @ self.weights).tolist(), strict=True))
        mean["y"] = float(sum(weight * odd[name] for name, weight in self.odd.items()))
        doubt = np.array([1.0, *(min(doubts[name], 1.0) for name in DOUBTS)])
        return Estimate(mean, {name: float(np.exp(row @ doubt)) for name, row in self.sigma.items()})


@functools.cache
def load(file: Path = SHIPPED) -> Prior:
    """Read the coefficients that ship with the package, or others."""
    document = json.loads(file.read_text(encoding="utf-8"))
    cues = document["even"]
    rows = np.array([[cue["mean"], cue["scale"], *(cue[target] for target in TARGETS)] for cue in cues.values()])
    constant = np.array([document["constant"][target] for target in TARGETS])
    sigma = {name: np.array([row["constant"], *(row[d] for d in DOUBTS)]) for name, row in document["sigma"].items()}
    return Prior(tuple(cues), rows[:, 0], rows[:, 1], rows[:, 2:], constant, document["odd"], sigma)
