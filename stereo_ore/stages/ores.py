"""The lumps of a frame with all that is known of each."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stereo_ore.types import Ore, OreMap, Reason, Site, Solid, StrikePlan, Surface


def describe_ores(
    surface: Surface,
    ore_map: OreMap,
    solids: tuple[Solid | None, ...],
    plans: tuple[StrikePlan, ...],
    site: Site,
    reasons: Sequence[tuple[Reason, ...]],
    resting: Sequence[tuple[int, int]] = (),
) -> tuple[Ore, ...]:
    """Count and locate the lumps of an ore map, in the camera's and where it is known the arm's
    frame.

    `reasons` say of each what else is known; `resting` are pairs of ids (upper, lower).
    """
    height, width = surface.xyz.shape[:2]
    labels = ore_map.labels[surface.y0 : surface.y0 + height, surface.x0 : surface.x0 + width]
    n = len(solids)
    inside = np.flatnonzero(labels > 0)
    mine, xyz = labels.ravel()[inside].astype(np.intp), surface.xyz.reshape(-1, 3)[inside]
    measured = np.flatnonzero(np.isfinite(xyz[:, 2]))
    seen = mine[measured]
    pixels, points = (np.bincount(each, minlength=n + 1) for each in (mine, seen))
    sums = [np.bincount(seen, axis, n + 1) for axis in xyz[measured].T]
    centroids = np.stack(sums, 1) / np.maximum(points, 1)[:, None]
    ores = (
        Ore(
            id,
            int(points[id]),
            int(pixels[id]),
            id in ore_map.cut,
            centroids[id],
            solids[id - 1],
            plans[id - 1],
            reasons[id - 1],
            carries=tuple(upper for upper, lower in resting if lower == id),
            carried_by=tuple(lower for upper, lower in resting if upper == id),
        )
        for id in range(1, n + 1)
    )
    return tuple(ore.located(site.T_arm_camera) for ore in ores)
