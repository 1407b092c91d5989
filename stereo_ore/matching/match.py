"""From a rectified pair to disparities: match both ways, compare, drop what can't be right, say what is doubtful."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from stereo_ore.config import MatchingConfig
from stereo_ore.matching import consistency, cues, sgbm, subpixel
from stereo_ore.matching.bands import in_bands
from stereo_ore.matching.region import default_disparities
from stereo_ore.types import CUES, F32, I16, U8, Disparity, Mask, RectifiedPair, Region, Rig

HALO_PX = max(cues.SHARE_PX // 2, subpixel.REACH_PX + cues.PATCH_PX // 2)
"""Rows that the windows around a pixel reach."""


def match(pair: RectifiedPair, region: Region, config: MatchingConfig) -> Disparity:
    """Disparity of the left image's pixels inside a region.

    Parameters
    ----------
    pair : RectifiedPair
        Row-aligned BGR images.
    region : Region
        Where to match, from `find_region` or `narrow`.
    config : MatchingConfig
        Parameters of the matcher.

    Returns
    -------
    Disparity
        Full-image values [px], the calibration's correction added, NaN outside the region and where nothing reliable
        was found; cues for each pixel of the region, 0 elsewhere; counts of what each step left.
    """
    images = sgbm.crop(grey(pair.left), grey(pair.right), region)
    matched, lr_diff, valid = consistency.match_both(images, config)
    values, doubts = _finish(images, matched, lr_diff, valid, pair.rig)
    counts = {"matched": int((matched >= 0).sum()), "disparities": int(valid.sum())}
    return Disparity(values, region, doubts, search_saved(pair.rig, region) | counts)


def _finish(images: sgbm.Crop, matched: I16, lr_diff: F32, valid: Mask, rig: Rig) -> tuple[F32, dict[str, F32]]:
    """Refined disparities and cues of the whole image."""
    region = images.region
    values = np.full((rig.height, rig.width), np.nan, np.float32)
    doubts = {name: np.zeros((rig.height, rig.width), np.float32) for name in CUES}
    offset = np.float32(region.min_disparity + rig.disparity_offset_px)
    disparity = sgbm.to_px(matched) * valid
    brightness = subpixel.brightness_ratio(images, disparity, valid)

    def refine(rows: slice, core: slice, band: slice) -> None:
        refined = subpixel.refine(images.rows(rows), disparity[rows], valid[rows], brightness)
        found = cues.compute(disparity[rows], valid[rows], lr_diff[rows], refined)
        target = (slice(region.y0 + band.start, region.y0 + band.stop), region.slices[1])
        np.copyto(values[target], refined.values[core] + offset, where=valid[band])
        for name, cue in found.items():
            doubts[name][target] = cue[core]

    in_bands(len(matched), HALO_PX, refine)
    return values, doubts


def grey(image: U8) -> U8:
    """Brightness of a BGR image, (H, W) uint8."""
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)


def search_saved(rig: Rig, region: Region) -> dict[str, Any]:
    """The search, and the share of that of the whole image and the default range that it saves."""
    pixels = (region.x1 - region.x0) * (region.y1 - region.y0)
    whole = rig.width * rig.height * default_disparities(rig.width)
    return {
        "pixels": pixels,
        "min_disparity": region.min_disparity,
        "num_disparities": region.num_disparities,
        "saved_share": max(1 - pixels * region.num_disparities / whole, 0.0),
    }
