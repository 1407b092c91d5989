"""Outlines: labels grown from their cores to the edges of image and relief, filled and numbered."""

from __future__ import annotations

import cv2
import numpy as np
from scipy import ndimage

from stereo_ore.types import F32, I32, U8, Mask


def grow(cores: I32, mask: Mask, grey: U8, relief: F32, relief_scale: float, band: int) -> I32:
    """Labels of the whole ore, flooded from the cores over the uncertain band up to edges.

    Watershed on grey level and relief together; the sure background is what is `band` pixels away
    from the mask.

    Parameters
    ----------
    cores : (h, w) int32
        Labels 1…n of sure ore.
    mask : (h, w) mask
        Ore, uncertain by about `band` pixels.
    grey : (h, w) uint8
    relief : (h, w) float32
        Smoothed relief, 0 outside the mask [px].
    relief_scale : float
        Grey levels that one pixel of disparity is worth.
    band : int
        Width of the uncertain band on either side [px].
    """
    kernel = np.ones((2 * band + 1, 2 * band + 1), np.uint8)
    inner = cv2.erode(mask.astype(np.uint8), np.ones((band | 1, band | 1), np.uint8)) > 0
    seeds = np.where(inner, cores, 0)
    lost = np.bincount(seeds.ravel(), minlength=int(cores.max(initial=0)) + 1) == 0
    seeds = np.where(lost[cores], cores, seeds)
    markers = np.where(seeds > 0, seeds + 1, 0).astype(np.int32)
    markers[cv2.dilate(mask.astype(np.uint8), kernel) == 0] = 1
    height = np.clip(relief * relief_scale, 0, 255).astype(np.uint8)
    labels = cv2.watershed(cv2.merge([cv2.GaussianBlur(grey, (0, 0), 1), height, height]), markers)
    grown = np.where(labels > 1, labels - 1, 0)
    beside = cv2.dilate(grown.astype(np.float32), np.ones((3, 3), np.uint8)).astype(np.int32)
    return np.where(labels == -1, beside, grown).astype(np.int32)


def filled(labels: I32) -> I32:
    """Each label as its largest connected part with the holes inside its outline filled, if nothing
    else lies there.
    """
    out = np.zeros_like(labels)
    for label, box in enumerate(ndimage.find_objects(labels), start=1):
        if box is None:
            continue
        mine = (labels[box] == label).astype(np.uint8)
        outlines, _ = cv2.findContours(mine, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        largest = max(outlines, key=cv2.contourArea)
        body = cv2.drawContours(np.zeros_like(mine), [largest], -1, 1, cv2.FILLED) > 0
        view = out[box]
        view[body & ((labels[box] == label) | (labels[box] == 0))] = label
    return out


def renumbered(labels: I32, keep: Mask) -> I32:
    """Kept labels as 1…n from the top of the image down, then from the left; `keep` is indexed by
    label.
    """
    boxes = ndimage.find_objects(labels, max_label=max(len(keep) - 1, 0))
    kept = [i for i in np.flatnonzero(keep) if i and boxes[i - 1] is not None]
    kept.sort(key=lambda i: tuple(side.start for side in boxes[i - 1]))
    new = np.zeros(max(len(keep), 1), np.int32)
    new[kept] = np.arange(1, len(kept) + 1)
    out = np.zeros(labels.shape, np.int32)
    inside = np.flatnonzero(labels > 0)
    out.ravel()[inside] = new[labels.ravel()[inside]]
    return out
