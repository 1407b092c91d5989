"""Coefficients of the two logistic models, learned on ray-cast and path-traced scenes with known lumps.

Each line: the feature, its mean and spread over the training set, and the weight of the standardised feature.
"""

from __future__ import annotations

import numpy as np
from scipy.special import expit

from stereo_ore.types import F64

Line = tuple[str, float, float, float]
PAIR: tuple[Line, ...] = (
    ("valley_eighth", 1.271, 1.024, -0.793),
    ("valley_quarter", 1.478, 1.192, -0.599),
    ("valley_quarter_relative", 0.8927, 0.8425, 0.868),
    ("edge", 1.014, 0.3708, -1.603),
    ("edge_relative", 1.074, 0.3368, -0.200),
    ("border_length", 0.9494, 0.3942, 0.469),
    ("colour", 0.8141, 0.4831, -0.520),
    ("relief_step", 0.2823, 0.1695, -0.931),
    ("chord_mean", 0.3433, 0.3188, -1.626),
    ("chord_median", 1.29, 1.144, -1.541),
    ("size_ratio", 1.69, 1.514, -0.697),
    ("size", 0.6095, 0.4514, -2.771),
    ("solidity_gain", -0.04206, 0.1279, 0.254),
)
PAIR_BIAS = -4.126
PART: tuple[Line, ...] = (
    ("relief", 2.616, 1.245, 1.358),
    ("high_share", 0.7014, 0.3432, -0.025),
    ("area", -0.6557, 1.48, 2.274),
    ("measured", 0.9807, 0.04006, 0.135),
    ("on_bar", 0.2437, 0.2515, -0.146),
    ("solidity", 0.945, 0.1034, -0.164),
    ("rim_edge", 1.237, 0.2946, 0.647),
    ("edge", 0.8408, 0.2624, -0.599),
    ("rim_step", 1.558, 0.8466, 0.516),
    ("inside", 0.7094, 0.4091, 2.524),
)
PART_BIAS = 3.747


def probability(features: F64, lines: tuple[Line, ...], bias: float) -> F64:
    """Logistic model of (K, F) features: (K,) probabilities."""
    mean, spread, weight = np.array([line[1:] for line in lines]).T
    return np.asarray(expit((features - mean) / spread @ weight + bias), dtype=np.float64)
