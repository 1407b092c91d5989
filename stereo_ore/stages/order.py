"""Which lump to break first."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stereo_ore.config.models import OrderConfig
from stereo_ore.transforms import transform_points
from stereo_ore.types import F64, Reason, Site, Solid, StrikePlan


def order(
    solids: Sequence[Solid | None], plans: Sequence[StrikePlan], site: Site, config: OrderConfig
) -> tuple[int, ...]:
    """Ids of the lumps that are to be broken and can be struck, best first.

    Each gets a sum: oversize (half when unknown), height of its strike among the others', its
    strike's score, less the arm's way to it from the middle of its reach when that is known. Sums
    are rounded to the configured resolution so that noise does not reorder equals; the lower id
    goes first among them.
    """
    ids = [i for i, plan in enumerate(plans, 1) if plan.strikes and _wanted(solids[i - 1], config)]
    if not ids:
        return ()
    best = [plans[i - 1].strikes[0] for i in ids]
    points = np.array([strike.point for strike in best])
    up = (
        site.plane.normal
        if site.plane is not None
        else -np.mean([strike.direction for strike in best], 0)
    )
    total = (
        config.oversize_weight * np.array([_urgency(solids[i - 1]) for i in ids])
        + config.height_weight * _over_largest(points @ up - (points @ up).min())
        + config.strike_weight * np.array([strike.score for strike in best])
        - config.travel_weight * _over_largest(_way(points, site))
    )
    rank = np.round(total / config.resolution).astype(int)
    return tuple(i for _, i in sorted(zip((-rank).tolist(), ids, strict=True)))


def passing(solids: Sequence[Solid | None], config: OrderConfig) -> tuple[tuple[Reason, ...], ...]:
    """PASSES for each lump that is no target because it falls through by itself; entry i belongs
    to id i + 1.
    """
    reason = Reason("PASSES", "its middle dimension is less than the opening (order.include)")
    return tuple(() if _wanted(solid, config) else (reason,) for solid in solids)


def _wanted(solid: Solid | None, config: OrderConfig) -> bool:
    """Whether a lump is to be broken: an unknown size may be too large."""
    return config.include == "all" or solid is None or solid.oversize is not False


def _urgency(solid: Solid | None) -> float:
    oversize = solid.oversize if solid else None
    return 0.5 if oversize is None else float(oversize)


def _way(points: F64, site: Site) -> F64:
    """Distance (N,) [m] of points from the middle of the arm's reach; zero when no reach is
    given.
    """
    if site.T_arm_camera is None or site.reach_min_m is None or site.reach_max_m is None:
        return np.zeros(len(points))
    middle = 0.5 * (site.reach_min_m + site.reach_max_m)
    return np.asarray(np.linalg.norm(transform_points(site.T_arm_camera, points) - middle, axis=1))


def _over_largest(values: F64) -> F64:
    return np.asarray(values / max(float(values.max()), 1e-9))
