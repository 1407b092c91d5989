"""From a rectified pair to disparities: match both ways, compare, drop what can't be right, say what is doubtful."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from stereo_ore.config import MatchingConfig
from stereo_ore.matching import consistency, cues, sgbm, subpixel
from stereo_ore.matching.region import default_disparities
from stereo_ore.types import F32, U8, Disparity, RectifiedPair, Region, Rig


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
        was found; cues for each pixel; counts of what each step left.
    """
    images = sgbm.crop(grey(pair.left), grey(pair.right), region)
    left, lr_diff, valid = consistency.match_both(images, config)
    filled = np.where(valid, left, np.float32(0))
    refined = subpixel.refine(images, filled, valid)
    doubts = cues.compute(filled, valid, lr_diff, refined)
    offset = np.float32(region.min_disparity + pair.rig.disparity_offset_px)
    values = np.where(valid, refined.values + offset, np.float32(np.nan))
    passed = {"matched": np.isfinite(left), "disparities": valid}
    return Disparity(
        _full(pair.rig, region, values),
        region,
        {name: _full(pair.rig, region, cue) for name, cue in doubts.items()},
        search_saved(pair.rig, region) | {name: int(mask.sum()) for name, mask in passed.items()},
    )


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
        "saved_share": 1 - pixels * region.num_disparities / whole,
    }


def _full(rig: Rig, region: Region, part: F32) -> F32:
    whole = np.full((rig.height, rig.width), np.nan, np.float32)
    whole[region.slices] = part
    return whole
