"""The network that turns cues into a solid; ``stereo-ore tune --train solids`` makes its
weights.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stereo_ore.types import F64

TARGETS = ("x", "z", "volume", "longest", "middle", "shortest", "y")
"""What is estimated: centre of gravity over size, z over the support, logarithms of volume over
size³ and of dimensions over size."""
MIRRORED = np.array([1.0, 1, 1, 1, 1, 1, -1] + [1.0] * len(TARGETS))
"""Signs of the outputs when a lump is mirrored sideways."""
REACH = 4.0
"""How many standard deviations a cue may differ from those that the network was made from."""
_DECIMALS = 4
_SHIPPED = Path(__file__).with_name("prior.json")


@dataclass(frozen=True)
class Estimate:
    """Means and standard deviations by target, over the lump's size or as logarithms."""

    mean: Mapping[str, float]
    sigma: Mapping[str, float]


@dataclass(frozen=True)
class Prior:
    """Outputs (2·T,), the `TARGETS` and the logarithms of their sigmas, of F cues, `even` before
    `odd` ones: constant + x·straight + max(0, x·units + bias)·outputs, where x are the cues less
    `mean`, over `scale`, held within ±`REACH`.

    A mirrored lump must give a mirrored answer: the mean over both ways to see it counts.
    """

    even: tuple[str, ...]
    odd: tuple[str, ...]
    mean: F64
    scale: F64
    straight: F64
    units: F64
    bias: F64
    outputs: F64
    constant: F64

    def __call__(self, cues: F64) -> F64:
        """Outputs (N, 2·T) of cues (N, F)."""
        mirrored = np.r_[np.ones(len(self.even)), -np.ones(len(self.odd))]
        return np.asarray((self._one(cues) + MIRRORED * self._one(mirrored * cues)) / 2)

    def _one(self, cues: F64) -> F64:
        x = self.standard(cues)
        hidden = np.maximum(x @ self.units + self.bias, 0.0)
        return np.asarray(self.constant + x @ self.straight + hidden @ self.outputs)

    def standard(self, cues: F64) -> F64:
        """Cues (N, F) as the network takes them."""
        return np.asarray(np.clip((cues - self.mean) / self.scale, -REACH, REACH))

    def estimate(self, even: Mapping[str, float], odd: Mapping[str, float]) -> Estimate:
        """Apply the network to the cues of a lump, by name."""
        row = [*(even[name] for name in self.even), *(odd[name] for name in self.odd)]
        mean, sigma = self(np.array([row]))[0].reshape(2, -1)
        return Estimate(
            dict(zip(TARGETS, mean.tolist(), strict=True)),
            dict(zip(TARGETS, np.exp(sigma).tolist(), strict=True)),
        )

    def to_json(self) -> str:
        """Readable text: a line a cue, and one a hidden unit."""
        rows = zip(self.mean, self.scale, self.straight, self.units, strict=True)
        cues = {
            name: [float(mean), float(scale), *straight, *units]
            for name, (mean, scale, straight, units) in zip(
                (*self.even, *self.odd), rows, strict=True
            )
        }
        document = {
            "targets": TARGETS,
            "even": len(self.even),
            "cues": {name: _rounded(row) for name, row in cues.items()},
            "constant": _rounded(self.constant),
            "bias": _rounded(self.bias),
            "outputs": [_rounded(row) for row in self.outputs],
        }
        return json.dumps(document).replace("], ", "],\n").replace("}, ", "},\n") + "\n"


def _rounded(row: F64 | list[float]) -> list[float]:
    return [round(float(value), _DECIMALS) for value in row]


@functools.cache
def load_prior(file: Path = _SHIPPED) -> Prior:
    """Read the weights that ship with the package, or others."""
    document = json.loads(file.read_text(encoding="utf-8"))
    names, count = tuple(document["cues"]), document["even"]
    table = np.array(list(document["cues"].values()))
    mean, scale, straight, units = np.split(table, [1, 2, 2 + 2 * len(TARGETS)], axis=1)
    rest = (np.array(document[key]) for key in ("bias", "outputs", "constant"))
    return Prior(names[:count], names[count:], mean[:, 0], scale[:, 0], straight, units, *rest)
