"""Outlines: labels moved to the edges of the image, filled and numbered."""

from __future__ import annotations

import cv2
import numpy as np
from scipy import ndimage

from stereo_ore.types import I32, U8, Mask

RIM = 3
"""Pixels that are looked at around what may be ore."""


def sharpened_picture(labels: I32, bgr: U8, band: int) -> I32:
    """Labels whose outlines moved to edges of the image, by `band` pixels at most.

    Watershed from what is farther than the band inside a label or outside all of them. Adding the
    relief made outlines worse: the matching window smears its steps.

    Parameters
    ----------
    labels : (h, w) int32
        Lumps 1…n.
    bgr : (h, w, 3) uint8
    band : int
        How uncertain outlines are [px].
    """
    out = np.zeros_like(labels)
    smooth = np.asarray(cv2.GaussianBlur(bgr, (0, 0), 1), np.uint8)
    near = np.ones((2 * band + 1, 2 * band + 1), np.uint8)
    wide = cv2.dilate((labels > 0).astype(np.uint8), near)
    _, heaps, stats, _ = cv2.connectedComponentsWithStats(wide, connectivity=4)
    for heap, (x, y, w, h, _) in enumerate(stats.tolist()):
        if heap == 0:
            continue
        # The watershed takes no notice of markers on the rim.
        box = np.s_[max(y - RIM, 0) : y + h + RIM, max(x - RIM, 0) : x + w + RIM]
        mine = np.where(heaps[box] == heap, labels[box], 0).astype(np.int32)
        moved = _flooded(mine, smooth[box], wide[box] > 0, near)
        room = (moved > 0) & (heaps[box] == heap)
        out[box][room] = moved[room]
    return out


def _flooded(labels: I32, bgr: U8, wide: Mask, near: U8) -> I32:
    """Watershed of one heap; what is not `wide` is no lump."""
    values = labels.astype(np.float32)
    inner = (cv2.erode(values, near) == values) & (cv2.dilate(values, near) == values)
    seeds = np.where(inner, labels, 0)
    lost = np.bincount(seeds.ravel(), minlength=int(labels.max(initial=0)) + 1) == 0
    seeds = np.where(lost[labels], labels, seeds)
    markers = np.where(seeds > 0, seeds + 1, 0).astype(np.int32)
    markers[~wide] = 1
    flooded = cv2.watershed(np.ascontiguousarray(bgr), markers)
    grown = np.where(flooded > 1, flooded - 1, 0)
    beside = cv2.dilate(grown.astype(np.float32), np.ones((3, 3), np.uint8)).astype(np.int32)
    return np.where(flooded == -1, beside, grown).astype(np.int32)


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
