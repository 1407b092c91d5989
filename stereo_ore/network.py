"""A small network that turns features into a probability: plain numbers, run by NumPy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from stereo_ore.threads import chunks, map_rows
from stereo_ore.types import F32, F64

SMALL = 2**18
"""Multiplications of a matrix product: few enough that the linear algebra library doesn't start
threads of its own, which cost far more."""


@dataclass(frozen=True)
class Network:
    """One hidden layer of rectified units: p = 1 / (1 + exp(−(w₂·max(0, W₁ᵀ(f − mean)/scale + b₁) +
    b₂))).
    """

    mean: list[float]
    scale: list[float]
    hidden_weights: list[list[float]]
    hidden_bias: list[float]
    output_weights: list[float]
    output_bias: float

    def probability(self, features: F32) -> F32:
        """Probability (M,) of (M, F) features."""
        return map_rows(lambda rows: self.judge(features[rows]), len(features))

    def judge(self, features: F32) -> F32:
        """Probability (n,) of few (n, F) features, on the calling thread."""
        weights, bias, out = self._arrays
        hidden = _product(features, weights)
        hidden += bias
        logit = np.einsum("ij,j->i", np.maximum(hidden, 0, out=hidden), out)
        logit += np.float32(self.output_bias)
        return logistic(logit)

    def map(self, images: Sequence[F32]) -> F32:
        """Probability (h, w) of each pixel of F images (h, w), one feature each."""
        weights = (
            np.array(self.hidden_weights, np.float32) / np.array(self.scale, np.float32)[:, None]
        ).T
        bias = np.array(self.hidden_bias, np.float32) - weights @ np.array(self.mean, np.float32)
        out, last = np.array(self.output_weights, np.float32), np.float32(self.output_bias)
        features = np.stack([np.ravel(image) for image in images])
        logit = np.empty(features.shape[1], np.float32)
        for few in chunks(len(logit), max(SMALL // weights.size, 1)):
            hidden = weights @ features[:, few]
            hidden += bias[:, None]
            np.dot(out, np.maximum(hidden, 0, out=hidden), out=logit[few])
        logit += last
        return logistic(logit).reshape(images[0].shape)

    def given(self, values: F32) -> Network:
        """The network whose last features are known to be `values`: their share goes into the
        bias.
        """
        if not len(values):
            return self
        own = len(self.mean) - len(values)
        share = (
            (values - np.array(self.mean[own:]))
            / self.scale[own:]
            @ np.reshape(self.hidden_weights[own:], (len(values), len(self.hidden_bias)))
        )
        bias = (self.hidden_bias + share).tolist()
        return replace(
            self,
            mean=self.mean[:own],
            scale=self.scale[:own],
            hidden_weights=self.hidden_weights[:own],
            hidden_bias=bias,
        )

    @cached_property
    def _arrays(self) -> tuple[F32, F32, F32]:
        """Weights (F, H) and bias (H,) of features as they come, and weights (H,) of the units."""
        weights = np.array(self.hidden_weights) / np.array(self.scale)[:, None]
        bias = np.array(self.hidden_bias) - np.array(self.mean) @ weights
        return (
            weights.astype(np.float32),
            bias.astype(np.float32),
            np.array(self.output_weights, np.float32),
        )


def logistic(logit: F32 | F64) -> F32:
    """Probabilities of log odds."""
    return np.asarray(1 / (1 + np.exp(np.negative(np.clip(logit, -30, 30)))), np.float32)


def _product(features: F32, weights: F32) -> F32:
    """(n, F) features times (F, H) weights as a stack of small products, all in one call: threads
    that call often wait for each other.
    """
    (n, width), units = features.shape, weights.shape[1]
    rows = 2 ** int(np.log2(max(SMALL // weights.size, 1)))
    stacked = n - n % rows
    out = np.empty((n, units), np.float32)
    stack = features[:stacked].T.reshape(width, -1, rows).transpose(1, 2, 0)
    np.matmul(stack, weights, out=out[:stacked].reshape(-1, rows, units))
    np.matmul(features[stacked:], weights, out=out[stacked:])
    return out


def average(networks: Sequence[Network]) -> Network:
    """One network with the units of all, whose log odds are the mean of theirs; they share mean and
    scale.
    """
    weights = np.concatenate([network.hidden_weights for network in networks], axis=1)
    return replace(
        networks[0],
        hidden_weights=weights.tolist(),
        hidden_bias=[bias for network in networks for bias in network.hidden_bias],
        output_weights=[
            weight / len(networks) for network in networks for weight in network.output_weights
        ],
        output_bias=sum(network.output_bias for network in networks) / len(networks),
    )
