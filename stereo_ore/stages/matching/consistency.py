"""Left-right consistency in fractions of a pixel."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from stereo_ore.config import MatchingConfig
from stereo_ore.stages.matching import sgbm, windows
from stereo_ore.stages.matching.bands import in_bands
from stereo_ore.stages.matching.sgbm import Crop
from stereo_ore.types import F32, I16, Mask

RIM_PX = 3
"""Window in which an agreed disparity vouches for its neighbours on the same surface."""

MISSING = np.int16(2**15 - 1)
"""Left-right difference where either match has none."""


@dataclass(frozen=True)
class Agreement:
    """What both directions found, (h, w).

    left: disparity as matched [px / 16], negative where none was found; difference: |left − right| [px / 16],
    `MISSING` where either has none; texture: RMS of the horizontal gradient [grey levels a px]; valid: consistent,
    textured, seen by both eyes, and not a speckle.
    """

    left: I16
    difference: I16
    texture: F32
    valid: Mask

    def rows(self, rows: slice) -> Agreement:
        """Some of its rows."""
        return Agreement(self.left[rows], self.difference[rows], self.texture[rows], self.valid[rows])


def match_both(images: Crop, config: MatchingConfig) -> Agreement:
    """Match both ways, and keep what both agree on."""
    left, right = sgbm.match_left(images, config), sgbm.match_right(images, config)
    inner, limit = images.inner, int(config.lr_max_diff * sgbm.SUBPIXEL)
    difference, agreed, texture = np.empty_like(left), np.empty_like(left), np.empty(left.shape, np.float32)

    def compare(rows: slice, core: slice, band: slice) -> None:
        part, found = left[rows], left_right_difference(images.columns, left, right, rows)
        relief = windows.texture(inner[rows])
        same = (found <= limit) & has_counterpart(images, part) & (relief >= config.min_texture)
        difference[band], texture[band] = found[core], relief[core]
        agreed[band] = vouch(part, same, limit)[core]

    in_bands(len(left), RIM_PX // 2 + windows.TEXTURE_PX // 2, compare)
    return Agreement(left, difference, texture, sgbm.drop_speckles(agreed, config.speckle_size, config.speckle_range))


def left_right_difference(columns: F32, left: I16, right: I16, rows: slice) -> I16:
    """|left's disparity − the right's at its counterpart| [px / 16]; `MISSING` where either has none.

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
    missing = ((part < 0) | np.less(there, 0)) * MISSING
    return np.asarray(cv2.max(cv2.absdiff(part, there), missing), np.int16)


def vouch(left: I16, agreed: Mask, step: int) -> I16:
    """Agreed disparities, and those of neighbours that differ from one of them by less than a step [px / 16].

    The rims of near surfaces are seen by one eye a little wider than by the other; beside an agreed pixel the left
    match is believed when it continues its surface.
    """
    kernel = np.ones((RIM_PX, RIM_PX), np.uint8)
    kept = cv2.copyTo(left, agreed.view(np.uint8), np.full_like(left, sgbm.NONE))
    above = cv2.dilate(kept, kernel)
    # Without their sign the negative ones are above all others.
    below = cv2.erode(kept.view(np.uint16), kernel).view(np.int16)
    joins = (cv2.absdiff(left, above) < step) | (cv2.absdiff(left, below) < step)
    joins &= (left >= 0) & (above >= 0)
    return np.asarray(cv2.copyTo(left, joins.view(np.uint8), kept), np.int16)


def has_counterpart(images: Crop, left: I16) -> Mask:
    """True where the matching pixel lies inside the right image."""
    region = images.region
    sixteenths = (np.arange(region.x0, region.x1) - region.min_disparity) * sgbm.SUBPIXEL
    return np.asarray(left <= np.clip(sixteenths, sgbm.NONE, MISSING).astype(np.int16))
