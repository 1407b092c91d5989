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
from stereo_ore.types import F32, F64, BarProfile, Bars, Grizzly, Mask, Surface

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
_LEAST_EDGE, _MOST = 20, 0.6
"""Pixels along an edge that tell whether a bar is there, and the share of bars that must be."""
_FLANK = 0.3
"""Slope at the end of a dark flank over that of the gleam beside it."""
_PITCHES, _SEARCHED = 400, 60_000
"""Pitches tried, and pixels looked at."""
STRONGEST = 20.0
"""Grey levels a pixel beyond which an edge counts no more: one glint must not outvote a bar."""


def sharpened(
    surface: Surface, grizzly: Grizzly, tolerance: F32, profile: BarProfile = "flat"
) -> Bars | None:
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
    profile : {"flat", "round"}
        Of the bars' tops.
    """
    bars, seen = grizzly.bars, _seen(surface, grizzly, tolerance)
    if bars is None or seen is None:
        return None
    across, _, within = seen
    fold = _folded(_slope(surface, across)[within], (across[within] - bars.phase_m) / bars.pitch_m)
    width, middle, contrast = _strongest_pair(fold, bars.width_m / bars.pitch_m)
    if not contrast > CLEAR * float(np.sqrt(np.mean(fold**2))):
        return None
    if profile == "round":
        width, middle = _silhouette(fold, width, middle)
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
    # A fold by two pitches shows both bars as clearly; one by half a pitch leaves out every second.
    for contrast, pitch, middle in found:
        turns = place / np.float32(pitch) - np.float32(middle)
        if contrast > _FIRST * best and _each_is_seen(slope, turns, bars.width_m / pitch):
            return Bars(bars.across, bars.direction, pitch, middle * pitch, bars.width_m)
    return None


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


def _silhouette(fold: F64, width: float, middle: float) -> tuple[float, float]:
    """Width and middle [pitches] of round bars whose strongest two opposite slopes are so far
    apart.

    Where these are of a gleam, dark flanks beside it end in slopes of the other sign. Bars without
    such flanks, and brighter than what is beneath, end where the slope has fallen to half.
    """
    start = round((middle - width / 2) * _BINS - 0.5)
    ends = (start, start + round(width * _BINS))
    if not fold[ends[0] % _BINS] > 0 > fold[ends[1] % _BINS]:
        return width, middle
    beside = np.arange(_BINS // 4)
    slopes = [
        -way * fold[(end + way * beside) % _BINS] for end, way in zip(ends, (-1, 1), strict=True)
    ]
    if all(slope.min() < -_FLANK * slope[0] for slope in slopes):
        off = [float(slope.argmin()) for slope in slopes]
    else:
        off = [_half(slope) for slope in slopes]
    left, right = (ends[0] + 0.5 - off[0]) / _BINS, (ends[1] + 0.5 + off[1]) / _BINS
    return right - left, (left + right) / 2


def _half(slope: F64) -> float:
    """At which place, between two of them, it has fallen to half of the first; 0 if at none."""
    after = int(np.argmax(slope < slope[0] / 2))
    if not after:
        return 0.0
    part = (slope[after - 1] - slope[0] / 2) / (slope[after - 1] - slope[after])
    return after - 1 + float(part)


def _each_is_seen(slope: F32, turns: F32, width: float) -> bool:
    """Whether most bars of a comb show their two edges, `width` [pitches] apart about each whole
    turn: of ties that lie a few pitches apart one in a few does.
    """
    number = np.round(turns).astype(np.intp)
    number -= number.min()
    off = turns - np.round(turns)
    sums = []
    for edge in (-width / 2, width / 2):
        on = np.abs(off - edge) < width / 4
        count = np.bincount(number[on], minlength=number.max() + 1)
        total = np.bincount(number[on], slope[on], number.max() + 1)
        sums.append(np.where(count >= _LEAST_EDGE, total / np.maximum(count, 1), np.nan))
    contrast = sums[0] - sums[1]
    contrast = contrast[np.isfinite(contrast)]
    if not len(contrast):
        return False
    return bool(np.mean(contrast * np.sign(contrast.sum()) > 0.5 * np.abs(contrast.mean())) > _MOST)


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
