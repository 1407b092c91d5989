"""Labels of the network's images laid into the camera's."""

from __future__ import annotations

import cv2
import numpy as np
from scipy import ndimage

from stereo_ore.types import F32, I32

_MARGIN = 2
"""Pixels around a lump that its interpolated edge may reach."""


def laid(small: I32, size: tuple[int, int]) -> I32:
    """Labels (h, w) in an image of `size` (width, height): to whom most of each pixel belongs."""
    width, height = size
    rows, columns = small.shape
    out, best = np.zeros((height, width), np.int32), np.full((height, width), 0.5, np.float32)
    fx, fy = width / columns, height / rows
    for label, box in enumerate(ndimage.find_objects(small), 1):
        if box is None:
            continue
        y0, y1 = max(box[0].start - _MARGIN, 0), min(box[0].stop + _MARGIN, rows)
        x0, x1 = max(box[1].start - _MARGIN, 0), min(box[1].stop + _MARGIN, columns)
        top, left = int(np.floor(y0 * fy)), int(np.floor(x0 * fx))
        bottom, right = min(int(np.ceil(y1 * fy)), height), min(int(np.ceil(x1 * fx)), width)
        share = _scaled(small[y0:y1, x0:x1] == label, (y0, x0), (top, left, bottom, right), fx, fy)
        room = best[top:bottom, left:right]
        mine = share > room
        out[top:bottom, left:right][mine] = label
        room[mine] = share[mine]
    return out


def _scaled(
    mine: np.ndarray,
    corner: tuple[int, int],
    place: tuple[int, int, int, int],
    fx: float,
    fy: float,
) -> F32:
    """A mask's share of the pixels of a rectangle (top, left, bottom, right), interpolated."""
    top, left, bottom, right = place
    to_small = np.array(
        [
            [1 / fx, 0, (left + 0.5) / fx - 0.5 - corner[1]],
            [0, 1 / fy, (top + 0.5) / fy - 0.5 - corner[0]],
        ]
    )
    return np.asarray(
        cv2.warpAffine(
            mine.astype(np.float32),
            to_small,
            (right - left, bottom - top),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        ),
        np.float32,
    )
