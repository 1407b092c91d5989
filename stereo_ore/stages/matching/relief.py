"""How a disparity stands to the surface around it, on reduced copies: to planes in disparity space,
and to what looks alike.

A patch of wrong disparities is smooth inside; planes over wider windows show that it stands off
what is around it. Where a surface ends, brightness tells which side a pixel belongs to.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from stereo_ore.threads import pool
from stereo_ore.types import F32, RELIEF_WINDOWS_PX, U8, Mask

REDUCTIONS = {14: 2, 36: 4, 72: 8}
"""How far the image is reduced for each window: sums over some seven pixels of a copy tell as much
as over all."""

_RIDGE = 0.3
"""Added to the variances of position [px² of the copy]: where they vanish, the plane lies flat."""

_LEAST = np.float32(1e-3)
"""Added to weights before a division."""

ALIKE_PX, _HALVED = 10, 2
"""Window in which disparity is foretold from brightness, and how far the image is reduced."""

_CONTRAST = 50.0
"""Variance of brightness [grey levels²] in a window from which on it foretells disparity."""


@dataclass(frozen=True)
class Level:
    """Planes of one window, (h, w) of the reduced copy: value at the pixel, scatter around it,
    share supported.
    """

    value: F32
    scatter: F32
    support: F32


def relief_cues(values: F32, valid: Mask) -> dict[str, F32]:
    """Offset from the local plane, scatter around it, and its support, for each window.

    A plane d ≈ c + a·x + b·y is fitted by least squares to the valid disparities of a square window
    (closed form, by moments), x and y counted from its middle: the offset is d − c, the scatter the
    root mean square of the residuals, to which a slope adds what it rises inside a pixel of the
    copy.

    Parameters
    ----------
    values : (h, w) float32
        Disparities [px]; anything where not valid.
    valid : (h, w) bool

    Returns
    -------
    dict
        ``offset_N_px``, ``scatter_N_px`` and ``support_N``, each (h, w) float32, for N of
        `RELIEF_WINDOWS_PX`; the offset is 0 where not valid.
    """
    weight = valid.astype(np.float32)
    # Squares of small numbers keep their digits.
    middle = np.float32(np.median(values[valid][::16])) if valid.any() else np.float32(0)
    centred = np.where(valid, values - middle, np.float32(0))

    def cues(window: int) -> dict[str, F32]:
        level = _planes(centred, weight, REDUCTIONS[window], window)
        value, scatter, support = (
            _enlarge(x, values.shape) for x in (level.value, level.scatter, level.support)
        )
        offset = (centred - value) * weight
        return {
            f"offset_{window}_px": offset,
            f"scatter_{window}_px": scatter,
            f"support_{window}": support,
        }

    return {
        name: cue for found in pool().map(cues, RELIEF_WINDOWS_PX) for name, cue in found.items()
    }


def off_alike(values: F32, valid: Mask, grey: U8) -> F32:
    """Disparity less what brightness foretells of it in a window of `ALIKE_PX`, (h, w) float32.

    The guided filter (He, Sun & Tang 2010) over valid pixels, on a halved copy: d ≈ a·I + b in each
    window, and the mean of a and b over the windows that hold a pixel. A pixel that was given the
    disparity of a surface in front, but looks like what is behind, stands off.

    Parameters
    ----------
    values : (h, w) float32
        Disparities [px], 0 where not valid.
    valid : (h, w) bool
    grey : (h, w) uint8
        The image of the same eye.
    """
    weight = valid.astype(np.float32)
    w, d, i = (_reduce(x, _HALVED) for x in (weight, values, grey.astype(np.float32)))
    wi = w * i
    each = np.float32(1) / (_mean(w) + _LEAST)
    mean_i, mean_d = _mean(wi) * each, _mean(d) * each
    slope = _mean(d * i) * each - mean_i * mean_d
    slope /= _mean(wi * i) * each - mean_i * mean_i + np.float32(_CONTRAST)
    level = mean_d - slope * mean_i
    slope, level = (_enlarge(_mean(x * w) * each, values.shape) for x in (slope, level))
    slope *= grey
    return (values - slope - level) * weight


def _mean(image: F32) -> F32:
    side = ALIKE_PX // _HALVED | 1
    return np.asarray(cv2.blur(image, (side, side), borderType=cv2.BORDER_REFLECT), np.float32)


def _planes(centred: F32, weight: F32, reduction: int, window: int) -> Level:
    size = window // reduction | 1
    w, d, dd = (_reduce(x, reduction) for x in (weight, centred, centred * centred))
    one = np.ones(size, np.float32)
    ramp = np.arange(size, dtype=np.float32) - np.float32(size // 2)

    def moment(image: F32, x: F32, y: F32) -> F32:
        return np.asarray(
            cv2.sepFilter2D(image, cv2.CV_32F, x, y, borderType=cv2.BORDER_CONSTANT), np.float32
        )

    total = moment(w, one, one)
    each = np.float32(1) / (total + _LEAST)
    mx, my, md = (
        moment(w, ramp, one) * each,
        moment(w, one, ramp) * each,
        moment(d, one, one) * each,
    )
    xx = moment(w, ramp * ramp, one) * each - mx * mx + np.float32(_RIDGE)
    yy = moment(w, one, ramp * ramp) * each - my * my + np.float32(_RIDGE)
    xy = moment(w, ramp, ramp) * each - mx * my
    xd, yd = moment(d, ramp, one) * each - mx * md, moment(d, one, ramp) * each - my * md
    determinant = xx * yy - xy * xy
    a, b = (xd * yy - yd * xy) / determinant, (yd * xx - xd * xy) / determinant
    variance = moment(dd, one, one) * each - md * md - a * xd - b * yd
    scatter: F32 = np.sqrt(np.maximum(variance, np.float32(0)))
    return Level(md - a * mx - b * my, scatter, total * np.float32(1 / size**2))


def _reduce(image: F32, by: int) -> F32:
    height, width = max(image.shape[0] // by, 1), max(image.shape[1] // by, 1)
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.float32)


def _enlarge(image: F32, shape: tuple[int, ...]) -> F32:
    return np.asarray(cv2.resize(image, shape[::-1], interpolation=cv2.INTER_LINEAR), np.float32)
