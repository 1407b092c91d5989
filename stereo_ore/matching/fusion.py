"""Several frames of a still scene as one: robust mean of the disparities, and a test that the scene was still."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from stereo_ore.errors import FrameError
from stereo_ore.types import F32, U8, Disparity, Mask, Region

SMALL_WIDTH_PX = 320
"""Width at which frames are compared: what moves covers pixels of it, noise averages out."""

CHANGE_SIGMA, CHANGE_GREY = 6.0, 4.0
"""A pixel of the small frame has changed beyond this many standard deviations and grey levels."""

CHANGED_SHARE = 0.002
"""Share of changed pixels above which a frame moves."""

OUTLIER_PX = 1.0
"""Disparities farther from their median belong to another surface."""


def fuse(lefts: Sequence[U8], disparities: Sequence[Disparity]) -> Disparity:
    """One disparity from N frames of a still scene.

    Each pixel is the mean of the disparities within `OUTLIER_PX` of their median, where more than half of the still
    frames have one: √N less noise, where a median alone would give 0.8 √N.

    Parameters
    ----------
    lefts : sequence of (H, W, 3) uint8
        Rectified left images.
    disparities : sequence of Disparity
        Of the same frames.

    Returns
    -------
    Disparity
        Its diagnostics name the frames refused, and the mean support of a pixel.

    Raises
    ------
    FrameError
        When no more than half of the frames show the same scene.
    """
    still = still_frames(lefts)
    if 2 * still.sum() <= len(still):
        raise FrameError(
            f"{(~still).sum()} of {len(still)} frames to be fused moved",
            code="MOVING_SCENE",
            remedy="Record when nothing moves, or fuse fewer frames",
        )
    kept = [disparity for disparity, ok in zip(disparities, still, strict=True) if ok]
    values, support = _robust_mean(np.stack([disparity.values for disparity in kept]))
    names = set.intersection(*(set(disparity.cues) for disparity in kept))
    refused = [int(index) for index in np.flatnonzero(~still)]
    return Disparity(
        values,
        _hull([disparity.region for disparity in kept]),
        {name: np.mean([disparity.cues[name] for disparity in kept], axis=0) for name in sorted(names)},
        {**kept[0].diagnostics, "fused": len(kept), "refused": refused, "support": support},
    )


def still_frames(lefts: Sequence[U8]) -> Mask:
    """(N,) True for the frames that show what most of them show."""
    small = np.stack([_small(left) for left in lefts])
    small *= small.mean() / np.maximum(small.mean((1, 2), keepdims=True), 1)
    difference = np.abs(small - np.median(small, 0))
    noise = 1.4826 * float(np.median(difference))
    changed = difference > max(CHANGE_SIGMA * noise, CHANGE_GREY)
    return np.asarray(changed.mean((1, 2)) <= CHANGED_SHARE)


def _small(image: U8) -> F32:
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    width = min(SMALL_WIDTH_PX, grey.shape[1])
    size = (width, max(round(grey.shape[0] * width / grey.shape[1]), 1))
    return cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32)


def _robust_mean(stack: F32) -> tuple[F32, float]:
    """Mean of (N, H, W) near the median, NaN where at most half the frames have a value; mean support of the others."""
    ordered = np.sort(stack, axis=0)
    count = np.isfinite(stack).sum(0)
    middle = np.take_along_axis(ordered, np.maximum(count - 1, 0)[None] // 2, 0)
    near = np.abs(stack - middle) <= OUTLIER_PX
    support = near.sum(0)
    total = np.where(near, stack, np.float32(0)).sum(0)
    enough = 2 * support > len(stack)
    values = np.full(total.shape, np.nan, np.float32)
    np.divide(total, support, out=values, where=enough)
    return values, float(support[enough].mean()) if enough.any() else 0.0


def _hull(regions: Sequence[Region]) -> Region:
    lowest = min(region.min_disparity for region in regions)
    highest = max(region.min_disparity + region.num_disparities for region in regions)
    return Region(
        min(region.x0 for region in regions),
        min(region.y0 for region in regions),
        max(region.x1 for region in regions),
        max(region.y1 for region in regions),
        lowest,
        highest - lowest,
    )
