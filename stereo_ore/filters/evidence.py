"""What is known of each point before anything is decided: density at several K, and the matcher's doubts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_ore.filters import wide
from stereo_ore.filters.neighbours import Index, Neighbours, by_neighbour, columns, map_rows, search
from stereo_ore.filters.surface import LEAST, fit_planes, log_odds, votes
from stereo_ore.types import CUES, F32, VoxelCloud

DENSITY_FEATURES = (
    "mean distance, K = 3", "mean distance, K = 8", "mean distance, all K", "neighbours' mean distance, mean",
    "neighbours' mean distance, least", "neighbours' mean distance, deviation", "times chosen", "neighbours chosen",
)  # fmt: skip
CUE_FEATURES = (*CUES, "points", "voxel in pixels", "depth noise in voxels")
SURFACE_FEATURES = (
    "residual", "aside", "thickness", "width", "length", "weight", "residual over thickness", "near votes", "far votes",
    "mean vote distance", "odds", "neighbours' odds",
)  # fmt: skip

DISPARITY_STRETCH = 0.3
"""Image space [px]: one standard deviation of depth noise counts as this many pixels across."""


@dataclass(frozen=True)
class Evidence:
    """Points in spacings (M, 3), neighbours (M, k), features (M, F) and a first noise probability (M,).

    `names` are those of all features of a pass; `surroundings` are there for stereo clouds.
    """

    points: F32
    index: Index
    features: F32
    names: tuple[str, ...]
    prior: F32
    surroundings: wide.Surroundings | None = None


def has_cues(voxels: VoxelCloud) -> bool:
    """True for a cloud that a matcher made and spoke about."""
    return set(CUES) <= set(voxels.cues) and bool((voxels.sigma_z > 0).all() and (voxels.pixel_m > 0).all())


def gather(voxels: VoxelCloud, k: int) -> Evidence:
    """Search the neighbours and measure densities; for a stereo cloud in image space, with the cues.

    With d_i(K) = 1/ρ = mean distance to the K nearest (equation 2) in units of s, the 20 % quantile of d(8) over the
    cloud: log d(3), log d(8), log d(k); mean, least and deviation (equation 3) of log d(8) over the neighbours; how
    often a point is chosen as a neighbour, and how often its neighbours are. Several K side by side let the scorer
    choose K by the point's own situation, which is what equation 5 is for.

    The first noise probability is 1 − min(1, (s/d(8))³).
    """
    stereo = has_cues(voxels)
    space = image_space(voxels) if stereo else voxels.xyz
    neighbours = search(space, k)
    spacing, features = _density(neighbours)
    names: tuple[str, ...] = DENSITY_FEATURES
    if stereo:
        features, names = columns(features, _cues(voxels)), names + CUE_FEATURES + wide.FEATURES
    prior = 1 - np.minimum(1, np.exp(-3 * features[:, 1]))
    centred = columns((space - np.median(space, axis=0)) / spacing)
    around = wide.survey(centred) if stereo else None
    return Evidence(centred, neighbours.index, features, (*names, *SURFACE_FEATURES), prior, around)


def image_space(voxels: VoxelCloud) -> F32:
    """(u, v, disparity) of each voxel, (M, 3) [px], disparity in units of its noise times `DISPARITY_STRETCH`.

    u = x/z · f, v = y/z · f with f = z / pixel size; disparity over its standard deviation is z/σ_z. In these
    coordinates noise has one size everywhere, where in metres it grows with z².
    """
    z = voxels.xyz[:, 2].astype(np.float64)
    focal = np.median(z / voxels.pixel_m)
    image = np.column_stack([voxels.xyz[:, :2] / z[:, None] * focal, DISPARITY_STRETCH * z / voxels.sigma_z])
    return image.astype(np.float32)


def _density(neighbours: Neighbours) -> tuple[float, F32]:
    distance, index = neighbours.distance, neighbours.index
    means = map_rows(lambda rows: columns(*(distance[rows, :n].mean(1) for n in (3, 8, neighbours.k))), len(index))
    spacing = max(float(np.quantile(means[:, 1], 0.2)), float(np.finfo(np.float32).tiny))
    own = np.log(means / np.float32(spacing) + np.float32(LEAST))
    chosen = (np.bincount(index.ravel("K"), minlength=len(index)) / neighbours.k).astype(np.float32)

    def around(rows: slice) -> F32:
        near = by_neighbour(index, rows)
        d = own[:, 1].take(near)
        return columns(d.mean(0), d.min(0), d.std(0), np.log(chosen[rows] + LEAST), chosen.take(near).mean(0))

    return spacing, columns(own, map_rows(around, len(index)))


def _cues(voxels: VoxelCloud) -> F32:
    """Logarithms of the cues (the valid share as it is), of the points behind a voxel over those it has room for."""
    floors = {"spread_px": 0.05, "lr_diff_px": 0.03, "texture": 0.3, "photometric": 0.03, "median_diff_px": 0.03}
    pixels = voxels.size_m / voxels.pixel_m
    doubts = (np.maximum(voxels.cues[name], 0) + floors[name] for name in CUES[1:])
    positive = columns(*doubts, voxels.count / pixels**2, pixels, voxels.sigma_z / voxels.size_m)
    logs = map_rows(lambda rows: np.nan_to_num(np.log(positive[rows]), nan=0.0, posinf=0.0, neginf=0.0), len(positive))
    return columns(np.nan_to_num(voxels.cues["valid_share"], nan=0.0, posinf=0.0, neginf=0.0), logs)


def features(evidence: Evidence, noise: F32) -> F32:
    """All features (M, len(names)) of the pass that follows the noise probabilities `noise` (M,)."""
    points, index, weight = evidence.points, evidence.index, 1 - noise
    parts = [evidence.features]
    if evidence.surroundings is not None:
        parts.append(wide.features(points, evidence.surroundings, noise))
    planes = fit_planes(points, index, weight, points)
    odds = log_odds(noise)
    around = map_rows(lambda rows: odds.take(by_neighbour(index, rows)).mean(0), len(odds))
    return columns(*parts, planes.shape, votes(points, index, weight, planes, points), odds, around)
