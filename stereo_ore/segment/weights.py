"""Coefficients of the two logistic models, learned on ray-cast and path-traced scenes with known lumps.

Each line: the feature, its mean and spread over the training set, and the weight of the standardised feature.
"""

from __future__ import annotations

import numpy as np
from scipy.special import expit

from stereo_ore.types import F64

Line = tuple[str, float, float, float]
PAIR: tuple[Line, ...] = (
    ("valley_eighth", 1.099, 0.9373, -1.899),
    ("valley_quarter", 1.359, 1.135, -0.287),
    ("valley_quarter_relative", 0.8012, 0.7443, 0.950),
    ("edge", 1.084, 0.3798, -1.060),
    ("edge_relative", 1.139, 0.3525, -0.591),
    ("border_length", 0.9763, 0.4293, 0.603),
    ("colour", 0.9372, 0.5471, -0.424),
    ("relief_step", 0.2776, 0.154, -0.736),
    ("chord_mean", 0.303, 0.2767, -1.223),
    ("chord_median", 1.138, 1.067, -3.058),
    ("size_ratio", 2.029, 1.818, -0.856),
    ("size", 0.5722, 0.4662, -1.540),
    ("solidity_gain", -0.03943, 0.1287, -0.296),
)
PAIR_BIAS = -5.540
PART: tuple[Line, ...] = (
    ("relief", 2.373, 1.171, 2.254),
    ("high_share", 0.6661, 0.3451, -0.235),
    ("area", -1.763, 2.018, 2.630),
    ("measured", 0.9653, 0.08389, -0.546),
    ("on_bar", 0.2851, 0.3335, -0.370),
    ("solidity", 0.9965, 0.2283, 0.664),
    ("rim_edge", 0.9963, 0.5077, 1.254),
    ("edge", 0.8328, 0.3843, 0.250),
    ("rim_step", 1.37, 0.8606, -0.417),
    ("inside", 0.5762, 0.436, 1.564),
)
PART_BIAS = -0.262


def probability(features: F64, lines: tuple[Line, ...], bias: float) -> F64:
    """Logistic model of (K, F) features: (K,) probabilities."""
    mean, spread, weight = np.array([line[1:] for line in lines]).T
    return np.asarray(expit((features - mean) / spread @ weight + bias), dtype=np.float64)
