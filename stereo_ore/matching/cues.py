"""What the matcher doubts about each disparity: the quantities of `types.CUES`, by box filters."""

from __future__ import annotations

import cv2
import numpy as np

from stereo_ore.types import F32, U8, Mask

SHARE_WINDOW_PX = 21
SPREAD_WINDOW_PX = 9
PATCH_WINDOW_PX = 5
EPSILON = 1e-6


def compute(left: U8, right_at_left: F32, values: F32, lr_diff: F32) -> dict[str, F32]:
    """The cues of a crop.

    Parameters
    ----------
    left : (h, w) uint8
        Grey left image.
    right_at_left : (h, w) float32
        Right image warped by the disparity; anything where there is none.
    values : (h, w) float32
        Disparity [px], NaN where there is none.
    lr_diff : (h, w) float32
        Left-right difference [px].

    Returns
    -------
    dict
        (h, w) float32 of each name of `types.CUES`.
    """
    valid = np.isfinite(values)
    filled = np.where(valid, values, np.float32(0))
    texture = horizontal_texture(left)
    error = np.abs(left.astype(np.float32) - right_at_left) * valid
    share = _mean(valid.astype(np.float32), PATCH_WINDOW_PX)
    return {
        "valid_share": _mean(valid.astype(np.float32), SHARE_WINDOW_PX),
        "spread_px": spread(filled, valid),
        "lr_diff_px": np.where(valid, lr_diff, np.float32(np.nan)),
        "texture": texture,
        "photometric": _mean(error, PATCH_WINDOW_PX) / np.maximum(share, EPSILON) / (texture + 1),
        "median_diff_px": np.abs(values - cv2.medianBlur(filled, 5)),
    }


def horizontal_texture(left: U8) -> F32:
    """Root mean square of the horizontal gradient in a window [grey levels a px]."""
    gradient = cv2.Sobel(left, cv2.CV_32F, 1, 0, ksize=1, scale=0.5)
    return np.sqrt(_mean(gradient * gradient, PATCH_WINDOW_PX))


def spread(filled: F32, valid: Mask) -> F32:
    """Standard deviation [px] of the disparities in a window."""
    weight = np.maximum(_mean(valid.astype(np.float32), SPREAD_WINDOW_PX), EPSILON)
    mean = _mean(filled, SPREAD_WINDOW_PX) / weight
    square = _mean(filled * filled, SPREAD_WINDOW_PX) / weight
    return np.sqrt(np.maximum(square - mean * mean, 0))


def _mean(image: F32, window: int) -> F32:
    return np.asarray(cv2.boxFilter(image, cv2.CV_32F, (window, window), borderType=cv2.BORDER_REFLECT), np.float32)
