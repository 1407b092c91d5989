"""Whether both eyes show a lump equally sharply: a drop or dirt on one glass smears what lies
behind it, and its disparity comes out smooth, likely, and wrong.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from stereo_ore.config import HealthConfig
from stereo_ore.types import F32, U8, Disparity, OreMap, Reason, RectifiedPair, StrikePlan

_FINE_PX, _COARSE_PX = 1.0, 2.0
"""Standard deviations between which detail is looked at: finer is noise."""
_MARGIN_PX = 8


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
    rows, columns = disparity.region.slices
    top, bottom = max(rows.start - _MARGIN_PX, 0), rows.stop + _MARGIN_PX
    left, right = (_detail(eye[top:bottom]) for eye in (pair.left, pair.right))
    lumps = (ore_map.labels > 0) & np.isfinite(disparity.values)
    v, u = np.nonzero(lumps[rows, columns])
    v, u = v + rows.start, u + columns.start
    there = np.clip(np.rint(u - disparity.values[v, u]).astype(np.intp), 0, right.shape[1] - 1)
    label, size = ore_map.labels[v, u], len(plans) + 1
    sums = [
        np.bincount(label, detail[v - top, at], size)[1:]
        for detail, at in ((left, u), (right, there))
    ]
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


def _detail(image: U8) -> F32:
    """Energy of the detail at each pixel."""
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.float32)
    fine, coarse = (cv2.GaussianBlur(grey, (0, 0), sigma) for sigma in (_FINE_PX, _COARSE_PX))
    return np.asarray((fine - coarse) ** 2, np.float32)
