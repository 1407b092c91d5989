"""The default filter: adaptive-K density, residual to the local surface, and the matcher's doubts."""

from __future__ import annotations

import numpy as np

from stereo_ore.config.filters import AdaptiveParams
from stereo_ore.filters.neighbours import density, search
from stereo_ore.types import F32, FilterResult, VoxelCloud


def adaptive(voxels: VoxelCloud, params: AdaptiveParams) -> FilterResult:
    """Remove points whose noise probability is above the threshold; the score is that probability."""
    neighbours = search(voxels.xyz, params.k)
    rho = density(neighbours.distance)
    around = rho[neighbours.index]
    ratio = around.mean(1) / rho
    sparse = np.log(np.median(rho) / rho)
    logit = 3 * (np.log(ratio) - 0.25) + 2 * (sparse - 0.3)
    if voxels.cues:
        logit = logit + _doubt(voxels)
    score: F32 = (1 / (1 + np.exp(-np.clip(logit, -30, 30)))).astype(np.float32)
    return FilterResult(score <= params.threshold, score)


def _doubt(voxels: VoxelCloud) -> F32:
    """First guess of the cues' weight: gaps around a pixel and disagreeing disparities speak for noise."""
    cue = {name: np.nan_to_num(values, nan=0.0) for name, values in voxels.cues.items()}
    zero = np.zeros(len(voxels), np.float32)
    valid = cue.get("valid_share", zero + 1)
    spread = np.minimum(cue.get("spread_px", zero), 4)
    difference = np.minimum(cue.get("lr_diff_px", zero), 2)
    return np.asarray(6 * (0.8 - valid) + spread + 2 * (difference - 0.3) - 1, np.float32)
