"""The published filter, equation by equation: adaptive-K density and its ratio to the neighbours'
(LOF).

Adaptive ore point cloud filtering algorithm based on the K-nearest neighbor; equation numbers are
that paper's. Where it leaves something open, a parameter names the choice.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_ore.config.filters import PaperParams
from stereo_ore.stages.filters.neighbours import Neighbours, by_neighbour, density, search
from stereo_ore.threads import map_rows
from stereo_ore.types import F32, I32, FilterResult, Mask, VoxelCloud


@dataclass(frozen=True)
class PaperQuantities:
    """What the equations define for each point: ρ [1/m], noise cluster, its mean density μ_ρ [1/m],
    K_i, LOF.
    """

    rho: F32
    in_noise_cluster: Mask
    mu: F32
    k_sigma: int
    k_unclamped: F32
    k: I32
    lof: F32


def paper(voxels: VoxelCloud, params: PaperParams) -> FilterResult:
    """Remove points with LOF > R; the score is LOF."""
    q = quantities(voxels.xyz, params)
    diagnostics = {
        "k_sigma": q.k_sigma,
        "k_mean": float(q.k.mean()),
        "k_clamped": int((q.k != q.k_unclamped).sum()),
        "noise_cluster": int(q.in_noise_cluster.sum()),
        "R": params.R,
    }
    return FilterResult(q.lof <= params.R, q.lof, diagnostics)


def quantities(xyz: F32, params: PaperParams) -> PaperQuantities:
    """Evaluate equations 1 to 6 on distinct points (M, 3) [m], M > 1."""
    wanted = max(params.k0, params.k_max, *(() if params.k_sigma else params.k_grid))
    neighbours = search(xyz, wanted)
    rho = density(neighbours.distance[:, : params.k0])
    noise = two_clusters(rho, _start(rho, params))
    mu = np.where(noise, _mean(rho[noise]), _mean(rho[~noise])).astype(np.float32)
    k_sigma = params.k_sigma or reference_k(neighbours, params.k_grid)
    unclamped = np.floor(params.alpha * mu / rho + params.beta * k_sigma)
    k = np.clip(unclamped, min(params.k_min, neighbours.k), min(params.k_max, neighbours.k)).astype(
        np.int32
    )
    entering = rho if params.density_at == "k0" else _density_at(neighbours, k)
    lof = _mean_of_first(entering, neighbours, k) / entering
    return PaperQuantities(rho, noise, mu, k_sigma, unclamped, k, lof)


def _mean(values: F32) -> float:
    return float(values.mean(dtype=np.float64)) if len(values) else 0.0


def _start(rho: F32, params: PaperParams) -> tuple[float, float]:
    if params.centres_as == "density":
        return params.centres
    low, high = np.quantile(rho, params.centres)
    return float(low), float(high)


def two_clusters(values: F32, centres: tuple[float, float], iterations: int = 100) -> Mask:
    """Lloyd's K-means with two clusters on a line: True for values nearer to the lower centre.

    Parameters
    ----------
    values : (M,) array
    centres : (float, float)
        Where the clusters start; the result depends on nothing else.
    iterations : int
        Bound on the rounds; a line rarely needs ten.
    """
    ordered = np.sort(values.astype(np.float64))
    total = np.concatenate([[0.0], np.cumsum(ordered)])
    low, high = sorted(centres)
    for _ in range(iterations):
        cut = int(np.searchsorted(ordered, (low + high) / 2))
        moved = (
            total[cut] / cut if cut else low,
            (total[-1] - total[cut]) / (len(ordered) - cut) if cut < len(ordered) else high,
        )
        if moved == (low, high):
            break
        low, high = moved
    return np.asarray(values < (low + high) / 2)


def density_deviation(rho: F32, neighbours: Neighbours, k: int) -> F32:
    """σ(p_i) = sqrt(mean over j ≤ k of (ρ(q_j) − ρ(p_i))²), (M,) [1/m] (equation 3)."""
    index = neighbours.index[:, :k]

    def rows_of(rows: slice) -> F32:
        difference = rho.take(by_neighbour(index, rows)) - rho[rows]
        return np.asarray(
            np.sqrt(np.einsum("ij,ij->j", difference, difference) / np.float32(index.shape[1]))
        )

    return map_rows(rows_of, len(rho))


def reference_k(neighbours: Neighbours, grid: tuple[int, ...]) -> int:
    """K_σ: the k of the grid at which σ, with ρ taken at the same k, has the greatest mean over the
    cloud.
    """
    usable = sorted({min(k, neighbours.k) for k in grid})
    means = [
        _mean(density_deviation(density(neighbours.distance[:, :k]), neighbours, k)) for k in usable
    ]
    return usable[int(np.argmax(means))]


def _density_at(neighbours: Neighbours, k: I32) -> F32:
    total = np.cumsum(neighbours.distance, axis=1)
    rho = k / np.maximum(
        np.take_along_axis(total, k[:, None] - 1, 1)[:, 0], np.finfo(np.float32).tiny
    )
    return np.asarray(rho, np.float32)


def _mean_of_first(values: F32, neighbours: Neighbours, k: I32) -> F32:
    """Mean of `values` over each point's first k_i neighbours (M,)."""

    def rows_of(rows: slice) -> F32:
        gathered = values.take(by_neighbour(neighbours.index[:, : int(k[rows].max())], rows))
        gathered *= np.arange(len(gathered))[:, None] < k[rows]
        return np.asarray(gathered.sum(0) / k[rows], np.float32)

    return map_rows(rows_of, len(values))
