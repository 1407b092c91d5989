"""How likely each pixel is ore: what a small network makes of relief, gaps, shades and colours
around it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from stereo_ore.network import Network
from stereo_ore.threads import pool
from stereo_ore.types import F32, U8, Mask

PIXEL_FEATURES = (
    "evidence", "guided", "relief_5", "measured_5", "relief_11", "measured_11", "relief_27",
    "measured_27", "highest",
    "lowest", "texture", "shading", "on_bar", "inside", "ore_colour", "ore_near", "other_colour",
    "other_near",
    "bar_colour", "bar_near",
)  # fmt: skip
"""Of a pixel: the evidence, and this under a guided filter; relief and share of measured pixels in
windows of three sizes, the largest and the smallest relief near by; texture and shading of the
image; whether a point lies over a bar, and how far inside the screen; how far its colour is from
those of sure ore, of what is surely none, and of bars near by, and how near these are."""

SIDES = (5, 11, 27)
"""Windows [px] in which relief is averaged."""
EXTREMES = 9
"""Window [px] in which the largest and the smallest relief count."""
GUIDE_RADIUS, GUIDE_VARIANCE = 8, 50.0
"""Window [px] and variance of grey levels that counts as an edge in the guided filter of the
evidence."""
MAY_SIDE, MAY_EVIDENCE = 17, 0.15
"""A pixel may be ore near a window of this side [px] with that mean evidence."""
LOWEST, HIGHEST = -4.0, 8.0
"""Bounds of the relief [thresholds]; the lower one stands for what was not measured."""
STANDS_OUT, NEARLY_ALL = 2.0, 0.8
"""Mean relief [thresholds] and share measured, in the two smaller windows, that are ore without
asking the image."""
SURE_ORE, SURE_OTHER = 1.2, 0.0
"""Guided evidence from which on a pixel shows the colours of ore, and up to which those of anything
else."""
BAR_RELIEF = 0.5
"""Largest relief [thresholds] of a pixel that shows the colours of a bar."""
STRIDE, COLOUR_REACH, COLOUR_NOISE, FEW = 4, 3.0, 4.0, 0.02
"""Colours near by are those of every so manyth pixel, under a Gaussian of this standard deviation
[strides]; the least variance of a colour, and the share of pixels of a kind below which they tell
little."""

Indices = npt.NDArray[np.intp]


@dataclass(frozen=True)
class Sight:
    """What pixels are judged by, all (h, w): evidence of ore, relief [thresholds, NaN where none],
    and the image.

    `on_bar` tells where a point lies over a bar, `inside` how far from the screen's sides
    [openings, −1…1].
    """

    evidence: F32
    relief: F32
    on_bar: Mask
    inside: F32
    bgr: U8
    grey: U8


def ore_probability(sight: Sight, network: Network) -> F32:
    """Probability (h, w) that a pixel is ore; 0 far from any evidence, 1 where it stands out
    whatever it looks like.
    """
    at = candidates(sight)
    features = pixel_features(sight, at)
    out = np.zeros(sight.evidence.shape, np.float32)
    out.ravel()[at] = np.where(_stands_out(features), np.float32(1), network.probability(features))
    return out


def candidates(sight: Sight) -> Indices:
    """Flat indices (M,) of the pixels that may be ore: with evidence near by."""
    mean = cv2.blur(sight.evidence, (MAY_SIDE, MAY_SIDE))
    near = cv2.dilate(
        (mean > MAY_EVIDENCE).astype(np.uint8), np.ones((EXTREMES, EXTREMES), np.uint8)
    )
    return np.flatnonzero(near)


def pixel_features(sight: Sight, at: Indices) -> F32:
    """Features (M, len(PIXEL_FEATURES)) of the pixels at these flat indices."""
    measured = np.isfinite(sight.relief)
    relief = np.where(measured, np.clip(sight.relief, LOWEST, HIGHEST), np.float32(LOWEST))
    guided, share = _guided(sight), measured.astype(np.float32)
    above = share * relief
    smooth = np.asarray(cv2.GaussianBlur(sight.bgr, (0, 0), 1), dtype=np.uint8)
    colour, sparse = (
        _lab(smooth.reshape(-1, 1, 3).take(at, axis=0))[:, 0],
        _lab(smooth[::STRIDE, ::STRIDE].copy()),
    )
    row, column = np.divmod(at, smooth.shape[1])
    cell = (row // STRIDE) * sparse.shape[1] + column // STRIDE
    kinds = guided > SURE_ORE, guided < SURE_OTHER, measured & sight.on_bar & (relief < BAR_RELIEF)
    groups: tuple[Callable[[], list[F32]], ...] = (
        lambda: [image.ravel()[at] for image in (sight.evidence, guided)],
        *(lambda side=side: _means(above, share, side, at) for side in SIDES),
        lambda: [image.ravel()[at] for image in _extremes(relief)],
        lambda: [
            *_shades(sight.grey, at),
            sight.on_bar.ravel()[at].astype(np.float32),
            sight.inside.ravel()[at],
        ],
        *(lambda kind=kind: _colours(colour, cell, _colour_near(sparse, kind)) for kind in kinds),
    )
    columns = [column for group in pool().map(lambda group: group(), groups) for column in group]
    # Each column lies in memory at a stretch, which is several times faster than row upon row.
    return np.stack(columns).T


def _stands_out(features: F32) -> Mask:
    """Where relief (M,) was measured nearly everywhere near by and all of it is high: no colour
    speaks against that.
    """
    relief, measured, wide_relief, wide_measured, lowest = (
        features[:, PIXEL_FEATURES.index(name)]
        for name in ("relief_5", "measured_5", "relief_11", "measured_11", "lowest")
    )
    high = (relief > STANDS_OUT) & (wide_relief > STANDS_OUT) & (lowest > 1)
    return np.asarray(high & (measured > NEARLY_ALL) & (wide_measured > NEARLY_ALL))


def _guided(sight: Sight) -> F32:
    """The evidence spread over even areas of the image, to their edges (He et al. 2013); at half
    the size, for time.
    """
    scale = 0.5 if min(sight.grey.shape) > GUIDE_RADIUS else 1.0
    smooth = cv2.ximgproc.guidedFilter(
        sight.grey, sight.evidence, GUIDE_RADIUS, GUIDE_VARIANCE, dDepth=cv2.CV_32F, scale=scale
    )
    return np.asarray(smooth, dtype=np.float32)


def _means(relief: F32, share: F32, side: int, at: Indices) -> list[F32]:
    """Mean relief (M,) of the measured pixels in a window, and their share; `relief` is 0 where
    none was measured.
    """
    total, measured = (
        np.asarray(cv2.blur(image, (side, side)), np.float32).ravel()[at]
        for image in (relief, share)
    )
    total /= np.maximum(measured, np.float32(1e-3))
    return [total, measured]


def _extremes(relief: F32) -> tuple[F32, F32]:
    window = np.ones((EXTREMES, EXTREMES), np.uint8)
    return np.asarray(cv2.dilate(relief, window), np.float32), np.asarray(
        cv2.erode(relief, window), np.float32
    )


def _shades(grey: U8, at: Indices) -> list[F32]:
    """Texture (M,): mean difference from the smoothed image; shading: its slope from left to right;
    as logarithms.
    """
    smooth = cv2.GaussianBlur(grey, (0, 0), 2)
    rough = cv2.blur(cv2.absdiff(grey, smooth), (EXTREMES, EXTREMES))
    slope = cv2.Sobel(smooth, cv2.CV_16S, 1, 0)
    texture, shading = (
        np.asarray(image).ravel()[at].astype(np.float32) for image in (rough, slope)
    )
    return [np.log1p(texture), np.arcsinh(shading / 8)]


def _lab(bgr: U8) -> F32:
    """CIE Lab of 8 bits (h, w, 3)."""
    if not bgr.size:
        return bgr.astype(np.float32)
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2Lab), np.uint8).astype(np.float32)


def _colour_near(colour: F32, kind: Mask) -> F32:
    """Means, precisions and share (cells, 7) of the colours (h, w, 3) of a kind around each cell of
    `STRIDE` pixels.
    """
    weight = kind[::STRIDE, ::STRIDE].astype(np.float32)
    channels = [weight * channel for channel in np.moveaxis(colour, 2, 0)]
    squares = [
        part * channel for part, channel in zip(channels, np.moveaxis(colour, 2, 0), strict=True)
    ]
    near = np.stack(
        [
            cv2.GaussianBlur(part, (0, 0), COLOUR_REACH).ravel()
            for part in (*channels, *squares, weight)
        ],
        1,
    )
    near = np.asarray(near, np.float32)
    near[:, :6] /= np.maximum(near[:, 6:], np.float32(1e-4))
    near[:, 3:6] = 1 / np.maximum(near[:, 3:6] - near[:, :3] ** 2, np.float32(COLOUR_NOISE))
    return near


def _colours(colour: F32, cell: Indices, near: F32) -> list[F32]:
    """How far (M,) colours (M, 3) are from those of a kind near by, in standard deviations, and how
    many these are.

    Both as logarithms; the distance is 0 where there are hardly any of the kind.
    """
    mine = near.take(cell, axis=0)
    off, share = colour - mine[:, :3], mine[:, 6]
    off *= off
    distance = np.einsum("ij,ij->i", off, mine[:, 3:6]) * share / (share + np.float32(FEW))
    return [np.log1p(distance), np.log(share + np.float32(FEW))]
