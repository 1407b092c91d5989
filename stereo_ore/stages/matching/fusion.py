"""Several frames of a still scene as one: robust mean of the disparities, and a test that the scene
was still.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from stereo_ore.errors import FrameError
from stereo_ore.stages.matching import sgbm, subpixel, windows
from stereo_ore.types import F32, U8, Disparity, Mask, RectifiedPair, Region

SMALL_WIDTH_PX = 320
"""Width at which frames are compared: what moves covers pixels of it, noise averages out."""

CHANGE_SIGMA, LEAST_CHANGE, MOST_CHANGE = 6.0, 4.0, 12.0
"""A pixel of the small frame has changed beyond this many standard deviations, kept between two
grey levels: where all frames move, their differences are not noise."""

CHANGED_SHARE = 0.002
"""Share of changed pixels above which a frame moves."""

_OUTLIER_PX = 1.0
"""Disparities farther from their median belong to another surface."""


def fuse(pairs: Sequence[RectifiedPair], disparities: Sequence[Disparity]) -> Disparity:
    """One disparity from N frames of a still scene.

    Each pixel is the mean of the disparities within `_OUTLIER_PX` of their median, where more than
    half of the still frames have one: √N less noise, where a median alone would give 0.8 √N. What
    all frames have in common, the matcher's preference for whole pixels, is lessened by one more
    refinement on the mean images.

    Parameters
    ----------
    pairs : sequence of RectifiedPair
        The frames, of one camera.
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
    still = still_frames([pair.left for pair in pairs])
    if 2 * still.sum() <= len(still):
        raise FrameError(
            f"{(~still).sum()} of {len(still)} frames to be fused moved",
            code="MOVING_SCENE",
            remedy="Record when nothing moves, or fuse fewer frames",
        )
    frames = [
        (pair, disparity)
        for pair, disparity, ok in zip(pairs, disparities, still, strict=True)
        if ok
    ]
    kept = [disparity for _, disparity in frames]
    region = _hull([disparity.region for disparity in kept])
    values, support = _robust_mean(np.stack([disparity.values for disparity in kept]))
    if len(kept) > 1:
        values = _refine([pair for pair, _ in frames], region, values)
    names = set.intersection(*(set(disparity.cues) for disparity in kept))
    return Disparity(
        values,
        region,
        _mean([disparity.confidence for disparity in kept], np.isfinite(values)),
        {
            name: np.mean([_spread(disparity, name, region) for disparity in kept], axis=0)
            for name in sorted(names)
        },
        {
            **kept[0].diagnostics,
            "fused": len(kept),
            "refused": np.flatnonzero(~still).tolist(),
            "support": support,
        },
    )


def _mean(confidences: Sequence[F32], where: Mask) -> F32:
    """Mean confidence of a pixel over the frames (H, W), a frame without a disparity counting as 0;
    NaN elsewhere.
    """
    total = np.sum(
        [np.nan_to_num(confidence) for confidence in confidences], axis=0, dtype=np.float32
    )
    return np.where(where, total / np.float32(len(confidences)), np.float32(np.nan))


def _spread(disparity: Disparity, name: str, region: Region) -> F32:
    """A cue laid into a region that holds the disparity's own; 0 beside that."""
    own = disparity.region
    cue = np.zeros((region.y1 - region.y0, region.x1 - region.x0), np.float32)
    cue[own.y0 - region.y0 : own.y1 - region.y0, own.x0 - region.x0 : own.x1 - region.x0] = (
        disparity.cues[name]
    )
    return cue


def _refine(pairs: Sequence[RectifiedPair], region: Region, values: F32) -> F32:
    """Disparities (H, W) refined on the mean of the frames' images."""
    left, right = (_mean_grey([getattr(pair, eye) for pair in pairs]) for eye in ("left", "right"))
    images = sgbm.crop(left, right, region)
    offset = np.float32(region.min_disparity + pairs[0].rig.disparity_offset_px)
    part = values[region.slices] - offset
    valid = np.isfinite(part)
    filled = np.where(valid, part, np.float32(0))
    refined = values.copy()
    fine = subpixel.refine_disparity(images, filled, windows.support(valid)).values
    np.copyto(refined[region.slices], fine + offset, where=valid)
    return refined


def _mean_grey(images: Sequence[U8]) -> U8:
    total = np.zeros(images[0].shape[:2], np.float32)
    for image in images:
        total += cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return np.rint(total / len(images)).astype(np.uint8)


def still_frames(lefts: Sequence[U8]) -> Mask:
    """(N,) True for the frames that show what most of them show."""
    small = np.stack([_small(left) for left in lefts])
    small *= small.mean() / np.maximum(small.mean((1, 2), keepdims=True), 1)
    difference = np.abs(small - np.median(small, 0))
    noise = 1.4826 * float(np.median(difference))
    changed = difference > min(max(CHANGE_SIGMA * noise, LEAST_CHANGE), MOST_CHANGE)
    return np.asarray(changed.mean((1, 2)) <= CHANGED_SHARE)


def _small(image: U8) -> F32:
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    width = min(SMALL_WIDTH_PX, grey.shape[1])
    size = (width, max(round(grey.shape[0] * width / grey.shape[1]), 1))
    return cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32)


def _robust_mean(stack: F32) -> tuple[F32, float]:
    """Mean of (N, H, W) near the median, NaN where at most half the frames have a value; mean
    support of the others.
    """
    ordered = np.sort(stack, axis=0)
    count = np.isfinite(stack).sum(0)
    middle = np.take_along_axis(ordered, np.maximum(count - 1, 0)[None] // 2, 0)
    near = np.abs(stack - middle) <= _OUTLIER_PX
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
