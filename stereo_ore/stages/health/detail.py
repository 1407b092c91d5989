"""Whether both eyes show a lump equally sharply: a drop or dirt on one glass smears what lies
behind it, and its disparity comes out smooth, likely, and wrong.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from stereo_ore.config import HealthConfig
from stereo_ore.threads import pool
from stereo_ore.types import F32, U8, Disparity, OreMap, Reason, RectifiedPair, StrikePlan

_Index = npt.NDArray[np.intp]
_FINE_PX, _COARSE_PX = 1.0, 2.0
"""Standard deviations between which detail is looked at: finer is noise."""
_MARGIN_PX = 8
"""How far detail looks, four coarse deviations."""


def without_blurred(
    plans: Sequence[StrikePlan],
    ore_map: OreMap,
    disparity: Disparity,
    pair: RectifiedPair,
    config: HealthConfig,
) -> tuple[StrikePlan, ...]:
    """The plans, without strikes of lumps of which one eye shows much less detail than the other.

    Parameters
    ----------
    plans
        Entry i is that of id i + 1.
    ore_map, disparity, pair
        Lumps, what was matched, and the rectified images.
    config : HealthConfig
        `min_detail_ratio`.
    """
    inner = disparity.region.slices
    lumps = (ore_map.labels[inner] > 0) & np.isfinite(disparity.values[inner])
    if not lumps.any():
        return tuple(plans)
    v, u = np.nonzero(lumps)
    v, u = v + disparity.region.y0, u + disparity.region.x0
    there = np.clip(np.rint(u - disparity.values[v, u]).astype(np.intp), 0, pair.rig.width - 1)
    label, size = ore_map.labels[v, u], len(plans) + 1
    details = pool().map(_detail, (pair.left, pair.right), (v, v), (u, there))
    sums = [np.bincount(label, detail, size)[1:] for detail in details]
    ratio = np.minimum(*sums) / np.maximum(np.maximum(*sums), 1e-9)
    return tuple(
        StrikePlan((), (_doubt(share),))
        if plan.strikes and share < config.min_detail_ratio
        else plan
        for plan, share in zip(plans, ratio, strict=True)
    )


def _doubt(share: float) -> Reason:
    text = f"one eye shows {100 * share:.0f} % of the detail that the other shows of it"
    return Reason("ONE_EYE_BLURRED", f"{text}: is there a drop or dirt on its glass?")


def _detail(image: U8, v: _Index, u: _Index) -> F32:
    """Energy of the detail (N,) at pixels."""
    top, left = (max(int(at.min()) - _MARGIN_PX, 0) for at in (v, u))
    piece = image[top : v.max() + _MARGIN_PX + 1, left : u.max() + _MARGIN_PX + 1]
    grey = cv2.cvtColor(piece, cv2.COLOR_BGR2GRAY).astype(np.float32)
    fine, coarse = (cv2.GaussianBlur(grey, (0, 0), sigma) for sigma in (_FINE_PX, _COARSE_PX))
    return np.asarray((fine - coarse)[v - top, u - left] ** 2, np.float32)
