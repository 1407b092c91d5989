"""How wide bars are, from their edges in the image: a matcher smears depth over them by some
pixels.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt
from scipy import ndimage

from stereo_ore.stages.grizzly.bars import MOST_OBLONG
from stereo_ore.types import F32, F64, Bars, Grizzly, Mask, Surface

_BINS, SMOOTHING = 240, 2.0
"""Bins of a pitch that the image is folded into, and the standard deviation [bins] that the fold is
smoothed with."""
_LEAST_OPEN = 100
"""Pixels that show what is beneath the screen, for a place to be known where bars are."""
NARROWEST, WIDEST, SHIFT = 0.4, 1.15, 0.3
"""Widths tried and shifts to either side, in widths that depth says: smeared bars are wider, never
narrower."""
CLEAR = 4.5
"""Contrast of the two edges over the root mean square of the fold: chance makes at most about four
of it."""
_AS_CLEAR, _FIRST, _BESIDE = 0.8, 0.85, 0.75
"""Contrast of bars across over that of the bars, of the one with the least pitch over that of the
clearest, and widths beside a bar from which on they are looked for."""
_PITCHES, _SEARCHED = 400, 60_000
"""Pitches tried, and pixels looked at."""
STRONGEST = 20.0
"""Grey levels a pixel beyond which an edge counts no more: one glint must not outvote a bar."""


def sharpened(surface: Surface, grizzly: Grizzly, tolerance: F32) -> Bars | None:
    """The bars with width and phase by their edges, or None where the image does not show them.

    The slope of the grey image across the bars is folded by their pitch. The two edges of a bar's
    top lie in the plane, so they fall on one place each and have opposite signs; edges of what lies
    beneath are spread by perspective.

    Parameters
    ----------
    surface : Surface
        Kept points and colours in the image.
    grizzly : Grizzly
        The screen as depth shows it.
    tolerance : (h, w) float32
        Distance from the plane within which a point may lie on it [m].
    """
    bars, seen = grizzly.bars, _seen(surface, grizzly, tolerance)
    if bars is None or seen is None:
        return None
    across, _, within = seen
    fold = _folded(_slope(surface, across)[within], (across[within] - bars.phase_m) / bars.pitch_m)
    width, middle, contrast = _strongest_pair(fold, bars.width_m / bars.pitch_m)
    if not contrast > CLEAR * float(np.sqrt(np.mean(fold**2))):
        return None
    return replace(bars, width_m=width * bars.pitch_m, phase_m=bars.phase_m + middle * bars.pitch_m)


def crossing(surface: Surface, grizzly: Grizzly, tolerance: F32) -> Bars | None:
    """Bars across those of a screen, as wide and as clear in the image, or None.

    For few pixels a bar: depth smears them until it tells nothing of the holes' ends. Slow, since
    their pitch is searched for as well; parameters are those of `sharpened`.
    """
    bars, seen = grizzly.bars, _seen(surface, grizzly, tolerance)
    if bars is None or seen is None:
        return None
    across, along, within = seen
    turns = (across - bars.phase_m) / bars.pitch_m
    between = within & (np.abs(turns - np.round(turns)) > _BESIDE * bars.width_m / bars.pitch_m)
    _, _, clear = _strongest_pair(
        _folded(_slope(surface, across)[within], turns[within]), bars.width_m / bars.pitch_m
    )
    slope, place = _slope(surface, along)[between], along[between]
    step = max(1, len(place) // _SEARCHED)
    found = []
    for pitch in bars.pitch_m * np.geomspace(1 / MOST_OBLONG, MOST_OBLONG, _PITCHES):
        fold = _folded(slope[::step], place[::step] / np.float32(pitch))
        share = bars.width_m / pitch
        _, middle, contrast = _strongest_pair(fold, share, 0.5 / share)
        if contrast > CLEAR * float(np.sqrt(np.mean(fold**2))):
            found.append((contrast, float(pitch), middle))
    best = max((contrast for contrast, *_ in found), default=0.0)
    if best < _AS_CLEAR * clear:
        return None
    # A fold by two pitches shows both bars as clearly.
    pitch, middle = next((p, m) for contrast, p, m in found if contrast > _FIRST * best)
    return Bars(bars.across, bars.direction, pitch, middle * pitch, bars.width_m)


def _seen(surface: Surface, grizzly: Grizzly, tolerance: F32) -> tuple[F32, F32, Mask] | None:
    """Where each pixel's ray meets the plane, across and along the bars, (h, w) each [m], and
    whether the screen is there and nothing on it; None where too little beneath it is seen.
    """
    if (bars := grizzly.bars) is None:
        return None
    depth = np.float32(grizzly.plane.offset) / surface.on_rays(grizzly.plane.normal)
    across, along = (surface.on_rays(way) * depth for way in (bars.across, bars.direction))
    height = grizzly.plane.height(surface.xyz)
    beneath = height < -tolerance
    if beneath.sum() < _LEAST_OPEN:
        return None
    within = _between(across, beneath) & _between(along, beneath) & ~(height > tolerance)
    return across, along, within


def _between(coordinate: F32, part: Mask) -> Mask:
    """Where a coordinate lies within the range that nearly all of a part of the image has."""
    low, high = np.percentile(coordinate[part], (2, 98))
    return np.asarray((coordinate > low) & (coordinate < high))


def _slope(surface: Surface, across: F32) -> F32:
    """Slope of the grey image in the direction in which `across` grows, (h, w) [grey levels a
    pixel].
    """
    grey = cv2.GaussianBlur(
        cv2.cvtColor(surface.bgr, cv2.COLOR_BGR2GRAY).astype(np.float32), (0, 0), 1.0
    )
    (grey_x, grey_y), (x, y) = (
        [cv2.Sobel(image, cv2.CV_32F, i, 1 - i, scale=1 / 8) for i in (1, 0)]
        for image in (grey, across)
    )
    slope = (grey_x * x + grey_y * y) / np.maximum(np.hypot(x, y), np.float32(1e-9))
    return np.asarray(np.clip(slope, -STRONGEST, STRONGEST), np.float32)


def _folded(slope: F32, position: F32) -> F64:
    """Mean slope (BINS,) at each place of a pitch; positions in pitches."""
    place = np.minimum((position % 1 * _BINS).astype(np.intp), _BINS - 1)
    count = np.maximum(np.bincount(place, minlength=_BINS), 1)
    return np.asarray(
        ndimage.gaussian_filter1d(np.bincount(place, slope, _BINS) / count, SMOOTHING, mode="wrap")
    )


def _strongest_pair(fold: F64, about: float, reach: float = SHIFT) -> tuple[float, float, float]:
    """Distance and middle [pitches], and contrast, of the strongest two opposite edges near a width
    of `about`, up to `reach` widths to either side.
    """
    steps = about * _BINS
    lengths: npt.NDArray[np.intp] = np.arange(round(NARROWEST * steps), round(WIDEST * steps) + 1)[
        :, None
    ]
    middles = np.arange(-round(reach * steps), round(reach * steps) + 1)[None, :]
    start = middles - lengths // 2
    contrast = np.abs(fold[start % _BINS] - fold[(start + lengths) % _BINS])
    row, column = np.unravel_index(int(contrast.argmax()), contrast.shape)
    length = int(lengths[row, 0])
    middle = (int(start[row, column]) + 0.5 * length + 0.5) / _BINS
    return length / _BINS, middle, float(contrast[row, column])
