"""Which pixels are ore: what stands out of the plane or lies between bars, drawn to the edges of
the image.
"""

from __future__ import annotations

import cv2
import numpy as np

from stereo_ore.config import SegmentConfig
from stereo_ore.stages.segment.relief import Relief
from stereo_ore.threads import pool
from stereo_ore.types import F32, U8, Grizzly, Mask

LEAST, MOST = -1.0, 2.0
"""Evidence beyond these is as good as certain; the limits keep a wrong match from outvoting its
neighbours."""
BETWEEN_BARS = 1.2
"""Evidence of a surface at the height of the bar tops where there is no bar."""
EDGE_VARIANCE = 50.0
"""Variance of grey levels that counts as an edge in the guided filter."""
STRIPS = 4
"""Parts of the image that threads filter."""


def threshold_px(relief: Relief, opening_m: float | None, config: SegmentConfig) -> float:
    """Relief [px] that stands out: the larger of the noise and a share of the opening."""
    least = config.min_height * (opening_m or 0.0) * relief.px_per_m
    return max(config.sigmas * relief.sigma_px, least)


def ore_evidence(px: F32, between: Mask, threshold: float) -> F32:
    """Evidence of ore at each pixel; 1 is a relief of just the threshold.

    Parameters
    ----------
    px : (h, w) float32
        Relief [px], 0 on the frame; NaN, where nothing was matched, speaks against ore.
    between : (h, w) mask
        What lies well between two bars and not below their tops: that is ore too.
    threshold : float
        Relief that stands out [px].
    """
    evidence = px / np.float32(threshold)
    evidence[np.isnan(px)] = LEAST
    np.clip(evidence, LEAST, MOST, out=evidence)
    evidence[between] = np.maximum(evidence[between], BETWEEN_BARS)
    return evidence


def ore_mask(probability: F32, grey: U8, config: SegmentConfig, area: float) -> Mask:
    """Pixels of ore where the image agrees on the outline, without connected parts of fewer pixels
    than `area`.

    The probability spreads over even areas of the grey image and stops at its edges (He et al.
    2013, guided filter).
    """
    likely = _smoothed(probability, grey, config.guide_radius_px) > config.ore_probability
    opened = cv2.morphologyEx(likely.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    _, labels = cv2.connectedComponents(opened, connectivity=4)
    mask: Mask = opened > 0
    ore = np.flatnonzero(mask)
    mine = labels.ravel()[ore]
    mask.ravel()[ore] = (np.bincount(mine) >= area)[mine]
    return mask


def _smoothed(probability: F32, grey: U8, radius: int) -> F32:
    """The probability under the guided filter, in strips of rows that threads share."""
    margin, height = 2 * radius, len(grey)
    cuts = [height * i // STRIPS for i in range(STRIPS + 1)]

    def strip(first: int, end: int) -> F32:
        top = max(first - margin, 0)
        rows = np.s_[top : end + margin]
        smooth = cv2.ximgproc.guidedFilter(grey[rows], probability[rows], radius, EDGE_VARIANCE)
        return np.asarray(smooth[first - top : end - top], dtype=np.float32)

    return np.concatenate(list(pool().map(strip, cuts[:-1], cuts[1:])))


def bar_margin(relief: Relief, grizzly: Grizzly) -> float:
    """Clearance [m] beyond which a point is not a bar's, smeared by the matching window."""
    return 4 * relief.pixel_m + 0.03 * (grizzly.opening_m or 0.0)
