"""Left-right consistency in fractions of a pixel."""

from __future__ import annotations

import cv2
import numpy as np

from stereo_ore.config import MatchingConfig
from stereo_ore.matching import sgbm, windows
from stereo_ore.matching.bands import in_bands
from stereo_ore.matching.sgbm import Crop
from stereo_ore.types import F32, I16, Mask

RIM_PX = 3
"""Window in which an agreed disparity vouches for its neighbours on the same surface."""


def match_both(images: Crop, config: MatchingConfig) -> tuple[I16, F32, Mask]:
    """Match both ways, and keep what both agree on.

    Returns
    -------
    left : (h, w) int16
        Disparity as matched [px / 16], negative where none was found.
    difference : (h, w) float32
        Left-right difference [px]; NaN where either is missing.
    valid : (h, w) bool
        Consistent, textured, seen by both eyes, and not a speckle.
    """
    left, right = sgbm.match_left(images, config), sgbm.match_right(images, config)
    inner, difference = images.inner, np.empty(left.shape, np.float32)
    agreed = np.empty(left.shape, np.int16)

    def compare(rows: slice, core: slice, band: slice) -> None:
        found = left_right_difference(images.columns, left, right, rows)
        textured = windows.texture(windows.horizontal_gradient(inner[rows])) >= config.min_texture
        same = (found <= config.lr_max_diff) & has_counterpart(images, left[rows]) & textured
        difference[band] = found[core]
        agreed[band] = vouch(np.where(same, left[rows], np.int16(sgbm.NONE)), left[rows], config.lr_max_diff)[core]

    in_bands(len(left), RIM_PX // 2 + windows.TEXTURE_PX // 2, compare)
    return left, difference, sgbm.drop_speckles(agreed, config.speckle_size, config.speckle_range)


def left_right_difference(columns: F32, left: I16, right: I16, rows: slice) -> F32:
    """|left's disparity − the right's at its counterpart| [px], float32; NaN where either is missing.

    Parameters
    ----------
    columns : (w,) float32
        Crop column of each column of the region.
    left : (h, w) int16
        From `sgbm.match_left`.
    right : (h / 2, w + n) int16
        From `sgbm.match_right`.
    rows : slice
        Rows of the left image to compare.
    """
    part = left[rows]
    x = columns - sgbm.to_px(part)
    row = np.arange(rows.start, rows.stop) * len(right) // len(left)
    y = np.repeat(row.astype(np.float32)[:, None], x.shape[1], 1)
    there = cv2.remap(right, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=float(sgbm.NONE))
    difference = np.abs(sgbm.to_px(np.subtract(part, there, dtype=np.int16)))
    difference[(part < 0) | (there < 0)] = np.nan
    return difference


def vouch(agreed: I16, left: I16, step_px: float) -> I16:
    """Agreed disparities, and those of neighbours that differ from one of them by less than a step.

    The rims of near surfaces are seen by one eye a little wider than by the other; beside an agreed pixel the left
    match is believed when it continues its surface.
    """
    kernel = np.ones((RIM_PX, RIM_PX), np.uint8)
    step, far = int(step_px * sgbm.SUBPIXEL), np.int16(2**14)
    above = cv2.dilate(agreed, kernel)
    below = cv2.erode(np.where(agreed < 0, far, agreed), kernel)
    joins = ((np.abs(left - above) < step) & (above >= 0)) | (np.abs(left - below) < step)
    return np.where(joins & (left >= 0), left, agreed)


def has_counterpart(images: Crop, left: I16) -> Mask:
    """True where the matching pixel lies inside the right image."""
    region = images.region
    column = np.arange(region.x0, region.x1, dtype=np.int32) - region.min_disparity
    return np.asarray(left <= column * sgbm.SUBPIXEL)
