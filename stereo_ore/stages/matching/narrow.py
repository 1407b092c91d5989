"""A look at a small copy of the pair: how much of a region the frame in hand needs."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from stereo_ore.config import MatchingConfig
from stereo_ore.stages.matching import light, sgbm
from stereo_ore.stages.matching.match import grey
from stereo_ore.stages.matching.region import MARGIN_PX, round_up
from stereo_ore.types import F32, Mask, RectifiedPair, Region, Rig, Volume

FAR_SHARE = 0.005
"""Share of the far end of the disparities that may be missed behind the volume: wrong matches are
there."""

SHORT_RANGE = 32
"""Without a volume so few disparities are sooner searched than looked over."""

_LEAST_SHARE = 0.02
"""Below this share of matched pixels the small copy is not believed."""


def narrow(
    pair: RectifiedPair, region: Region, volume: Volume | None, config: MatchingConfig
) -> Region:
    """The part of a region, and of its disparities, that this frame shows.

    A reduced copy is matched first. It is searched down to infinity: a pixel that shows the pit
    behind the volume must be free to say so, or it would be given the best disparity inside.

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
    scale = light.coarse_scale(pair.rig.width)
    coarse = _coarse_region(pair.rig, region, scale)
    left, right = (light.reduced(grey(eye), scale) for eye in (pair.left, pair.right))
    images = sgbm.crop(left, right, coarse)
    found = light.first_look(images, config).found
    seen = found.valid
    if seen.mean() < _LEAST_SHARE:
        return region
    disparity = (sgbm.to_px(found.left) + np.float32(coarse.min_disparity)) * np.float32(scale)
    if volume is None:
        return _range(region, coarse, scale, disparity, seen, None)
    inside = _in_volume(pair.rig, coarse, scale, disparity, seen, volume)
    if not inside.any():
        return region
    return _range(_around(region, coarse, scale, inside), coarse, scale, disparity, seen, inside)


def _coarse_region(rig: Rig, region: Region, scale: int) -> Region:
    lowest = math.floor(min(region.min_disparity, -rig.shift_px) / scale)
    highest = math.ceil((region.min_disparity + region.num_disparities) / scale)
    x1, y1 = (
        min(-(-region.x1 // scale), rig.width // scale),
        min(-(-region.y1 // scale), rig.height // scale),
    )
    return Region(
        region.x0 // scale, region.y0 // scale, x1, y1, lowest, round_up(highest - lowest)
    )


def _in_volume(
    rig: Rig, coarse: Region, scale: int, disparity: F32, seen: Mask, volume: Volume
) -> Mask:
    """The pixels of the copy whose points lie in the volume."""
    rows, columns = np.nonzero(seen)
    z = rig.depth(disparity[seen] + rig.disparity_offset_px)
    xyz = rig.back_project((columns + coarse.x0) * scale, (rows + coarse.y0) * scale, z)
    inside = seen.copy()
    inside[seen] = volume.contains(xyz.astype(np.float32))
    return inside


def _around(region: Region, coarse: Region, scale: int, inside: Mask) -> Region:
    """The rectangle of the region that holds the pixels inside, with a margin."""
    rows, columns = (
        np.flatnonzero(inside.any(1)) + coarse.y0,
        np.flatnonzero(inside.any(0)) + coarse.x0,
    )
    margin = MARGIN_PX + scale
    return replace(
        region,
        x0=max(int(columns[0]) * scale - margin, region.x0),
        y0=max(int(rows[0]) * scale - margin, region.y0),
        x1=min(int(columns[-1] + 1) * scale + margin, region.x1),
        y1=min(int(rows[-1] + 1) * scale + margin, region.y1),
    )


def _range(
    region: Region, coarse: Region, scale: int, disparity: F32, seen: Mask, inside: Mask | None
) -> Region:
    """The region with the disparities seen in it, half a pixel of the copy more at both ends."""
    part = (
        slice(region.y0 // scale - coarse.y0, -(-region.y1 // scale) - coarse.y0),
        slice(region.x0 // scale - coarse.x0, -(-region.x1 // scale) - coarse.x0),
    )
    found = disparity[part][seen[part]]
    farthest = float(np.quantile(found, FAR_SHARE))
    if inside is not None:
        farthest = min(farthest, float(disparity[inside].min()))
    lowest = max(math.floor(farthest - scale / 2), coarse.min_disparity * scale)
    highest = min(
        math.ceil(found.max() + scale / 2), region.min_disparity + region.num_disparities - 1
    )
    return replace(region, min_disparity=lowest, num_disparities=round_up(highest - lowest + 1))
