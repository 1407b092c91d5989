"""Lumps in the image: what stands out of the screen, split into single lumps."""

from __future__ import annotations

import cv2
import numpy as np

from stereo_ore.config import SegmentConfig
from stereo_ore.types import Grizzly, OreMap, Surface, Volume

__all__ = ["segment"]


def segment(surface: Surface, grizzly: Grizzly, volume: Volume | None, config: SegmentConfig) -> OreMap:
    """Label every lump in the image."""
    height = surface.xyz @ grizzly.plane.normal.astype(np.float32) - np.float32(grizzly.plane.offset)
    limit = np.maximum(3 * surface.sigma_z, 0.02)
    mask = np.nan_to_num(height, nan=-1) > np.nan_to_num(limit, nan=1)
    mask8 = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask8, connectivity=4)
    pixel = float(np.nanmedian(surface.xyz[..., 2])) / surface.rig.fx if np.isfinite(height).any() else 1.0
    big = stats[:, cv2.CC_STAT_AREA] * pixel**2 >= config.min_size_m**2
    big[0] = False
    new = np.where(big, np.cumsum(big), 0)
    full = np.zeros((surface.rig.height, surface.rig.width), np.int16)
    h, w = labels.shape
    full[surface.y0 : surface.y0 + h, surface.x0 : surface.x0 + w] = new[labels]
    return OreMap(full, frozenset(), {"dropped_small": int(count - 1 - big.sum())})
