"""The adaptive filter without anything learned: one equation over density, local planes and the
matcher's doubts.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from stereo_ore.config.filters import ClosedFormParams
from stereo_ore.stages.filters import stereo
from stereo_ore.stages.filters.evidence import BareEvidence, bare_evidence
from stereo_ore.stages.filters.neighbours import by_neighbour
from stereo_ore.stages.filters.surface import Voters, fit_weighted_planes
from stereo_ore.threads import map_rows
from stereo_ore.types import F32, FilterResult, VoxelCloud

_DOUBTS: Mapping[str, float] = {
    "spread_px": 0.3,
    "lr_diff_px": 0.5,
    "scatter_14_px": 0.6,
    "photometric": 0.8,
}
"""Cues of a stereo cloud, and the values at which each halves the support."""


SPARSE = 0.25
"""Logarithm of the mean distance, over the spacing around, up to which density speaks against no
point."""


def closed_form(voxels: VoxelCloud, params: ClosedFormParams) -> FilterResult:
    """Remove points with p > threshold; the score is p.

    With d = mean distance to 8 neighbours over the spacing around, r = distance from the plane
    through the k neighbours, r_j = distance from the plane of neighbour j, both in spacings, and
    weights w that start at w₀ = min(1, (d/1.28)⁻³):

        S = Σ_j w_j / (1 + (r_j/s)²) / (1 + (r/s)²),
        p = 1 − c · w₀ · S² / (S² + S₀²),    w = 1 − p,

    repeated for a number of rounds. s = max(scale, roughness · σ), with σ = 8 times the 10 %
    quantile of |r| where w > ½, which is the standard deviation of a normal. c = Π 1 / (1 +
    (q/q₀)²) over the `_DOUBTS` q of a stereo cloud, 1 without.
    """
    has_cues = stereo.has_cues(voxels)
    evidence = bare_evidence(stereo.image_space(voxels) if has_cues else voxels.xyz, params.k)
    trust = _trust(voxels) if has_cues else np.float32(1)
    points, index = evidence.points, evidence.index
    crowding = np.maximum(evidence.density[:, 1] - evidence.here - np.float32(SPARSE), 0)
    dense = np.minimum(1, np.exp(-3 * crowding)).astype(np.float32)
    weight = dense
    for _ in range(params.rounds):
        planes = fit_weighted_planes(points, index, weight, points)
        scale = np.float32(_scale(np.abs(planes.height), weight, params))
        agreed = _agreed(Voters.of(points, weight, planes), evidence, float(scale))
        support = np.square(agreed / (1 + np.square(planes.height / scale)))
        weight = np.asarray(
            trust * dense * support / (support + np.float32(params.support**2)), np.float32
        )
    return FilterResult(1 - weight <= params.threshold, 1 - weight)


def _scale(residual: F32, weight: F32, params: ClosedFormParams) -> float:
    sure = residual[weight > 0.5]
    sigma = 8 * float(np.quantile(sure if len(sure) > 100 else residual, 0.1))
    return max(params.scale, params.roughness * sigma)


def _agreed(voters: Voters, evidence: BareEvidence, scale: float) -> F32:
    """Σ_j w_j / (1 + (r_j/s)²), (M,)."""

    def rows_of(rows: slice) -> F32:
        near = by_neighbour(evidence.index, rows)
        return np.exp(voters.votes(near, evidence.points[rows], (scale, scale))[:, 0])

    return map_rows(rows_of, len(evidence.points))


def _trust(voxels: VoxelCloud) -> F32:
    doubts = (
        np.nan_to_num(voxels.cues[name], nan=0.0) / np.float32(limit)
        for name, limit in _DOUBTS.items()
    )
    return np.asarray(np.prod([1 / (1 + doubt * doubt) for doubt in doubts], axis=0), np.float32)
