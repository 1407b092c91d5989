"""Which lump to break first."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stereo_ore.config.models import OrderConfig
from stereo_ore.transforms import transform_points
from stereo_ore.types import F64, Reason, Site, Solid, StrikePlan

PASSES_HOLE = Reason("PASSES", "it falls through the opening by itself (order.include)")


def order(
    solids: Sequence[Solid | None], plans: Sequence[StrikePlan], site: Site, config: OrderConfig
) -> tuple[int, ...]:
    """Ids of the lumps that are to be broken and can be struck, best first.

    Their sums, see `urgencies`, are rounded to the configured resolution so that noise does not
    reorder equals; the lower id goes first among them.
    """
    flags = [solid.oversize if solid else None for solid in solids]
    best = {i: plan.strikes[0] for i, plan in enumerate(plans, 1) if plan.strikes}
    ids = [i for i in best if is_wanted(flags[i - 1], config)]
    if not ids:
        return ()
    points = np.array([best[i].point for i in ids])
    up = (
        site.plane.normal
        if site.plane is not None
        else -np.mean([best[i].direction for i in ids], 0)
    )
    arm = None if site.T_arm_camera is None else transform_points(site.T_arm_camera, points)
    total = urgencies(
        [flags[i - 1] for i in ids], points @ up, [best[i].score for i in ids], arm, site, config
    )
    rank = np.round(total / config.resolution).astype(int)
    return tuple(ids[k] for k in np.argsort(-rank, kind="stable"))


def urgencies(
    oversize: Sequence[bool | None],
    height_m: F64,
    score: Sequence[float],
    arm_m: F64 | None,
    site: Site,
    config: OrderConfig,
) -> F64:
    """Sums (N,) by which lumps are broken, the largest first.

    Oversize (half when unknown), height of the strike (N,) among the others', its score, less the
    arm's way to it (N, 3) from the middle of its reach when that is known.
    """
    urgent = [0.5 if flag is None else float(flag) for flag in oversize]
    return np.asarray(
        config.oversize_weight * np.array(urgent)
        + config.height_weight * _over_largest(height_m - height_m.min())
        + config.strike_weight * np.array(score)
        - config.travel_weight * _over_largest(_way(arm_m, len(urgent), site))
    )


def calmly(total: F64, before: Sequence[int | None], config: OrderConfig) -> list[int]:
    """Indices of N lumps by their sums (N,), the largest first; `before` are their places in the
    order of the frame before, None for those that had none.

    Two that follow each other in the order before change places when their sums differ by more than
    `calm`.
    """
    old = sorted((place, k) for k, place in enumerate(before) if place is not None)
    order = [k for _, k in old]
    for end in range(len(order) - 1, 0, -1):
        for k in range(end):
            if total[order[k + 1]] > total[order[k]] + config.calm:
                order[k], order[k + 1] = order[k + 1], order[k]
    for new in [k for k, place in enumerate(before) if place is None]:
        behind = sum(bool(total[k] >= total[new]) for k in order)
        order.insert(behind, new)
    return order


def passing(solids: Sequence[Solid | None], config: OrderConfig) -> tuple[tuple[Reason, ...], ...]:
    """PASSES for each lump that is no target because it falls through by itself; entry i belongs
    to id i + 1.
    """
    return tuple(
        () if is_wanted(solid.oversize if solid else None, config) else (PASSES_HOLE,)
        for solid in solids
    )


def is_wanted(oversize: bool | None, config: OrderConfig) -> bool:
    """Whether a lump is to be broken: an unknown size may be too large."""
    return config.include == "all" or oversize is not False


def _way(arm_m: F64 | None, count: int, site: Site) -> F64:
    """Distance (count,) [m] of points in the arm frame from the middle of the arm's reach; zero
    when no reach is given.
    """
    if arm_m is None or site.reach_min_m is None or site.reach_max_m is None:
        return np.zeros(count)
    middle = 0.5 * (site.reach_min_m + site.reach_max_m)
    return np.asarray(np.linalg.norm(arm_m - middle, axis=1))


def _over_largest(values: F64) -> F64:
    return np.asarray(values / max(float(values.max()), 1e-9))
