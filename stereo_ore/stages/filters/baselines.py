"""The filters everyone has: statistical, radius, local outlier factor, and none."""

from __future__ import annotations

import numpy as np

from stereo_ore.config.filters import LofParams, NoneParams, RadiusParams, StatisticalParams
from stereo_ore.stages.filters.neighbours import search, spacing
from stereo_ore.types import F32, FilterResult, VoxelCloud


def keep_all(voxels: VoxelCloud, params: NoneParams) -> FilterResult:
    """Keep everything; the score is zero."""
    return FilterResult(np.ones(len(voxels), bool), np.zeros(len(voxels), np.float32))


def statistical(voxels: VoxelCloud, params: StatisticalParams) -> FilterResult:
    """Remove points whose mean neighbour distance is above mean + ratio · standard deviation over
    the cloud.

    The score is that mean distance in standard deviations from its mean (Rusu et al. 2008).
    """
    mean = search(voxels.xyz, params.k).distance.mean(1)
    score = (mean - mean.mean()) / max(float(mean.std()), np.finfo(np.float32).tiny)
    return FilterResult(score <= params.ratio, score)


def radius(voxels: VoxelCloud, params: RadiusParams) -> FilterResult:
    """Remove points with fewer than n neighbours within the radius.

    n points lie within r exactly when the n-th neighbour does, so the search is bounded however
    dense the cloud is. The score is the n-th neighbour's distance over the radius.
    """
    neighbours = search(voxels.xyz, params.n)
    r = params.radius_m or params.spacings * spacing(neighbours)
    if neighbours.k < params.n:
        score = np.full(len(voxels), np.inf, np.float32)
    else:
        score = neighbours.distance[:, -1] / np.float32(r)
    return FilterResult(score <= 1, score, {"radius_m": r})


def lof(voxels: VoxelCloud, params: LofParams) -> FilterResult:
    """Remove points whose local reachability density is well below that of their neighbours
    (Breunig et al. 2000).
    """
    neighbours = search(voxels.xyz, params.k)
    reach = np.maximum(neighbours.distance, neighbours.distance[:, -1][neighbours.index])
    lrd: F32 = 1 / np.maximum(reach.mean(1), np.finfo(np.float32).tiny)
    score = lrd[neighbours.index].mean(1) / lrd
    return FilterResult(score <= params.threshold, score)
