"""Means over square windows, of what is valid in them."""

from __future__ import annotations

import cv2
import numpy as np

from stereo_ore.types import F32, U8, Mask

EPSILON = np.float32(1e-6)

TEXTURE_PX = 5
"""Window of the texture."""


def mean(image: F32, window: int) -> F32:
    """Mean over a window of `window` px, (h, w)."""
    return np.asarray(cv2.boxFilter(image, cv2.CV_32F, (window, window), borderType=cv2.BORDER_REFLECT), np.float32)


def horizontal_gradient(grey: U8 | F32) -> F32:
    """Central difference along the rows [grey levels a px], (h, w)."""
    return np.asarray(cv2.Sobel(grey, cv2.CV_32F, 1, 0, ksize=1, scale=0.5), np.float32)


def texture(gradient: F32) -> F32:
    """Root mean square of the horizontal gradient in a window [grey levels a px], (h, w)."""
    return np.sqrt(mean(gradient * gradient, TEXTURE_PX))


def smooth(filled: F32, valid: Mask, window: int, step_px: float) -> F32:
    """Disparities averaged over a window where the window shows one surface; elsewhere as they are.

    Parameters
    ----------
    filled : (h, w) float32
        Disparity [px], 0 where it is not valid.
    valid : (h, w) bool
        Where there is a disparity.
    window : int
        Side of the window [px], odd.
    step_px : float
        A window whose disparities span at least this [px] shows more than one surface.
    """
    kernel = np.ones((window, window), np.uint8)
    highest = cv2.dilate(filled, kernel)
    lowest = cv2.erode(np.where(valid, filled, np.float32(np.inf)), kernel)
    average = mean(filled, window) / np.maximum(mean(valid.astype(np.float32), window), EPSILON)
    return np.where((highest - lowest < step_px) & valid, average, filled)
