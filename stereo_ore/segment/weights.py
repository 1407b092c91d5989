"""Coefficients of the two logistic models, learned on ray-cast and path-traced scenes with known lumps.

Each line: the feature, its mean and spread over the training set, and the weight of the standardised feature.
"""

from __future__ import annotations

import numpy as np
from scipy.special import expit

from stereo_ore.types import F64

Line = tuple[str, float, float, float]
PAIR: tuple[Line, ...] = (
    ("valley_eighth", 1.269, 1.024, -0.831),
    ("valley_quarter", 1.476, 1.191, -0.594),
    ("valley_quarter_relative", 0.8914, 0.8421, 0.851),
    ("edge", 1.015, 0.3709, -1.403),
    ("edge_relative", 1.075, 0.3367, -0.359),
    ("border_length", 0.9494, 0.3938, 0.481),
    ("colour", 0.8144, 0.4829, -0.558),
    ("relief_step", 0.2823, 0.1694, -0.896),
    ("chord_mean", 0.3431, 0.3185, -1.594),
    ("chord_median", 1.29, 1.142, -1.569),
    ("size_ratio", 1.69, 1.513, -0.675),
    ("size", 0.6096, 0.4511, -2.762),
    ("solidity_gain", -0.04209, 0.1278, 0.244),
)
PAIR_BIAS = -4.130
PART: tuple[Line, ...] = (
    ("relief", 2.578, 1.261, 1.872),
    ("high_share", 0.6891, 0.3499, -0.269),
    ("area", -0.6651, 1.467, 1.476),
    ("measured", 0.9807, 0.03995, 0.189),
    ("on_bar", 0.2356, 0.2455, -0.190),
    ("solidity", 0.9492, 0.1098, -1.010),
    ("rim_edge", 1.232, 0.2977, 0.784),
    ("edge", 0.8377, 0.2606, -0.772),
    ("rim_step", 1.539, 0.8487, 0.474),
    ("inside", 0.713, 0.4037, 2.626),
)
PART_BIAS = 2.981


def probability(features: F64, lines: tuple[Line, ...], bias: float) -> F64:
    """Logistic model of (K, F) features: (K,) probabilities."""
    mean, spread, weight = np.array([line[1:] for line in lines]).T
    return np.asarray(expit((features - mean) / spread @ weight + bias), dtype=np.float64)
