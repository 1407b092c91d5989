"""Places of the site in which nothing is ore."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from stereo_ore.types import F64, Capsule, KeepOut, Mask, Surface, Volume


def inside(surface: Surface, place: KeepOut) -> Mask:
    """Pixels of the surface (h, w) that are in a place; those without a depth are in no body."""
    body = place.body
    if isinstance(body, (Volume, Capsule)):
        return body.contains(surface.xyz)
    mask = np.zeros(surface.sigma_z.shape, np.uint8)
    corners = np.rint(body.corners_px - [surface.x0, surface.y0]).astype(np.int32)
    return np.asarray(cv2.fillPoly(mask, [corners], 1) > 0)


def distances(points: F64, places: Sequence[KeepOut]) -> F64:
    """Distance [m] of points (N, 3) from the nearest body (N,); inf where there is none."""
    nearest = np.full(len(points), np.inf)
    for place in places:
        body = place.body
        if isinstance(body, Capsule):
            nearest = np.minimum(nearest, body.distance(points))
        elif isinstance(body, Volume):
            nearest = np.minimum(nearest, _from_box(points, body))
    return nearest


def _from_box(points: F64, box: Volume) -> F64:
    inside = points @ box.T_box_camera[:3, :3].T + box.T_box_camera[:3, 3]
    beyond = np.maximum(np.maximum(box.min_m - inside, inside - box.max_m), 0)
    return np.asarray(np.linalg.norm(beyond, axis=1))
