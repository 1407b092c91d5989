"""A small network that turns features into a probability: plain numbers, run by NumPy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereo_ore.threads import chunks, map_rows
from stereo_ore.types import F32

SMALL = 128
"""Rows of a matrix product: few enough that the linear algebra library doesn't start threads, which cost far more."""


WIDE = 512
"""Columns of such a product, likewise."""


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
        """Probability (M,) of (M, F) features."""
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

    def map(self, images: Sequence[F32]) -> F32:
        """Probability (h, w) of each pixel of F images (h, w), one feature each."""
        weights = (np.array(self.hidden_weights, np.float32) / np.array(self.scale, np.float32)[:, None]).T
        bias = np.array(self.hidden_bias, np.float32) - weights @ np.array(self.mean, np.float32)
        out, last = np.array(self.output_weights, np.float32), np.float32(self.output_bias)
        features = np.stack([np.ravel(image) for image in images])
        logit = np.empty(features.shape[1], np.float32)
        for few in chunks(len(logit), WIDE):
            hidden = weights @ features[:, few]
            hidden += bias[:, None]
            np.dot(out, np.maximum(hidden, 0, out=hidden), out=logit[few])
        logit += last
        return np.asarray(1 / (1 + np.exp(-np.clip(logit, -30, 30))), np.float32).reshape(images[0].shape)
