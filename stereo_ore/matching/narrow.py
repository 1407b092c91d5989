"""A look at a small copy of the pair: how much of a region the frame in hand needs."""

from __future__ import annotations

import math

import cv2
import numpy as np

from stereo_ore.config import MatchingConfig
from stereo_ore.matching import consistency, sgbm
from stereo_ore.matching.match import grey
from stereo_ore.matching.region import MARGIN_PX, round_up
from stereo_ore.types import F32, U8, Mask, RectifiedPair, Region, Rig, Volume

COARSE_WIDTH_PX = 320
"""Largest width to which the pair is reduced; by two at least."""

COARSE = {"mode": "3way", "uniqueness": 10, "lr_max_diff": 1.0, "speckle_size": 20, "speckle_range": 1.0}
"""A noisy disparity of the small copy would widen the range, so doubt decides against it; no lump is a speckle."""

FAR_SHARE = 0.005
"""Share of the far end of the disparities that may be missed: nothing of interest is there, but wrong matches are."""

SHORT_RANGE = 96
"""Without a volume so few disparities are sooner searched than looked over."""

LEAST_SHARE = 0.02
"""Below this share of matched pixels the small copy is not believed."""


def narrow(pair: RectifiedPair, region: Region, volume: Volume | None, config: MatchingConfig) -> Region:
    """The part of a region, and of its disparities, that this frame shows.

    A reduced copy is matched first. It is searched down to infinity: a pixel that shows the pit behind the volume must
    be free to say so, or it would be given the best disparity inside.

    Parameters
    ----------
    pair : RectifiedPair
        Row-aligned BGR images.
    region : Region
        From `find_region`.
    volume : Volume or None
        Limits the rectangle to where points of the copy lie inside.
    config : MatchingConfig
        `narrow` false, or an explicit number of disparities: the region is returned as it is.
    """
    short = volume is None and region.num_disparities <= SHORT_RANGE
    if not config.narrow or config.num_disparities is not None or short:
        return region
    scale = max(-(-pair.rig.width // COARSE_WIDTH_PX), 2)
    coarse = _coarse_region(pair.rig, region, scale)
    images = sgbm.crop(_reduce(grey(pair.left), scale), _reduce(grey(pair.right), scale), coarse)
    matched, _, seen = consistency.match_both(images, config.model_copy(update=COARSE))
    if seen.mean() < LEAST_SHARE:
        return region
    disparity = (sgbm.to_px(matched) + np.float32(coarse.min_disparity)) * np.float32(scale)
    rectangle = _rectangle(pair.rig, region, coarse, scale, disparity, seen, volume)
    return _range(region, rectangle, coarse, scale, disparity, seen)


def _coarse_region(rig: Rig, region: Region, scale: int) -> Region:
    lowest = math.floor(min(region.min_disparity, max(0.0, -rig.doffs_px)) / scale)
    highest = math.ceil((region.min_disparity + region.num_disparities) / scale)
    x1, y1 = min(-(-region.x1 // scale), rig.width // scale), min(-(-region.y1 // scale), rig.height // scale)
    return Region(region.x0 // scale, region.y0 // scale, x1, y1, lowest, round_up(highest - lowest))


def _reduce(image: U8, scale: int) -> U8:
    height, width = image.shape[0] // scale, image.shape[1] // scale
    part = image[: height * scale, : width * scale]
    return np.asarray(cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def _rectangle(
    rig: Rig, region: Region, coarse: Region, scale: int, disparity: F32, seen: Mask, volume: Volume | None
) -> tuple[int, int, int, int]:
    """Corners of what shows the volume, x0, y0, x1, y1 [px]; the region's own without a volume."""
    whole = (region.x0, region.y0, region.x1, region.y1)
    if volume is None:
        return whole
    rows, columns = np.nonzero(seen)
    u, v = ((index + first) * scale for index, first in ((columns, coarse.x0), (rows, coarse.y0)))
    z = rig.depth(disparity[seen] + rig.disparity_offset_px)
    inside = volume.contains(rig.back_project(u, v, z).astype(np.float32))
    if not inside.any():
        return whole
    u, v = u[inside], v[inside]
    margin = MARGIN_PX + scale
    return (
        max(int(u.min()) - margin, region.x0),
        max(int(v.min()) - margin, region.y0),
        min(int(u.max()) + scale + margin, region.x1),
        min(int(v.max()) + scale + margin, region.y1),
    )


def _range(
    region: Region, rectangle: tuple[int, int, int, int], coarse: Region, scale: int, disparity: F32, seen: Mask
) -> Region:
    """The rectangle with the disparities seen in it, half a pixel of the copy more at both ends."""
    x0, y0, x1, y1 = rectangle
    part = (
        slice(y0 // scale - coarse.y0, -(-y1 // scale) - coarse.y0),
        slice(x0 // scale - coarse.x0, -(-x1 // scale) - coarse.x0),
    )
    found = disparity[part][seen[part]]
    lowest = max(math.floor(np.quantile(found, FAR_SHARE) - scale / 2), coarse.min_disparity * scale)
    highest = min(math.ceil(found.max() + scale / 2), region.min_disparity + region.num_disparities - 1)
    return Region(x0, y0, x1, y1, lowest, round_up(highest - lowest + 1))
