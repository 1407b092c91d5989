"""What lies where on the rays of an image's pixels."""

from __future__ import annotations

import cv2
import numpy as np

from stereo_ore.types import F32, F64, Mask, Volume, on_rays


def contained(volume: Volume, depth: F32, x: F64, y: F64) -> Mask:
    """Which pixels (h, w), at their depths [m] on rays of slopes x (w,) and y (h,), a volume
    contains.

    A coordinate in the volume's frame is the depth times a sum of one term of the column and one of
    the row.
    """
    inside = np.ones(depth.shape, np.bool_)
    for row, low, high in zip(volume.T_box_camera, volume.min_m, volume.max_m, strict=False):
        coordinate = on_rays(row[:3], x, y)
        # A disparity of zero is infinitely far, on an axis of the volume nowhere: not inside.
        with np.errstate(invalid="ignore"):
            coordinate *= depth
        inside &= cv2.inRange(coordinate, float(low - row[3]), float(high - row[3])) > 0
    return inside
