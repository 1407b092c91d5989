"""Sums over square windows, of what is valid in them."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from stereo_ore.types import F32, U8, Mask

TEXTURE_PX = 5
"""Window of the texture."""

SMOOTH_PX = 5
"""Window over which disparities of one surface are averaged."""

FAR = np.float32(2**15)
"""Above all disparities [px]."""


@dataclass(frozen=True)
class Support:
    """Which pixels (h, w) have a disparity: as float32 0 or 1, and how many of those around each
    have one, at least 1.

    `count_valid` is over a window of `SMOOTH_PX`.
    """

    valid: Mask
    weight: F32
    count: F32


def support(valid: Mask) -> Support:
    """What the windows need to know of a mask (h, w)."""
    around = count_valid(valid, SMOOTH_PX)
    return Support(valid, valid.astype(np.float32), np.maximum(around, np.float32(1)))


def count_valid(valid: Mask, window: int) -> F32:
    """True pixels of a window of `window` px, (h, w) float32."""
    return _box(valid.view(np.uint8), window)


def total(image: F32, window: int) -> F32:
    """Sum over a window of `window` px, (h, w) float32."""
    return _box(image, window)


def _box(image: U8 | F32, window: int) -> F32:
    size, border = (window, window), cv2.BORDER_REFLECT
    return np.asarray(
        cv2.boxFilter(image, cv2.CV_32F, size, normalize=False, borderType=border), np.float32
    )


def horizontal_gradient(grey: U8 | F32) -> F32:
    """Central difference along the rows [grey levels a px], (h, w)."""
    return np.asarray(cv2.Sobel(grey, cv2.CV_32F, 1, 0, ksize=1, scale=0.5), np.float32)


def vertical_gradient(grey: U8 | F32) -> F32:
    """Central difference along the columns [grey levels a px], (h, w)."""
    return np.asarray(cv2.Sobel(grey, cv2.CV_32F, 0, 1, ksize=1, scale=0.5), np.float32)


def texture(grey: U8) -> F32:
    """Root mean square of the horizontal gradient in a window [grey levels a px], (h, w)."""
    gradient = horizontal_gradient(grey)
    return np.sqrt(total(gradient * gradient, TEXTURE_PX)) * np.float32(1 / TEXTURE_PX)


def smooth(filled: F32, around: Support, step_px: float) -> F32:
    """Disparities averaged over a window where the window shows one surface; elsewhere as they are.

    Parameters
    ----------
    filled : (h, w) float32
        Disparity [px], 0 where it is not valid.
    around : Support
        Where there is a disparity.
    step_px : float
        A window whose disparities span at least this [px] shows more than one surface.
    """
    kernel = np.ones((SMOOTH_PX, SMOOTH_PX), np.uint8)
    lowest = cv2.erode(filled + FAR * (np.float32(1) - around.weight), kernel)
    span = cv2.subtract(cv2.dilate(filled, kernel), lowest)
    average = total(filled, SMOOTH_PX) / around.count
    one = np.less(span, step_px) & around.valid
    return np.asarray(cv2.copyTo(average, one.view(np.uint8), filled.copy()), np.float32)
