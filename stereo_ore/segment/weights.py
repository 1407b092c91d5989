"""Coefficients of the two logistic models, learned on ray-cast and path-traced scenes with known lumps.

Each line: the feature, its mean and spread over the training set, and the weight of the standardised feature.
"""

from __future__ import annotations

import numpy as np
from scipy.special import expit

from stereo_ore.types import F64

Line = tuple[str, float, float, float]
PAIR: tuple[Line, ...] = (
    ("valley_eighth", 1.272, 1.021, -0.247),
    ("valley_quarter", 1.518, 1.199, -1.144),
    ("valley_quarter_relative", 0.9264, 0.8522, 0.635),
    ("edge", 1.05, 0.3666, -1.032),
    ("edge_relative", 1.103, 0.3432, -0.345),
    ("border_length", 0.9235, 0.4125, 0.357),
    ("colour", 0.8701, 0.5215, -0.639),
    ("relief_step", 0.2886, 0.1703, -0.716),
    ("chord_mean", 0.3656, 0.3487, -2.073),
    ("chord_median", 1.332, 1.167, -1.233),
    ("size_ratio", 1.807, 1.685, -0.946),
    ("size", 0.5967, 0.4405, -2.333),
    ("solidity_gain", -0.04334, 0.08452, 0.392),
)
PAIR_BIAS = -4.606
PART: tuple[Line, ...] = (
    ("relief", 2.555, 1.194, 1.933),
    ("high_share", 0.6884, 0.3344, -0.275),
    ("area", -0.9099, 1.555, 2.634),
    ("measured", 0.9724, 0.05777, -0.284),
    ("on_bar", 0.2367, 0.2519, -0.210),
    ("solidity", 0.9478, 0.1106, 0.120),
    ("rim_edge", 1.129, 0.382, 0.805),
    ("edge", 0.7947, 0.2772, -0.005),
    ("rim_step", 1.509, 0.8185, -0.036),
    ("inside", 0.6705, 0.4382, 1.939),
)
PART_BIAS = 2.336


def probability(features: F64, lines: tuple[Line, ...], bias: float) -> F64:
    """Logistic model of (K, F) features: (K,) probabilities."""
    mean, spread, weight = np.array([line[1:] for line in lines]).T
    return np.asarray(expit((features - mean) / spread @ weight + bias), dtype=np.float64)
