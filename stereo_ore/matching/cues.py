"""What the matcher doubts about each disparity: the quantities of `types.CUES`, by box filters."""

from __future__ import annotations

import cv2
import numpy as np

from stereo_ore.matching import windows
from stereo_ore.matching.subpixel import Refined
from stereo_ore.types import F32, Mask

SHARE_PX, SPREAD_PX, PATCH_PX = 21, 9, 5
"""Windows of the valid share, of the spread, and of the photometric error."""

ABSOLUTE_TO_SIGMA = 1.2533
"""Standard deviation over mean absolute deviation of a normal distribution."""

MAX_DEVIATION_PX = 8.0
"""Deviations count up to here, so that one wild pixel does not fill its window."""


def compute(matched: F32, valid: Mask, lr_diff: F32, refined: Refined) -> dict[str, F32]:
    """The cues of a crop, each (h, w) float32.

    Parameters
    ----------
    matched : (h, w) float32
        Disparity as matched [px], 0 where it is not valid.
    valid : (h, w) bool
        Where there is a disparity in the end.
    lr_diff : (h, w) float32
        Left-right difference [px]; NaN, where the right match has none, counts as `MAX_DEVIATION_PX`.
    refined : Refined
        Residuals and gradients of the images.
    """
    weight = valid.astype(np.float32)
    near = np.maximum(windows.mean(weight, PATCH_PX), windows.EPSILON)
    around = np.maximum(windows.mean(weight, SPREAD_PX), windows.EPSILON)
    deviation = np.abs(matched - cv2.medianBlur(matched, 5))
    deviation = np.minimum(deviation, np.float32(MAX_DEVIATION_PX)) * weight
    texture = windows.texture(refined.gradient)
    return {
        "valid_share": windows.mean(weight, SHARE_PX),
        "spread_px": np.float32(ABSOLUTE_TO_SIGMA) * windows.mean(deviation, SPREAD_PX) / around,
        "lr_diff_px": np.fmin(lr_diff, np.float32(MAX_DEVIATION_PX)) * weight,
        "texture": texture,
        "photometric": windows.mean(refined.residual, PATCH_PX) / near / (texture + np.float32(1)),
        "median_diff_px": deviation,
    }
