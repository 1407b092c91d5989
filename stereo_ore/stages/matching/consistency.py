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

MISSING = np.int16(2**15 - 1)
"""Left-right difference where either match has none."""


@dataclass(frozen=True)
class Agreement:
    """What both directions found, (h, w).

    left: disparity as matched [px / 16], negative where none was found; difference: |left − right|
    [px / 16], `MISSING` where either has none; texture: RMS of the horizontal gradient [grey levels
    a px]; valid: consistent, textured, seen by both eyes, and not a speckle.
    """

    left: I16
    difference: I16
    texture: F32
    valid: Mask

    @property
    def matched(self) -> I16:
        """Disparity as matched [px / 16], 0 where it is not valid, (h, w)."""
        return self.left * self.valid

    @property
    def filled(self) -> F32:
        """The same in px."""
        return sgbm.to_px(self.matched)

    def rows(self, rows: slice) -> Agreement:
        """Some of its rows."""
        return Agreement(
            self.left[rows], self.difference[rows], self.texture[rows], self.valid[rows]
        )


def match_both(images: Crop, config: MatchingConfig, compared: Crop | None = None) -> Agreement:
    """Match both ways, and keep what both agree on and what is textured.

    Parameters
    ----------
    images : Crop
        Grey images.
    config : MatchingConfig
        Parameters of the matcher.
    compared : Crop or None
        What is matched in their place, such as the same with normalised contrast, which has texture
        everywhere.
    """
    compared, config = compared or images, sgbm.with_block(config, images)
    left, right = sgbm.match_left(compared, config), sgbm.match_right(compared, config)
    inner, limit = images.inner, int(config.lr_max_diff * sgbm.SUBPIXEL)
    difference, agreed, texture = (
        np.empty_like(left),
        np.empty_like(left),
        np.empty(left.shape, np.float32),
    )

    def compare(rows: slice, core: slice, band: slice) -> None:
        part, found = left[rows], left_right_difference(images.columns, left, right, rows)
        relief = windows.texture(inner[rows])
        same = (found <= limit) & (relief >= config.min_texture)
        difference[band], texture[band] = found[core], relief[core]
        agreed[band] = cv2.copyTo(part, same.view(np.uint8), np.full_like(part, sgbm.NONE))[core]

    in_bands(len(left), windows.TEXTURE_PX // 2, compare)
    return Agreement(
        left,
        difference,
        texture,
        sgbm.drop_speckles(agreed, config.speckle_size, config.speckle_range),
    )


def left_right_difference(columns: F32, left: I16, right: I16, rows: slice) -> I16:
    """|left's disparity − the right's at its counterpart| [px / 16]; `MISSING` where either has
    none.

    Parameters
    ----------
    columns : (w,) float32
        Crop column of each column of the region.
    left : (h, w) int16
        From `sgbm.match_left`.
    right : (h, w + n) int16
        From `sgbm.match_right`.
    rows : slice
        Rows of the left image to compare.
    """
    part = left[rows]
    x = columns - sgbm.to_px(part)
    y = np.repeat(np.arange(len(part), dtype=np.float32)[:, None], x.shape[1], 1)
    there = cv2.remap(
        right[rows],
        x,
        y,
        cv2.INTER_NEAREST,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=float(sgbm.NONE),
    )
    missing = ((part < 0) | np.less(there, 0)) * MISSING
    return np.asarray(cv2.max(cv2.absdiff(part, there), missing), np.int16)
