"""Which lumps lie on others: a blow on one that is carried, or that carries, moves the other."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from stereo_ore.transforms import frame_from_normal
from stereo_ore.types import F32, F64, Plane, Solid

_OVERLAP = 0.25
"""Share of the smaller one's shadow on the screen that lies in the other's."""
_ABOVE = 0.1
"""How much higher the upper one's centre of gravity is, in its own longest dimension."""
_APART = 0.1
"""Vertical distance between both, in the upper one's longest dimension, over which nothing is
carried."""


def carried(solids: Sequence[Solid | None], plane: Plane) -> tuple[tuple[int, int], ...]:
    """Pairs of ids (upper, lower), in order, of lumps that lie on others.

    One lump lies on another when their shadows on the screen overlap, its centre of gravity is the
    higher one, and there is no gap between them. The undersides are modelled, so this is a
    judgement, not a measurement.

    Parameters
    ----------
    solids : sequence of Solid or None
        Entry i belongs to id i + 1, camera frame.
    plane : Plane
        Of the bar tops.
    """
    across = np.eye(3)[int(np.abs(plane.normal).argmin())]
    axes = frame_from_normal(plane.normal, across)
    known = [(id, solid) for id, solid in enumerate(solids, 1) if solid is not None]
    shadows = {id: _shadow(solid, axes) for id, solid in known}
    return tuple(
        (upper, lower)
        for upper, top in known
        for lower, base in known
        if upper != lower
        and _is_on(top, base, plane)
        and _overlap(shadows[upper], shadows[lower]) > _OVERLAP
    )


def _shadow(solid: Solid, axes: F64) -> F32:
    """Outline (K, 1, 2) [m] of the solid seen along the screen's normal."""
    return np.asarray(cv2.convexHull((solid.vertices @ axes[:2].T).astype(np.float32)), np.float32)


def _overlap(one: F32, other: F32) -> float:
    """Area common to two outlines, over that of the smaller."""
    least = min(cv2.contourArea(one), cv2.contourArea(other))
    return float(cv2.intersectConvexConvex(one, other)[0] / least) if least > 0 else 0.0


def _is_on(top: Solid, base: Solid, plane: Plane) -> bool:
    size = float(top.size_m[0])
    higher = plane.height(top.centre_of_gravity) - plane.height(base.centre_of_gravity)
    gap = plane.height(top.vertices).min() - plane.height(base.vertices).max()
    return bool(higher > _ABOVE * size and gap < _APART * size)
