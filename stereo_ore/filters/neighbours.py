"""Nearest neighbours: searched once, shared by everything that a filter computes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from stereo_ore.types import F32, I32

CHUNK = 200_000
"""Points searched at a time: bounds the float64 and int64 arrays that the tree hands out."""


@dataclass(frozen=True)
class Neighbours:
    """The k nearest other points of each point, nearest first: index (M, k) int32, distance (M, k) float32 [m]."""

    index: I32
    distance: F32

    @property
    def k(self) -> int:
        """Neighbours a point."""
        return int(self.index.shape[1])


def search(xyz: F32, k: int) -> Neighbours:
    """Find the k nearest other points of each point by a k-d tree (equation 1).

    Parameters
    ----------
    xyz : (M, 3) array
        Finite and distinct points, best in an order that keeps neighbours together. M > 1.
    k : int
        Neighbours wanted; M − 1 when there are no more.
    """
    points = xyz.astype(np.float64)
    k = min(k, len(points) - 1)
    tree = cKDTree(points, balanced_tree=False, compact_nodes=False)
    index = np.empty((len(points), k), np.int32)
    distance = np.empty((len(points), k), np.float32)
    for rows in chunks(len(points)):
        d, i = tree.query(points[rows], k + 1, workers=-1)
        # Points are distinct, so the nearest is the point itself.
        distance[rows], index[rows] = np.asarray(d)[:, 1:], np.asarray(i)[:, 1:]
    return Neighbours(index, distance)


def chunks(length: int, size: int = CHUNK) -> Iterator[slice]:
    """Consecutive slices of at most `size` rows."""
    return (slice(start, min(start + size, length)) for start in range(0, length, size))


def density(distance: F32) -> F32:
    """ρ = 1 / mean distance of (M, k) neighbours, (M,) [1/m] (equation 2)."""
    rho: F32 = 1 / np.maximum(distance.mean(1), np.finfo(np.float32).tiny)
    return rho


def spacing(neighbours: Neighbours) -> float:
    """Median distance to the nearest neighbour [m]."""
    return float(np.median(neighbours.distance[:, 0]))
