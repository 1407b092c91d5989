"""The adaptive filter without anything learned: one equation over density, local planes and the matcher's doubts."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from stereo_ore.config.filters import ClosedFormParams
from stereo_ore.stages.filters import stereo
from stereo_ore.stages.filters.evidence import gather
from stereo_ore.stages.filters.surface import fit_planes, votes
from stereo_ore.types import F32, FilterResult, VoxelCloud

DOUBTS: Mapping[str, float] = {"spread_px": 0.3, "lr_diff_px": 0.5, "scatter_14_px": 0.6, "photometric": 0.8}
"""Cues of a stereo cloud, and the values at which each halves the support."""


def closed_form(voxels: VoxelCloud, params: ClosedFormParams) -> FilterResult:
    """Remove points with p > threshold; the score is p.

    With d = mean distance to 8 neighbours and r = distance from the plane through the k neighbours, both in spacings,
    r_j = distance from the plane of neighbour j, and weights w that start at the density's min(1, d⁻³) =: w₀:

        S = Σ_j w_j / (1 + (r_j/s)²) / (1 + (r/s)²),    p = 1 − c · w₀ · S² / (S² + S₀²),    w = 1 − p,

    repeated for a number of rounds. c = Π 1 / (1 + (q/q₀)²) over the `DOUBTS` q of a stereo cloud, 1 without.
    """
    has_cues = stereo.has_cues(voxels)
    evidence = gather(stereo.image_space(voxels) if has_cues else voxels.xyz, params.k)
    trust = _trust(voxels) if has_cues else np.float32(1)
    points, index, dense = evidence.points, evidence.index, 1 - evidence.prior
    weight, scales = dense, (params.scale, params.scale)
    for _ in range(params.rounds):
        planes = fit_planes(points, index, weight, points)
        agreed = np.exp(votes(points, index, weight, planes, points, scales)[:, 0])
        support = np.square(agreed / (1 + np.square(planes.height / np.float32(params.scale))))
        weight = np.asarray(trust * dense * support / (support + np.float32(params.support**2)), np.float32)
    return FilterResult(1 - weight <= params.threshold, 1 - weight)


def _trust(voxels: VoxelCloud) -> F32:
    doubts = (np.nan_to_num(voxels.cues[name], nan=0.0) / np.float32(limit) for name, limit in DOUBTS.items())
    return np.asarray(np.prod([1 / (1 + doubt * doubt) for doubt in doubts], axis=0), np.float32)
