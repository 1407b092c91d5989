"""Nearest neighbours: searched once, shared by everything that a filter computes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from stereo_ore.threads import each_chunk
from stereo_ore.types import F32

TINY = np.finfo(np.float32).tiny
Index = npt.NDArray[np.integer[Any]]

EXACT_TREE = {"algorithm": 4, "leaf_max_size": 20, "reorder": True}
"""FLANN's single k-d tree, which is exact."""

Search = Callable[[F32, int], tuple[Index, F32]]


@dataclass(frozen=True)
class Neighbours:
    """The k nearest other points of each point, nearest first: index (M, k), distance (M, k)
    float32 [m].

    Both lie in memory column by column: what is computed over neighbours then runs along points.
    """

    index: Index
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
    index, distance = nearest(xyz, xyz, min(k, len(xyz) - 1) + 1)
    # Points are distinct, so the nearest is the point itself.
    return Neighbours(index[:, 1:], distance[:, 1:])


def nearest(points: F32, at: F32, k: int) -> tuple[Index, F32]:
    """Rows (M, k) of the k nearest of `points` (N, 3), k ≤ N, to each of `at` (M, 3), and their
    distances (M, k).
    """
    # Squares stay in range, and a power of two costs no digit.
    exponent = int(np.clip(np.frexp(max(np.abs(points).max(), np.abs(at).max()))[1], -100, 100))
    down, up = np.float32(2.0**-exponent), np.float32(2.0**exponent)
    tree = _tree(np.ascontiguousarray(points * down))
    index, distance = np.empty((k, len(at)), np.int32), np.empty((k, len(at)), np.float32)

    def fill(rows: slice) -> None:
        i, d = tree(np.ascontiguousarray(at[rows] * down), k)
        index[:, rows], distance[:, rows] = i.T, (d * up).T

    each_chunk(fill, len(at))
    return index.T, distance.T


def _tree(points: F32) -> Search:
    """What finds rows (M, k) of `points`, and distances (M, k), from a k-d tree.

    FLANN takes 60 % of SciPy's time, but not every build of OpenCV has it.
    """
    make = getattr(cv2, "flann_Index", None)
    return _scipy_tree(points) if make is None else _flann_tree(make(points, EXACT_TREE))


def _flann_tree(tree: Any) -> Search:
    def find(at: F32, k: int) -> tuple[Index, F32]:
        index, squared = tree.knnSearch(at, k, params={})
        return index, np.sqrt(squared)

    return find


def _scipy_tree(points: F32) -> Search:
    tree = cKDTree(points, balanced_tree=False)

    def find(at: F32, k: int) -> tuple[Index, F32]:
        distance, index = tree.query(at, range(1, k + 1))
        return np.asarray(index), np.asarray(distance, np.float32)

    return find


def by_neighbour(index: Index, rows: slice | Index) -> npt.NDArray[np.intp]:
    """Neighbours (k, n) of n points: sums over k, row upon row, are several times faster than along
    rows.
    """
    return np.ascontiguousarray(index[rows].T, np.intp)


def columns(*values: npt.NDArray[np.floating[Any]]) -> F32:
    """Columns (M, F) of (M,) arrays or of (M, f) ones, each lying in memory at a stretch."""
    return np.concatenate([np.atleast_2d(v.T) for v in values], dtype=np.float32).T


def density(distance: F32) -> F32:
    """ρ = 1 / mean distance of (M, k) neighbours, (M,) [1/m] (equation 2)."""
    rho: F32 = 1 / np.maximum(distance.mean(1), TINY)
    return rho


def spacing(neighbours: Neighbours) -> float:
    """Median distance to the nearest neighbour [m]."""
    return float(np.median(neighbours.distance[:, 0]))
