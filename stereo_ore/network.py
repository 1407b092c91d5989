"""A small network that turns features into a probability: plain numbers, run by ONNX Runtime."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from importlib.resources import files
from typing import Any

import numpy as np

from stereo_ore import engine
from stereo_ore.threads import chunks, map_rows
from stereo_ore.types import F32, F64

_LAYER = "hidden_layer.onnx"
"""max(0, W₁·x + b₁) and its product with w₂; weights come as inputs beside x (F, n)."""


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
        return self._judge(np.ascontiguousarray(features.T, np.float32))

    def map(self, images: Sequence[F32]) -> F32:
        """Probability (h, w) of each pixel of F images (h, w), one feature each, on the calling
        thread.
        """
        flat = [image.ravel() for image in images]
        found = [self._judge(np.stack([f[few] for f in flat])) for few in chunks(len(flat[0]))]
        return np.concatenate(found).reshape(images[0].shape)

    def _judge(self, features: F32) -> F32:
        """Probability (n,) of features (F, n)."""
        (logit,) = _layer().run(None, {"x": features, **self._weights})
        return logistic(logit[0] + np.float32(self.output_bias))

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
    def _weights(self) -> dict[str, F32]:
        """Weights w (H, F) and bias b (H, 1) of features as they come, and weights v (1, H) of the
        units.
        """
        weights = np.array(self.hidden_weights) / np.array(self.scale)[:, None]
        bias = np.array(self.hidden_bias) - np.array(self.mean) @ weights
        return {
            "w": np.ascontiguousarray(weights.T, np.float32),
            "b": bias.astype(np.float32)[:, None],
            "v": np.array(self.output_weights, np.float32)[None],
        }


@cache
def _layer() -> Any:
    return engine.session((files("stereo_ore") / "models" / _LAYER).read_bytes(), 1)


def logistic(logit: F32 | F64) -> F32:
    """Probabilities of log odds."""
    return np.asarray(1 / (1 + np.exp(np.negative(np.clip(logit, -30, 30)))), np.float32)


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
