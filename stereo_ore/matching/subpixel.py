"""Sub-pixel disparities from the images themselves: the matcher's parabola prefers whole pixels, the images do not."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from stereo_ore.matching import windows
from stereo_ore.matching.sgbm import Crop
from stereo_ore.types import F32, Mask

PATCH_PX = 9
"""Window over which the images are compared."""

BEFORE_PX, BEFORE_STEP_PX = 5, 1.5
AFTER_PX, AFTER_STEP_PX = 5, 1.0
"""Windows over which disparities of one surface are averaged before and after, and the steps that end a surface."""

REACH_PX = BEFORE_PX // 2 + PATCH_PX // 2 + AFTER_PX // 2
"""How far from a pixel the refinement looks."""

MAX_SHIFT_PX = 0.5
"""The parabola is never more than half a pixel wrong on the right minimum."""

BRIGHTNESS_STEP = 4

NOISE = 1.0
"""Variance of the image gradient that noise alone makes [grey levels²]: without texture the parabola stands."""


@dataclass(frozen=True)
class Refined:
    """Refined disparities with what the comparison of the images found, each (h, w) float32.

    values [px] (anything where not valid), residual: |left − warped right| [grey levels], gradient: the left image's
    horizontal one [grey levels a px].
    """

    values: F32
    residual: F32
    gradient: F32


def refine(images: Crop, filled: F32, valid: Mask, brightness: np.float32) -> Refined:
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
    valid : (h, w) bool
        Where there is a disparity.
    brightness : float
        γ, from `brightness_ratio`.
    """
    start = windows.smooth(filled, valid, BEFORE_PX, BEFORE_STEP_PX)
    left = images.inner.astype(np.float32)
    residual = (left - brightness * warp(images, start)) * valid
    gradient = windows.horizontal_gradient(left)
    used = gradient * valid
    slope = windows.mean(used * residual, PATCH_PX)
    energy = windows.mean(used * used, PATCH_PX)
    shift = np.clip(-slope / (energy + np.float32(NOISE)), -MAX_SHIFT_PX, MAX_SHIFT_PX)
    refined = windows.smooth((start + shift) * valid, valid, AFTER_PX, AFTER_STEP_PX)
    return Refined(refined, np.abs(residual), gradient)


def warp(images: Crop, disparity: F32) -> F32:
    """The right image as the left eye would see it, (h, w) float32 [grey levels]."""
    x = images.columns - disparity
    y = np.repeat(np.arange(len(x), dtype=np.float32)[:, None], x.shape[1], 1)
    right = images.right.astype(np.float32)
    return np.asarray(cv2.remap(right, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), np.float32)


def brightness_ratio(images: Crop, disparity: F32, valid: Mask) -> np.float32:
    """Left over right brightness of matched pixels, of every `BRIGHTNESS_STEP`-th row."""
    every = slice(None, None, BRIGHTNESS_STEP)
    seen = valid[every]
    columns = np.rint(images.columns - disparity[every]).astype(np.intp)
    right = np.take_along_axis(images.right[every], np.clip(columns, 0, images.right.shape[1] - 1), 1)
    left = int(images.inner[every][seen].sum(dtype=np.int64))
    return np.float32(max(left, 1) / max(int(right[seen].sum(dtype=np.int64)), 1))
