"""What is learned on scenes with known lumps, by `tune --train segment`: a network of pixels, two
logistic models.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
from scipy.special import expit

from stereo_ore.network import Network
from stereo_ore.stages.segment.pixels import PIXEL_FEATURES
from stereo_ore.types import F64

PAIR_FEATURES = (
    "valley_eighth", "valley_quarter", "valley_quarter_relative", "edge", "edge_relative",
    "border_length", "colour",
    "relief_step", "chord_mean", "chord_median", "size_ratio", "size", "solidity_gain",
)  # fmt: skip
"""Of two neighbouring parts: how sure it is that they are one lump."""
PART_FEATURES = (
    "relief", "high_share", "area", "measured", "on_bar", "solidity", "rim_edge", "edge",
    "rim_step", "inside",
    "likely", "relief_sigmas",
)  # fmt: skip
"""Of a part: how sure it is that it is a lump, and not a wrong match, rubble or steel."""


@dataclass(frozen=True)
class Logistic:
    """p = 1 / (1 + exp(−(Σ weight·(feature − mean)/spread + bias))), mean and spread those of the
    training set.
    """

    features: tuple[str, ...]
    mean: tuple[float, ...]
    spread: tuple[float, ...]
    weight: tuple[float, ...]
    bias: float

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Logistic:
        """The model of a mapping of its fields."""
        names, mean, spread, weight = (
            tuple(data[name]) for name in ("features", "mean", "spread", "weight")
        )
        return cls(names, mean, spread, weight, float(data["bias"]))

    def probability(self, features: F64) -> F64:
        """Probabilities (K,) of (K, F) features."""
        scaled = (features - np.array(self.mean)) / np.array(self.spread)
        return np.asarray(expit(scaled @ np.array(self.weight) + self.bias), dtype=np.float64)


@dataclass(frozen=True)
class Weights:
    """The network of `pixels.PIXEL_FEATURES`, and both models."""

    pixel: Network
    pair: Logistic
    part: Logistic

    def to_json(self) -> str:
        """Readable text, a row a line."""
        rows = {
            name: ",\n".join(
                f"  {json.dumps(key)}: {json.dumps(value)}" for key, value in model.items()
            )
            for name, model in asdict(self).items()
        }
        return (
            "{" + ",".join(f'\n "{name}": {{\n{text}\n }}' for name, text in rows.items()) + "\n}\n"
        )

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Weights:
        """The models that `to_json` wrote.

        Raises
        ------
        ValueError
            When they were fitted to other features than are measured now.
        """
        weights = cls(
            Network(**data["pixel"]),
            Logistic.from_dict(data["pair"]),
            Logistic.from_dict(data["part"]),
        )
        known = weights.pair.features, weights.part.features, len(weights.pixel.mean)
        if known != (PAIR_FEATURES, PART_FEATURES, len(PIXEL_FEATURES)):
            raise ValueError("the models were fitted to other features")
        return weights


@cache
def load() -> Weights:
    """The models that ship with the package."""
    text = (files("stereo_ore.stages.segment") / "weights.json").read_text(encoding="utf-8")
    return Weights.from_dict(json.loads(text))
