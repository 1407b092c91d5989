"""The surface around each point: planes through weighted neighbours, and how well a point fits
them.

Lengths are in units of the cloud's spacing. Offsets of neighbours are taken from the point itself,
so that large coordinates cost no precision.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_ore.stages.filters.neighbours import Index, by_neighbour, columns
from stereo_ore.threads import map_rows
from stereo_ore.types import F32, F64

SCALES = (0.3, 0.8)
"""Distances from a plane [spacings] at which a neighbour's vote has fallen to half: strict (near)
and lenient (far)."""

LEAST = 0.02
"""Added before a logarithm: a fiftieth of the spacing is as good as zero."""


@dataclass(frozen=True)
class Planes:
    """A plane a point: unit normal (M, 3), height of the plane over the point along it (M,), and
    `shape` (M, 7).

    The columns of `shape` are logarithms of: residual, distance of the neighbours' centre in the
    plane, the three standard deviations of the neighbours (thickness first), total weight, residual
    over thickness.
    """

    normal: F32
    height: F32
    shape: F32

    def take(self, rows: Index) -> Planes:
        """The planes of some points."""
        return Planes(self.normal[rows], self.height[rows], self.shape[rows])


def fit_weighted_planes(x: F32, index: Index, weight: F32, at: F32) -> Planes:
    """Total least-squares plane through each point's weighted neighbours.

    With offsets q_j = x_j − x_i and weights w_j: centre c = Σ w q / Σ w, covariance C = Σ w q qᵀ /
    Σ w − c cᵀ, normal n = the eigenvector of C's smallest eigenvalue λ_0, residual |n·c|, thickness
    sqrt(λ_0).

    Parameters
    ----------
    x : (N, 3) array
        Points to fit to [spacings].
    index : (M, k) array
        Neighbours of each of `at`, rows of `x`.
    weight : (N,) array
        How much each point is trusted as a piece of surface, 0…1.
    at : (M, 3) array
        Points whose surroundings are wanted.
    """
    x = np.asfortranarray(x)
    packed = map_rows(
        lambda rows: _fit_rows(x, by_neighbour(index, rows), at[rows], weight), len(at)
    )
    return Planes(packed[:, :3], packed[:, 3], packed[:, 4:])


def _fit_rows(x: F32, index: Index, own: F32, weight: F32) -> F32:
    w = weight.take(index)
    q = [x[:, axis].take(index) - own[:, axis] for axis in range(3)]
    total = w.sum(0) + np.float32(1e-3)
    wq = [w * component for component in q]
    centre = [component.sum(0) / total for component in wq]
    pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    moments = [np.einsum("ij,ij->j", wq[a], q[b]) / total - centre[a] * centre[b] for a, b in pairs]
    variances, normal = eigen(np.stack(moments).T)
    height = sum(c * n for c, n in zip(centre, normal.T, strict=True))
    residual = np.abs(height)
    aside = np.sqrt(np.maximum(sum(c * c for c in centre) - height**2, 0))
    deviations = np.sqrt(variances)
    lengths = np.log(columns(residual, aside, deviations) + LEAST)
    return columns(
        normal, height, lengths, np.log(total), np.log(residual / (deviations[:, 0] + 0.05) + LEAST)
    )


def eigen(moments: F32) -> tuple[F64, F64]:
    """Eigenvalues (M, 3), ascending, and the unit eigenvector (M, 3) of the smallest, of symmetric
    3×3 matrices.

    Parameters
    ----------
    moments : (M, 6) array
        Entries xx, yy, zz, xy, xz, yz. The trigonometric solution (Smith 1961); the eigenvector is
        the longest column of the adjugate of C − λ_0·1, and any direction where all vanish.
    """
    xx, yy, zz, xy, xz, yz = moments.astype(np.float64).T
    mean = (xx + yy + zz) / 3
    a, b, c = xx - mean, yy - mean, zz - mean
    scale = np.sqrt((a * a + b * b + c * c + 2 * (xy * xy + xz * xz + yz * yz)) / 6) + 1e-30
    determinant = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    angle = np.arccos(np.clip(determinant / (2 * scale * scale * scale), -1, 1)) / 3
    largest = mean + 2 * scale * np.cos(angle)
    smallest = mean + 2 * scale * np.cos(angle + 2 * np.pi / 3)
    values = np.stack([smallest, 3 * mean - largest - smallest, largest])
    return np.maximum(values, 0).T, _null_vector(
        xx - smallest, yy - smallest, zz - smallest, xy, xz, yz
    )


def _null_vector(a: F64, b: F64, c: F64, d: F64, e: F64, f: F64) -> F64:
    """Unit vector (M, 3) that singular matrices [[a, d, e], [d, b, f], [e, f, c]] map to zero.

    Each column of the adjugate is a multiple of it, the longest that with the largest element on
    the diagonal.
    """
    xx, yy, zz = b * c - f * f, a * c - e * e, a * b - d * d
    xy, xz, yz = e * f - d * c, d * f - e * b, d * e - a * f
    first, second = (xx >= yy) & (xx >= zz), yy >= zz
    rows = ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))
    vector = np.stack([np.where(first, u, np.where(second, v, w)) for u, v, w in rows])
    length = np.sqrt(np.einsum("im,im->m", vector, vector))
    vector[:, length == 0] = np.array([[0], [0], [1]])
    return np.asarray(vector / np.where(length == 0, 1, length)).T


@dataclass(frozen=True)
class Voters:
    """What points say of others by their planes: eight columns (N,) of unit normal, height, weight
    and place.
    """

    table: tuple[F32, ...]

    @classmethod
    def of(cls, x: F32, weight: F32, planes: Planes) -> Voters:
        """Points (N, 3) with their weights (N,) and planes."""
        return cls((*planes.normal.T, planes.height, weight, *x.T))

    def votes(self, near: Index, own: F32, scales: tuple[float, float] = SCALES) -> F32:
        """How well points `own` (n, 3) lie on the planes of their neighbours `near` (k, n), (n, 3)
        logarithms.

        With r_j = |n_j·(x_i − x_j) − h_j|: Σ w_j / (1 + (r_j/s)²) for either scale s, and Σ w_j r_j
        / Σ w_j. On an edge the planes of its own side speak for a point, where one plane through
        both sides would not.
        """
        nx, ny, nz, height, w, x, y, z = (column.take(near) for column in self.table)
        nx *= own[:, 0] - x
        ny *= own[:, 1] - y
        nz *= own[:, 2] - z
        r = np.abs(nx + ny + nz - height)
        square = r * r
        close, far = ((w / (1 + square * np.float32(scale**-2))).sum(0) for scale in scales)
        mean = np.einsum("ij,ij->j", w, r) / (w.sum(0) + np.float32(1e-3))
        return np.asarray(np.log(columns(close, far, mean) + np.float32(LEAST)))


def log_odds(noise: F32) -> F32:
    """log(p / (1 − p)) of probabilities (M,), bounded at about ±7."""
    floor = np.float32(1e-3)
    return np.asarray(np.log((noise + floor) / (1 - noise + floor)), np.float32)
