"""From a rectified pair to disparities: match both ways, compare, drop what can't be right, say what is doubtful."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np

from stereo_ore.config import MatchingConfig
from stereo_ore.matching import cues, sgbm
from stereo_ore.matching.region import default_disparities
from stereo_ore.types import F32, U8, Disparity, Mask, RectifiedPair, Region, Rig


def match(pair: RectifiedPair, region: Region, config: MatchingConfig) -> Disparity:
    """Disparity of the left image's pixels inside a region.

    Parameters
    ----------
    pair : RectifiedPair
        Row-aligned BGR images.
    region : Region
        Where to match, from `find_region`.
    config : MatchingConfig
        Parameters of the matcher.

    Returns
    -------
    Disparity
        Full-image values [px], the calibration's correction added, NaN outside the region and where nothing reliable
        was found; cues for each pixel; counts of what was dropped and why.
    """
    images = sgbm.crop(_grey(pair.left), _grey(pair.right), region)
    left, right = sgbm.match_left(images, config), sgbm.match_right(images, config)
    lr_diff = left_right_difference(left, right, region.num_disparities)
    found = np.isfinite(left)
    consistent = lr_diff <= config.lr_max_diff
    inside = _has_counterpart(left, region)
    values = np.where(consistent & inside, left, np.float32(np.nan))
    steady = drop_speckles(values, config)
    doubts = cues.compute(_inner(images.left, region), _warp(images, steady), steady, lr_diff)
    counts = _counts(pair.rig, region, {
        "matched": found, "consistent": found & consistent & inside, "disparities": np.isfinite(steady)
    })  # fmt: skip
    offset = region.min_disparity + pair.rig.disparity_offset_px
    return Disparity(
        _full(pair.rig, region, steady + np.float32(offset)),
        region,
        {name: _full(pair.rig, region, cue) for name, cue in doubts.items()},
        counts,
    )


def left_right_difference(left: F32, right: F32, num_disparities: int) -> F32:
    """|left's disparity − the right's at its counterpart| [px], (h, w); NaN where either is missing.

    The right's is interpolated between the two nearest columns, so the comparison is in fractions of a pixel.
    """
    height, width = left.shape
    columns = np.arange(width, dtype=np.float32) + num_disparities
    x = np.where(np.isfinite(left), columns - left, np.float32(-1))
    y = np.broadcast_to(np.arange(height, dtype=np.float32)[:, None], left.shape)
    nearest = cv2.remap(right, x, np.ascontiguousarray(y), cv2.INTER_NEAREST, borderValue=float("nan"))
    return np.asarray(np.abs(left - nearest), np.float32)


def drop_speckles(values: F32, config: MatchingConfig) -> F32:
    """Without connected patches smaller than `speckle_size`."""
    if config.speckle_size == 0:
        return values
    none = -sgbm.SUBPIXEL
    fixed = np.where(np.isfinite(values), np.rint(values * sgbm.SUBPIXEL), none).astype(np.int16)
    cv2.filterSpeckles(fixed, none, config.speckle_size, config.speckle_range * sgbm.SUBPIXEL)
    return np.where(fixed == none, np.float32(np.nan), values)


def _grey(image: U8) -> U8:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)


def _inner(image: U8, region: Region) -> U8:
    """The region's own columns of a crop."""
    n = region.num_disparities
    return np.ascontiguousarray(image[:, n:-n])


def _warp(images: sgbm.Crop, values: F32) -> F32:
    """The right image as the left eye would see it, (h, w) float32."""
    height, width = values.shape
    columns = np.arange(width, dtype=np.float32) + images.region.num_disparities
    x = columns - np.where(np.isfinite(values), values, np.float32(0))
    y = np.broadcast_to(np.arange(height, dtype=np.float32)[:, None], values.shape)
    return np.asarray(cv2.remap(images.right.astype(np.float32), x, np.ascontiguousarray(y), cv2.INTER_LINEAR))


def _has_counterpart(values: F32, region: Region) -> Mask:
    """True where the matching pixel of the right image exists."""
    return np.arange(region.x0, region.x1) - region.min_disparity - values >= 0


def _full(rig: Rig, region: Region, part: F32) -> F32:
    whole = np.full((rig.height, rig.width), np.nan, np.float32)
    whole[region.slices] = part
    return whole


def _counts(rig: Rig, region: Region, masks: Mapping[str, Mask]) -> dict[str, Any]:
    """How many pixels passed each step, and the share of the whole image's search that the region saved."""
    pixels = (region.x1 - region.x0) * (region.y1 - region.y0)
    whole = rig.width * rig.height * default_disparities(rig.width)
    saved = 1 - pixels * region.num_disparities / whole
    return {"pixels": pixels, **{name: int(mask.sum()) for name, mask in masks.items()}, "saved_share": saved}
