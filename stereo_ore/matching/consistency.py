"""Left-right consistency in fractions of a pixel."""

from __future__ import annotations

import cv2
import numpy as np

from stereo_ore.config import MatchingConfig
from stereo_ore.matching import sgbm
from stereo_ore.matching.sgbm import Crop
from stereo_ore.types import F32, Mask


def match_both(images: Crop, config: MatchingConfig) -> tuple[F32, F32, Mask]:
    """Match both ways, and keep what both agree on.

    Returns
    -------
    left : (h, w) float32
        Disparity as matched [px], NaN where none was found.
    difference : (h, w) float32
        Left-right difference [px].
    valid : (h, w) bool
        Consistent, seen by both eyes, and not a speckle.
    """
    left, right = sgbm.match_left(images, config), sgbm.match_right(images, config)
    difference = left_right_difference(images, left, right)
    consistent = (difference <= config.lr_max_diff) & has_counterpart(images, left)
    agreed = np.where(consistent, left, np.float32(np.nan))
    return left, difference, sgbm.drop_speckles(agreed, config.speckle_size, config.speckle_range)


def left_right_difference(images: Crop, left: F32, right: F32) -> F32:
    """|left's disparity − the right's at its counterpart| [px], (h, w) float32; NaN where either is missing.

    Parameters
    ----------
    images : Crop
        What was matched.
    left : (h, w) float32
        From `sgbm.match_left`.
    right : (h, w + n) float32
        From `sgbm.match_right`.
    """
    x = np.where(np.isfinite(left), images.columns - left, np.float32(-1))
    y = np.repeat(np.arange(len(x), dtype=np.float32)[:, None], x.shape[1], 1)
    counterpart = cv2.remap(right, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=float("nan"))
    return np.asarray(np.abs(left - counterpart), np.float32)


def has_counterpart(images: Crop, left: F32) -> Mask:
    """True where the matching pixel lies inside the right image."""
    region = images.region
    return np.asarray(np.arange(region.x0, region.x1) - region.min_disparity - left >= 0)
