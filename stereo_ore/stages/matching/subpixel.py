"""Sub-pixel disparities from the images themselves: the matcher's parabola prefers whole pixels, the images do not."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from stereo_ore.stages.matching import windows
from stereo_ore.stages.matching.sgbm import Crop
from stereo_ore.stages.matching.windows import Support
from stereo_ore.types import F32, Mask

PATCH_PX = 9
"""Window over which the images are compared."""

BEFORE_STEP_PX, AFTER_STEP_PX = 1.5, 1.0
"""Disparities are averaged before and after; these steps end a surface."""

REACH_PX = 2 * (windows.SMOOTH_PX // 2) + PATCH_PX // 2
"""How far from a pixel the refinement looks."""

MAX_SHIFT_PX = 0.5
"""The parabola is never more than half a pixel wrong on the right minimum."""

NOISE = 1.0
"""Variance of the image gradient that noise alone makes [grey levels²]: without texture the parabola stands."""


@dataclass(frozen=True)
class Refined:
    """Refined disparities [px] (anything where not valid) and |left − warped right| [grey levels], (h, w) float32."""

    values: F32
    residual: F32


def refine(images: Crop, filled: F32, around: Support, brightness: np.float32) -> Refined:
    """One Gauss-Newton step of Lucas and Kanade's (1981) registration for each pixel.

    With I_L(x) = I_R(x − d − δ) in a window, δ = −Σ g·r / Σ g², where r = I_L(x) − γ·I_R(x − d), g = ∂I_L/∂x and γ the
    ratio of the eyes' brightness. Each pixel of the window is warped by its own disparity, so a slanted surface causes
    no bias. Averaging over pixels of one surface before and after lowers the noise.

    Parameters
    ----------
    images : Crop
        Grey images.
    filled : (h, w) float32
        Disparity in the crop [px], 0 where it is not valid.
    around : Support
        Where there is a disparity.
    brightness : float
        γ, from `brightness_ratio`.
    """
    start = windows.smooth(filled, around, BEFORE_STEP_PX)
    left = images.inner.astype(np.float32)
    gradient = windows.horizontal_gradient(left)
    residual = warp(images, start)
    residual *= -brightness
    residual += left
    residual *= around.weight
    slope = windows.total(gradient * residual, PATCH_PX)
    gradient *= gradient
    gradient *= around.weight
    shift = slope / (windows.total(gradient, PATCH_PX) + np.float32(NOISE * PATCH_PX**2))
    start -= np.clip(shift, -MAX_SHIFT_PX, MAX_SHIFT_PX)
    start *= around.weight
    return Refined(windows.smooth(start, around, AFTER_STEP_PX), np.abs(residual))


def warp(images: Crop, disparity: F32) -> F32:
    """The right image as the left eye would see it, (h, w) float32 [grey levels]."""
    right = images.right.astype(np.float32)
    x, y = images.columns - disparity, _rows(disparity)
    return np.asarray(cv2.remap(right, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), np.float32)


def brightness_ratio(images: Crop, disparity: F32, valid: Mask) -> np.float32:
    """Left over right brightness of matched pixels.

    Parameters
    ----------
    images : Crop
        Grey images.
    disparity, valid : (h, w)
        Disparity in the crop [px], and where there is one.
    """
    right = cv2.remap(images.right, images.columns - disparity, _rows(disparity), cv2.INTER_NEAREST)
    seen = valid.view(np.uint8)
    left_mean, right_mean = cv2.mean(images.inner, seen)[0], cv2.mean(right, seen)[0]
    return np.float32(left_mean / right_mean if left_mean and right_mean else 1)


def _rows(image: F32) -> F32:
    """The row of each pixel, (h, w)."""
    return np.repeat(np.arange(len(image), dtype=np.float32)[:, None], image.shape[1], 1)
