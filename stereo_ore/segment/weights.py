"""Coefficients of the two logistic models, learned on ray-cast and path-traced scenes with known lumps.

Each line: the feature, its mean and spread over the training set, and the weight of the standardised feature.
"""

from __future__ import annotations

import numpy as np
from scipy.special import expit

from stereo_ore.types import F64

Line = tuple[str, float, float, float]
PAIR: tuple[Line, ...] = (
    ("valley_eighth", 1.024, 0.9377, -0.554),
    ("valley_quarter", 1.247, 1.133, -0.917),
    ("valley_quarter_relative", 0.7394, 0.7492, 0.666),
    ("edge", 1.031, 0.3805, -1.390),
    ("edge_relative", 1.092, 0.3509, -0.270),
    ("border_length", 0.9818, 0.4361, 0.673),
    ("colour", 0.8489, 0.524, -0.715),
    ("relief_step", 0.2631, 0.1615, -0.562),
    ("chord_mean", 0.2937, 0.3019, -2.175),
    ("chord_median", 1.079, 1.089, -1.404),
    ("size_ratio", 2.047, 1.85, -1.015),
    ("size", 0.5248, 0.4401, -2.213),
    ("solidity_gain", -0.04306, 0.1322, 0.212),
)
PAIR_BIAS = -3.589
PART: tuple[Line, ...] = (
    ("relief", 2.568, 1.19, 1.542),
    ("high_share", 0.6926, 0.3351, -0.046),
    ("area", -0.9672, 1.569, 2.605),
    ("measured", 0.9759, 0.05203, -0.166),
    ("on_bar", 0.2414, 0.2599, -0.229),
    ("solidity", 0.9469, 0.1121, -0.106),
    ("rim_edge", 1.117, 0.3923, 0.938),
    ("edge", 0.7966, 0.2803, -0.086),
    ("rim_step", 1.493, 0.8047, 0.077),
    ("inside", 0.6662, 0.4376, 2.027),
)
PART_BIAS = 2.196


def probability(features: F64, lines: tuple[Line, ...], bias: float) -> F64:
    """Logistic model of (K, F) features: (K,) probabilities."""
    mean, spread, weight = np.array([line[1:] for line in lines]).T
    return np.asarray(expit((features - mean) / spread @ weight + bias), dtype=np.float64)
