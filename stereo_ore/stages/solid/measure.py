"""Volume, centroid, calliper and box of a convex body given by points."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from stereo_ore.types import F32, F64, I32

IN_PLANE_TURNS = 12
"""Turns of the box tried about each face normal: steps of 7.5°, whose loss in length is below 0.3
%."""
BOX_FACES = 24
"""Faces tried as a side of the box, the largest first: the small ones of a rounded lump are nearly
parallel to them."""
_DIRECTIONS = 80
"""Directions in which a cloud's extreme points are sought."""
TRIMMED = 0.01
"""Share of a cloud's points that may be wild: those farthest in a direction are passed over."""


@dataclass(frozen=True)
class Body:
    """A convex polyhedron: vertices (V, 3), triangles (T, 3) into them, volume [m³] and centroid
    (3,).
    """

    vertices: F64
    triangles: I32
    volume: float
    centroid: F64


@dataclass(frozen=True)
class Box:
    """Centre (3,), unit axes as rows (3, 3), right-handed, longest first, and lengths along them
    (3,) [m].
    """

    centre: F64
    axes: F64
    extent: F64


def extremes(points: F64) -> F64:
    """Points (M, 3) that span (N, 3) ones: in each of `_DIRECTIONS` the farthest but a share of
    `TRIMMED`.
    """
    rank = len(points) - 1 - int(TRIMMED * len(points))
    columns, found = points.T.astype(np.float32), []
    # In parts: a larger product would wake a pool of threads, which takes longer than the product.
    for part in np.split(_sphere(), 4):
        along = part @ columns
        limit = np.partition(along, rank, axis=1)[:, rank]
        found.append((along == limit[:, None]).argmax(1))
    return np.asarray(points[np.unique(np.concatenate(found))])


@functools.cache
def _sphere() -> F32:
    """Unit vectors (DIRECTIONS, 3) spread evenly, on a spiral."""
    i = np.arange(_DIRECTIONS) + 0.5
    polar, azimuth = np.arccos(1 - 2 * i / _DIRECTIONS), np.pi * (1 + np.sqrt(5)) * i
    around = np.sin(polar)
    return np.stack([np.cos(azimuth) * around, np.sin(azimuth) * around, np.cos(polar)], 1).astype(
        np.float32
    )


def convex_body(points: F64) -> Body | None:
    """Convex hull of (N, 3) points with its volume and centroid, or None when they span no volume.

    The centroid is the volume-weighted mean of the tetrahedra that an inner point makes with the
    faces.
    """
    if len(points) < 4:
        return None
    try:
        hull = ConvexHull(points)
    except QhullError:
        return None
    outer = np.flatnonzero(np.bincount(hull.simplices.ravel()))
    vertices = points[outer]
    inner = vertices.mean(0)
    corners = points[hull.simplices] - inner
    volumes = np.abs((_cross(corners[:, 0], corners[:, 1]) * corners[:, 2]).sum(1)) / 6.0
    if not volumes.sum() > 0:
        return None
    centroid = inner + (volumes[:, None] * corners.sum(1)).sum(0) / (4.0 * volumes.sum())
    number = np.full(len(points), -1, np.int32)
    number[outer] = np.arange(len(outer))
    return Body(vertices, number[hull.simplices], float(volumes.sum()), centroid)


def _cross(a: F64, b: F64) -> F64:
    """Cross product of (N, 3) rows; `np.cross` spends more time on its axes than on the product."""
    i, j = [1, 2, 0], [2, 0, 1]
    return np.asarray(a[:, i] * b[:, j] - a[:, j] * b[:, i])


def longest_calliper(vertices: F64) -> float:
    """Largest distance [m] between two of (V, 3) points."""
    square = (vertices**2).sum(1)
    return float(
        np.sqrt(max((square[:, None] + square[None] - 2.0 * vertices @ vertices.T).max(), 0.0))
    )


def smallest_box(body: Body) -> Box:
    """Box of least volume that lies flat on a large face of the body."""
    normals = _face_normals(body)
    helper = np.eye(3)[np.abs(normals).argmin(1)]
    first = _cross(normals, helper)
    first /= np.sqrt((first**2).sum(1, keepdims=True))
    second = _cross(normals, first)
    turn = np.arange(2 * IN_PLANE_TURNS) * (0.5 * np.pi / IN_PLANE_TURNS)
    sides = np.cos(turn)[:, None, None] * first + np.sin(turn)[:, None, None] * second
    centred = body.vertices - body.centroid
    width = _widths(centred, sides.reshape(-1, 3)).reshape(2, IN_PLANE_TURNS, -1)
    volume = width[0] * width[1] * _widths(centred, normals)
    k, face = np.unravel_index(int(volume.argmin()), volume.shape)
    u = sides[k, face]
    axes = np.stack([u, sides[k + IN_PLANE_TURNS, face], normals[face]])
    along = centred @ axes.T
    low, high = along.min(0), along.max(0)
    order = np.argsort(low - high, kind="stable")
    centre = body.centroid + (0.5 * (low + high)) @ axes
    axes = axes[order]
    axes[2] = _cross(axes[:1], axes[1:2])[0]
    return Box(centre, axes, (high - low)[order])


def _widths(points: F64, directions: F64) -> F64:
    """Extent (D,) of points (N, 3) along unit directions (D, 3)."""
    along = points @ directions.T
    return np.asarray(along.max(0) - along.min(0))


def _face_normals(body: Body) -> F64:
    """Unit normals (F, 3) of the largest faces."""
    p = body.vertices[body.triangles]
    normals = _cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    length = np.sqrt((normals**2).sum(1))
    large = np.argsort(-length, kind="stable")[:BOX_FACES]
    large = large[length[large] > 0]
    return np.asarray(normals[large] / length[large, None])
