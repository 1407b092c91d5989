"""Where the ore mask is cut: the smoothed relief, its valleys and steps, and creases that are long
enough.
"""

from __future__ import annotations

import cv2
import numpy as np

from stereo_ore.types import F32, Mask

HOLES = (1.0, 3.0, 8.0)
"""Widths of the Gaussian; the first that finds enough measured pixels counts."""
FEW = 0.15
"""Share of measured pixels under a Gaussian below which a wider one is taken."""


def smooth_relief(relief: F32, mask: Mask, sigma: float) -> F32:
    """Gaussian mean of the relief over the mask's measured pixels; 0, the plane, outside the mask.

    Where hardly any pixel near by was measured the Gaussian is wider, so that a hole is no valley.
    """
    weight = (np.isfinite(relief) & mask).astype(np.float32)
    value = np.where(weight > 0, relief, 0).astype(np.float32)
    mean, bare = np.zeros_like(value), mask
    for width in HOLES:
        share = np.asarray(cv2.GaussianBlur(weight, (0, 0), width * sigma), np.float32)
        near = bare & (share > FEW)
        mean[near] = cv2.GaussianBlur(value, (0, 0), width * sigma)[near] / share[near]
        bare = bare & ~near
        if not bare.any():
            break
    return mean


def valley_depth(relief: F32, reach: int) -> F32:
    """How far [px] each pixel lies behind the deepest-lying chord of length 2·reach centred on it.

    Inside one convex body no chord passes in front of the surface, so this is not positive; it is
    at a crease between bodies and at the foot of a step. Four directions are tried.
    """
    h, w = relief.shape
    padded = cv2.copyMakeBorder(relief, reach, reach, reach, reach, cv2.BORDER_REPLICATE)
    diagonal = max(1, round(reach / np.sqrt(2)))
    depth = np.full(relief.shape, -np.inf, np.float32)
    for dx, dy in ((reach, 0), (0, reach), (diagonal, diagonal), (diagonal, -diagonal)):
        ahead = padded[reach + dy : reach + dy + h, reach + dx : reach + dx + w]
        behind = padded[reach - dy : reach - dy + h, reach - dx : reach - dx + w]
        np.maximum(depth, (ahead + behind) * np.float32(0.5), out=depth)
    return depth - relief


def long_parts(barrier: Mask, length: float) -> Mask:
    """The barrier without its connected parts shorter than `length` [px]: noise, not a crease."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(barrier.astype(np.uint8), connectivity=8)
    keep = np.maximum(stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT]) >= length
    keep[0] = False
    return np.asarray(keep[labels])
