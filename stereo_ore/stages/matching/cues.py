"""What the matcher doubts about each disparity: the quantities of `types.CUES`, by box filters."""

from __future__ import annotations

import cv2
import numpy as np

from stereo_ore.stages.matching import sgbm, subpixel, windows
from stereo_ore.stages.matching.consistency import Agreement
from stereo_ore.stages.matching.windows import Support
from stereo_ore.types import F32, I16

SHARE_PX, SPREAD_PX = 21, 9
"""Windows of the valid share and of the spread; that of the photometric error is
`subpixel.PATCH_PX`."""

ABSOLUTE_TO_SIGMA = 1.2533
"""Standard deviation over mean absolute deviation of a normal distribution."""

MAX_DEVIATION_PX = 8.0
"""Deviations count up to here, so that one wild pixel does not fill its window."""


CUES_REACH_PX = max(SHARE_PX // 2, SPREAD_PX // 2 + 2, subpixel.REACH_PX)
"""How far from a pixel the cues look, with what they are given."""


def pixel_cues(found: Agreement, matched: I16, around: Support, residual: F32) -> dict[str, F32]:
    """The cues of a crop, each (h, w) float32.

    Parameters
    ----------
    found : Agreement
        Of both directions; a missing right match counts as `MAX_DEVIATION_PX`.
    matched : (h, w) int16
        Disparity as matched [px / 16], 0 where it is not valid.
    around : Support
        Where there is a disparity in the end.
    residual : (h, w) float32
        From `subpixel.refine_disparity`, [grey levels].
    """
    deviation = (
        _limited(np.asarray(cv2.absdiff(matched, cv2.medianBlur(matched, 5)), np.int16))
        * around.weight
    )
    near = np.maximum(windows.count_valid(around.valid, SPREAD_PX), np.float32(1))
    return {
        "valid_share": windows.count_valid(around.valid, SHARE_PX) * np.float32(1 / SHARE_PX**2),
        "spread_px": np.float32(ABSOLUTE_TO_SIGMA) * windows.total(deviation, SPREAD_PX) / near,
        "lr_diff_px": _limited(found.difference) * around.weight,
        "texture": found.texture,
        "photometric": np.float32(1 / ABSOLUTE_TO_SIGMA)
        * residual
        / (found.texture + np.float32(1)),
        "median_diff_px": deviation,
    }


def _limited(difference: I16) -> F32:
    """Sixteenths as pixels, at most `MAX_DEVIATION_PX`."""
    return np.minimum(sgbm.to_px(difference), np.float32(MAX_DEVIATION_PX))
