"""Volume, centroid, calliper and box of a convex body given by points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from stereo_ore.types import F64, I32

IN_PLANE_TURNS = 12
"""Turns of the box tried about each face normal: steps of 7.5°, whose loss in length is below 0.3 %."""
BOX_FACES = 24
"""Faces tried as a side of the box, the largest first: the small ones of a rounded lump are nearly parallel to them."""
DIRECTIONS = 120
"""Directions in which a cloud's extreme points are sought."""
TRIMMED = 0.01
"""Share of a cloud's points that may be wild: those farthest in a direction are passed over."""


@dataclass(frozen=True)
class Body:
    """A convex polyhedron: vertices (V, 3), triangles (T, 3) into them, volume [m³] and centroid (3,)."""

    vertices: F64
    triangles: I32
    volume: float
    centroid: F64


@dataclass(frozen=True)
class Box:
    """Centre (3,), unit axes as rows (3, 3), right-handed, longest first, and lengths along them (3,) [m]."""

    centre: F64
    axes: F64
    extent: F64


def extremes(points: F64) -> F64:
    """Points (M, 3) that span (N, 3) ones: in each of `DIRECTIONS` the farthest but a share of `TRIMMED`."""
    i = np.arange(DIRECTIONS) + 0.5
    polar, azimuth = np.arccos(1 - 2 * i / DIRECTIONS), np.pi * (1 + np.sqrt(5)) * i
    around = np.sin(polar)
    directions = np.stack([np.cos(azimuth) * around, np.sin(azimuth) * around, np.cos(polar)], 1)
    rank = len(points) - 1 - int(TRIMMED * len(points))
    return np.asarray(points[np.unique(np.argpartition(directions @ points.T, rank, axis=1)[:, rank])])


def convex_body(points: F64) -> Body | None:
    """Convex hull of (N, 3) points with its volume and centroid, or None when they span no volume.

    The centroid is the volume-weighted mean of the tetrahedra that an inner point makes with the faces.
    """
    if len(points) < 4:
        return None
    try:
        hull = ConvexHull(points)
    except QhullError:
        return None
    inner = points[hull.vertices].mean(0)
    corners = points[hull.simplices] - inner
    volumes = np.abs((_cross(corners[:, 0], corners[:, 1]) * corners[:, 2]).sum(1)) / 6.0
    if not volumes.sum() > 0:
        return None
    centroid = inner + (volumes[:, None] * corners.sum(1)).sum(0) / (4.0 * volumes.sum())
    number = np.full(len(points), -1, np.int32)
    number[hull.vertices] = np.arange(len(hull.vertices))
    return Body(points[hull.vertices], number[hull.simplices], float(volumes.sum()), centroid)


def _cross(a: F64, b: F64) -> F64:
    """Cross product of (N, 3) rows; `np.cross` spends more time on its axes than on the product."""
    i, j = [1, 2, 0], [2, 0, 1]
    return np.asarray(a[:, i] * b[:, j] - a[:, j] * b[:, i])


def longest_calliper(vertices: F64) -> float:
    """Largest distance [m] between two of (V, 3) points."""
    square = (vertices**2).sum(1)
    return float(np.sqrt(max((square[:, None] + square[None] - 2.0 * vertices @ vertices.T).max(), 0.0)))


def smallest_box(body: Body) -> Box:
    """Box of least volume that lies flat on a large face of the body."""
    normals = _face_normals(body)
    helper = np.eye(3)[np.abs(normals).argmin(1)]
    first = _cross(normals, helper)
    first /= np.sqrt((first**2).sum(1, keepdims=True))
    second = _cross(normals, first)
    turn = np.arange(IN_PLANE_TURNS) * (0.5 * np.pi / IN_PLANE_TURNS)
    cos, sin = np.cos(turn)[:, None, None], np.sin(turn)[:, None, None]
    centred = body.vertices - body.centroid
    a, b, c = centred @ first.T, centred @ second.T, np.ptp(centred @ normals.T, axis=0)
    volume = np.ptp(cos * a + sin * b, axis=1) * np.ptp(cos * b - sin * a, axis=1) * c
    k, face = np.unravel_index(int(volume.argmin()), volume.shape)
    u = np.cos(turn[k]) * first[face] + np.sin(turn[k]) * second[face]
    axes = np.stack([u, np.cross(normals[face], u), normals[face]])
    along = centred @ axes.T
    low, high = along.min(0), along.max(0)
    order = np.argsort(low - high, kind="stable")
    centre = body.centroid + (0.5 * (low + high)) @ axes
    axes = axes[order]
    axes[2] = np.cross(axes[0], axes[1])
    return Box(centre, axes, (high - low)[order])


def _face_normals(body: Body) -> F64:
    """Unit normals (F, 3) of the largest faces."""
    p = body.vertices[body.triangles]
    normals = _cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    length = np.sqrt((normals**2).sum(1))
    large = np.argsort(-length, kind="stable")[:BOX_FACES]
    large = large[length[large] > 0]
    return np.asarray(normals[large] / length[large, None])
