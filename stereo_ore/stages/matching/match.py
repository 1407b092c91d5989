"""From a rectified pair to disparities: match both ways, compare, drop what can't be right, say what is doubtful."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from stereo_ore.config import MatchingConfig
from stereo_ore.stages.matching import consistency, cues, relief, sgbm, subpixel, windows
from stereo_ore.stages.matching.bands import in_bands
from stereo_ore.stages.matching.consistency import Agreement
from stereo_ore.stages.matching.region import default_disparities
from stereo_ore.types import F32, PIXEL_CUES, U8, Disparity, RectifiedPair, Region, Rig

BRIGHTNESS_STEP = 4
"""Every such row tells the ratio of the eyes' brightness."""


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
        was found; cues for each pixel of the region; counts of what each step left.
    """
    images = sgbm.crop(grey(pair.left), grey(pair.right), region)
    found = consistency.match_both(images, config)
    values, doubts = _finish(images, found, pair.rig)
    counts = {"matched": int((found.left >= 0).sum()), "disparities": int(found.valid.sum())}
    return Disparity(values, region, doubts, search_saved(pair.rig, region) | counts)


def _finish(images: sgbm.Crop, found: Agreement, rig: Rig) -> tuple[F32, dict[str, F32]]:
    """Refined disparities of the whole image, and cues of the region."""
    region = images.region
    values = np.full((rig.height, rig.width), np.nan, np.float32)
    # One block: memory for many images costs more time to get than to fill.
    block = np.empty((len(PIXEL_CUES), *found.left.shape), np.float32)
    doubts = dict(zip(PIXEL_CUES, block, strict=True))
    offset = np.float32(region.min_disparity + rig.disparity_offset_px)
    every = slice(None, None, BRIGHTNESS_STEP)
    sparse = found.rows(every)
    brightness = subpixel.brightness_ratio(images.rows(every), sgbm.to_px(sparse.left), sparse.valid)

    def refine(rows: slice, core: slice, band: slice) -> None:
        part = found.rows(rows)
        around, matched = windows.support(part.valid), part.left * part.valid
        refined = subpixel.refine(images.rows(rows), sgbm.to_px(matched), around, brightness)
        target = (slice(region.y0 + band.start, region.y0 + band.stop), region.slices[1])
        values[target] = np.where(part.valid[core], refined.values[core] + offset, np.float32(np.nan))
        for name, cue in cues.compute(part, matched, around, refined.residual).items():
            doubts[name][band] = cue[core]

    in_bands(len(found.left), cues.REACH_PX, refine)
    return values, doubts | relief.compute(values[region.slices], found.valid)


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
