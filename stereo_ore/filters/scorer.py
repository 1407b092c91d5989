"""Small networks that turn a point's features into a noise probability: shipped as readable JSON, run by NumPy."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np

from stereo_ore.filters.neighbours import chunks, map_rows
from stereo_ore.types import F32

SMALL = 128
"""Rows of a matrix product: few enough that the linear algebra library doesn't start threads, which cost far more."""


@dataclass(frozen=True)
class Network:
    """One hidden layer of rectified units: p = 1 / (1 + exp(−(w₂·max(0, W₁ᵀ(f − mean)/scale + b₁) + b₂)))."""

    mean: list[float]
    scale: list[float]
    hidden_weights: list[list[float]]
    hidden_bias: list[float]
    output_weights: list[float]
    output_bias: float

    def probability(self, features: F32) -> F32:
        """Noise probability (M,) of (M, F) features."""
        scale = 1 / np.array(self.scale, np.float32)
        weights = np.array(self.hidden_weights, np.float32) * scale[:, None]
        bias = np.array(self.hidden_bias, np.float32) - np.array(self.mean, np.float32) @ weights
        out = np.array(self.output_weights, np.float32)

        def rows(part: slice) -> F32:
            block = features[part]
            hidden = np.concatenate([block[few] @ weights for few in chunks(len(block), SMALL)])
            logit = np.einsum("ij,j->i", np.maximum(hidden + bias, 0), out) + np.float32(self.output_bias)
            return np.asarray(1 / (1 + np.exp(-np.clip(logit, -30, 30))), np.float32)

        return map_rows(rows, len(features))


@dataclass(frozen=True)
class Scorer:
    """The networks of successive passes, and the names of all features; a network may take only the first of them.

    `threshold` is the probability above which a point is called noise unless parameters say otherwise.
    """

    features: list[str]
    passes: list[Network]
    threshold: float = 0.5

    def to_json(self) -> str:
        """Readable text, a row of weights a line."""
        text = json.dumps(asdict(self), ensure_ascii=False, indent=1)
        return text.replace(",\n    ", ", ").replace("[\n    ", "[").replace("\n   ]", "]") + "\n"

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Scorer:
        """The scorer that `to_json` wrote."""
        return cls(data["features"], [Network(**network) for network in data["passes"]], data["threshold"])


@cache
def load(name: str) -> Scorer:
    """A scorer that ships with the package: ``geometry`` or ``stereo``."""
    text = (files("stereo_ore.filters") / "scorers" / f"{name}.json").read_text(encoding="utf-8")
    return Scorer.from_dict(json.loads(text))
