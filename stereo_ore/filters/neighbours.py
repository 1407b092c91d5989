"""Nearest neighbours: searched once, shared by everything that a filter computes."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from stereo_ore.types import F32, I32

CHUNK = 8192
"""Points worked on at a time: bounds the memory of temporaries, and keeps them in the processor's cache."""

TINY = np.finfo(np.float32).tiny
Scalar = TypeVar("Scalar", bound=np.generic)


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
    index, distance = np.empty((len(points), k), np.int32), np.empty((len(points), k), np.float32)

    def fill(rows: slice) -> None:
        d, i = tree.query(points[rows], k + 1)
        # Points are distinct, so the nearest is the point itself.
        distance[rows], index[rows] = np.asarray(d)[:, 1:], np.asarray(i)[:, 1:]

    _each_chunk(fill, len(points))
    return Neighbours(index, distance)


def map_rows(function: Callable[[slice], npt.NDArray[Scalar]], length: int) -> npt.NDArray[Scalar]:
    """What `function` gives for consecutive chunks of rows, one after the other, computed on all processors.

    A chunk's result doesn't depend on the others, so the number of processors changes nothing.
    """
    return np.concatenate(_each_chunk(function, length))


Result = TypeVar("Result")


def _each_chunk(function: Callable[[slice], Result], length: int) -> list[Result]:
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(function, chunks(length)))


def chunks(length: int, size: int = CHUNK) -> Iterator[slice]:
    """Consecutive slices of at most `size` rows; one empty slice for no rows."""
    return (slice(start, min(start + size, length)) for start in range(0, max(length, 1), size))


def density(distance: F32) -> F32:
    """ρ = 1 / mean distance of (M, k) neighbours, (M,) [1/m] (equation 2)."""
    rho: F32 = 1 / np.maximum(distance.mean(1), TINY)
    return rho


def spacing(neighbours: Neighbours) -> float:
    """Median distance to the nearest neighbour [m]."""
    return float(np.median(neighbours.distance[:, 0]))
