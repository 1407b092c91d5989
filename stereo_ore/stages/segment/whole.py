"""How sure it is that a label is one whole lump: a logistic model of what the network said."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import expit

from stereo_ore.stages.segment.channels import CHANNELS, UNIT
from stereo_ore.stages.segment.outputs import Outputs
from stereo_ore.types import F32, F64, I32

FEATURES = (
    "ore", "line", "agreement", "log_share", "log_area", "valid", "kept", "height", "texture",
    "beside",
)  # fmt: skip
"""Of a label: mean probability of ore and of contact; share of its pixels that vote for one place;
logarithms of its area over the one that it should have, and over that of an opening; share of its
pixels with a disparity, and of those kept by the filter; mean height [openings]; mean texture of
the image; share of its pixels beside another label."""
AGREED = 0.25
"""Votes that miss the mean of their lump's by less agree [diameters]."""


@dataclass(frozen=True)
class Whole:
    """p = 1 / (1 + exp(−(Σ weight·(feature − mean)/spread + bias)))."""

    mean: tuple[float, ...]
    spread: tuple[float, ...]
    weight: tuple[float, ...]
    bias: float

    @classmethod
    def read(cls, data: Mapping[str, Any]) -> Whole:
        """The model of a card's entry.

        Raises
        ------
        ValueError
            When it was fitted to other features than are measured now.
        """
        if tuple(data["features"]) != FEATURES:
            raise ValueError("the model of whole lumps was fitted to other features")
        mean, spread, weight = (tuple(map(float, data[k])) for k in ("mean", "spread", "weight"))
        return cls(mean, spread, weight, float(data["bias"]))

    def probability(self, features: F64) -> F64:
        """Probability (n,) of (n, len(FEATURES)) features."""
        scaled = (features - np.array(self.mean)) / np.array(self.spread)
        return np.asarray(expit((scaled * np.array(self.weight)).sum(1) + self.bias), np.float64)


def features(labels: I32, said: Outputs, x: F32) -> F64:
    """Features (n, len(FEATURES)) of labels 1…n (h, w), from the network's outputs and inputs."""
    count = int(labels.max(initial=0))
    at = np.flatnonzero(labels)
    mine = labels.ravel()[at].astype(np.intp)
    area = np.maximum(np.bincount(mine, minlength=count + 1), 1).astype(np.float64)

    def own(image: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return image.ravel()[at]

    def mean(values: npt.NDArray[Any]) -> F64:
        total = np.bincount(mine, values.astype(np.float64), count + 1)
        return np.asarray(total / area, np.float64)

    diameter = np.exp(mean(np.log(own(said.diameter))))
    x_px, y_px = own(said.x), own(said.y)
    missed = np.hypot(x_px - mean(x_px)[mine], y_px - mean(y_px)[mine])
    channel = dict(zip(CHANNELS, x, strict=True))
    columns = [
        mean(own(said.ore)), mean(own(said.line)), mean(missed < AGREED * diameter[mine]),
        np.log(area / diameter**2), np.log(area / UNIT**2),
        *(mean(own(channel[name])) for name in ("valid", "kept", "height", "texture")),
        mean(own(_beside_another(labels))),
    ]  # fmt: skip
    return np.stack(columns, 1)[1:]


def _beside_another(labels: I32) -> npt.NDArray[np.bool_]:
    """Pixels (h, w) whose neighbour to one of four sides belongs to another label."""
    out = np.zeros(labels.shape, bool)
    for axis in (0, 1):
        a, b = (np.moveaxis(labels, axis, 0)[s] for s in (np.s_[:-1], np.s_[1:]))
        differ = (a != b) & (a > 0) & (b > 0)
        view = np.moveaxis(out, axis, 0)
        view[:-1] |= differ
        view[1:] |= differ
    return out
