"""Sub-pixel disparities from the images themselves: the matcher's parabola prefers whole pixels,
the images do not.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from stereo_ore.stages.matching import windows
from stereo_ore.stages.matching.sgbm import Crop
from stereo_ore.stages.matching.windows import Support
from stereo_ore.types import F32, U8

_PATCH_PX = 7
"""Window over which the images are compared."""

_STEP_PX = 2.0
"""Disparities are averaged before and after; such a step ends a surface."""

REACH_PX = 2 * (windows.SMOOTH_PX // 2) + _PATCH_PX // 2
"""How far from a pixel the refinement looks."""

MAX_SHIFT_PX = 0.25
"""The matcher's parabola is hardly ever more wrong than this on the right minimum."""

_NOISE, ROW_NOISE = 0.3, 3.0
"""Variance of the gradient along rows that noise alone makes [grey levels²]: without texture the
parabola stands. That along columns is counted as more, since rows are nearly aligned: a shift of
rows must be plain to be believed."""


@dataclass(frozen=True)
class Refined:
    """Refined disparities [px] (anything where not valid), and how unlike the eyes are there, both
    (h, w) float32.

    `residual` is the standard deviation of left − warped right over the window [grey levels].
    """

    values: F32
    residual: F32


def refine_disparity(images: Crop, filled: F32, around: Support) -> Refined:
    """One Gauss-Newton step of Lucas and Kanade's (1981) registration for each pixel, whatever the
    eyes' brightness.

    In a window I_L(x, y) = I_R(x − d − δ, y − ε) + c, with unknown shifts δ along the row and ε
    across it and unknown offset c: the last two are eliminated, since exposure, vignetting and a
    residue of rectification would else be taken for depth. Each pixel of the window is warped by
    its own disparity, so a slanted surface causes no bias. A step that does not make the windows
    more alike is not taken. Averaging over pixels of one surface before and after lowers the noise.

    Parameters
    ----------
    images : Crop
        Grey images.
    filled : (h, w) float32
        Disparity in the crop [px], 0 where it is not valid.
    around : Support
        Where there is a disparity.
    """
    start = windows.smooth(filled, around, _STEP_PX)
    count = np.maximum(windows.count_valid(around.valid, _PATCH_PX), np.float32(1))
    before = (images.inner - warp(images, start)) * around.weight
    moved = (start + _step(images.inner, before, around, count)) * around.weight
    after = (images.inner - warp(images, moved)) * around.weight
    unlike, left = _variance(before, count), _variance(after, count)
    better = np.less(left, unlike).view(np.uint8)
    values = np.asarray(cv2.copyTo(moved, better, start), np.float32)
    residual = np.sqrt(np.maximum(np.minimum(left, unlike), np.float32(0)))
    return Refined(windows.smooth(values, around, _STEP_PX), residual)


def _step(left: U8, residual: F32, around: Support, count: F32) -> F32:
    """δ of each pixel [px], from left − warped right (h, w) [grey levels], 0 where not valid."""
    gx = windows.horizontal_gradient(left) * around.weight
    gy = windows.vertical_gradient(left) * around.weight
    each = np.float32(1) / count
    r, x, y = (windows.total(image, _PATCH_PX) * each for image in (residual, gx, gy))

    def moment(one: F32, other: F32, means: F32) -> F32:
        return windows.total(one * other, _PATCH_PX) * each - means

    xr, yr, xy = moment(gx, residual, x * r), moment(gy, residual, y * r), moment(gx, gy, x * y)
    window = np.float32(_PATCH_PX**2) * each
    xx = moment(gx, gx, x * x) + np.float32(_NOISE) * window
    yy = moment(gy, gy, y * y) + np.float32(ROW_NOISE) * window
    shift = (yr * xy - xr * yy) / np.maximum(xx * yy - xy * xy, np.float32(1e-3))
    return np.asarray(np.clip(shift, -MAX_SHIFT_PX, MAX_SHIFT_PX), np.float32)


def _variance(residual: F32, count: F32) -> F32:
    """Variance over the window of a residual (h, w) that is 0 where not valid."""
    mean = windows.total(residual, _PATCH_PX) / count
    return windows.total(residual * residual, _PATCH_PX) / count - mean * mean


def warp(images: Crop, disparity: F32) -> F32:
    """The right image as the left eye would see it, but for an offset, (h, w) float32 [grey
    levels].
    """
    right = images.right.astype(np.float32)
    x, y = images.columns - disparity, _rows(disparity)
    laid = np.asarray(
        cv2.remap(right, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), np.float32
    )
    return laid if images.gain == 1 else laid * np.float32(images.gain)


def _rows(image: F32) -> F32:
    """The row of each pixel, (h, w)."""
    return np.repeat(np.arange(len(image), dtype=np.float32)[:, None], image.shape[1], 1)
