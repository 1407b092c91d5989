"""Outlines: labels of the network's images drawn in the picture, along its edges; filled, numbered.

Guided upsampling (He, Sun: Fast Guided Filter, 2015): near an outline, what belongs to a lump is a
linear function of the picture's colours, fitted in the network's images and applied in the picture.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from stereo_ore.types import F32, F64, I32, U8, Mask

_EVEN = 1e-4
"""Variance of colours, of which white is 1, that is no edge yet."""
_PASSES, _STEEP = 2, 4.0
"""How often the function is fitted, the next time to what it said itself, made so much steeper."""
_LEVELS = 256
"""Shares are compared in steps of 1/_LEVELS: processors differ by less."""


@dataclass(frozen=True)
class _Guide:
    """Colours (3, h, w) around a lump in the network's images, their means (3, h, w) in windows of
    2·reach + 1, and the inverses (3, 3, h, w) of their covariances there.
    """

    colours: F32
    mean: F32
    inverse: F32
    reach: int

    @classmethod
    def of(cls, bgr: U8, reach: int) -> _Guide:
        """What a piece (h, w, 3) of the shrunk picture gives."""
        colours = np.asarray(bgr.transpose(2, 0, 1), np.float32) / np.float32(255)
        mean = _blurred(colours, reach)
        products = np.stack([_blurred(colours * colour, reach) for colour in colours])
        covariance = products.astype(np.float64) - mean[:, None] * mean
        covariance[range(3), range(3)] += _EVEN
        return cls(colours, mean, _inverse(covariance), reach)

    def factors(self, lump: Mask) -> F32:
        """Factors (4, h, w) of the three colours and 1 that make the share of a lump (h, w)."""
        factors = self._fitted(lump.astype(np.float32))
        for _ in range(_PASSES - 1):
            share = (factors[:3] * self.colours).sum(0) + factors[3] - np.float32(0.5)
            factors = self._fitted(np.clip(share * np.float32(_STEEP) + np.float32(0.5), 0, 1))
        return factors

    def _fitted(self, lump: F32) -> F32:
        share = _blurred(lump[None], self.reach)
        common = _blurred(self.colours * lump, self.reach) - self.mean * share
        slopes = (self.inverse * common).sum(1)
        return _blurred(np.concatenate([slopes, share - (slopes * self.mean).sum(0)]), self.reach)


def drawn(small: I32, bgr: U8, reach: int) -> I32:
    """Labels (h, w) of the network's images as labels (H, W) of the picture.

    Parameters
    ----------
    small : (h, w) int32
        Lumps 1…n.
    bgr : (H, W, 3) uint8
        The rectangle of the picture that the network saw.
    reach : int
        How far [px of the network's images] the picture is looked at around an outline.
    """
    (rows, columns), (height, width) = small.shape, bgr.shape[:2]
    out, best = np.zeros((height, width), np.int32), np.full((height, width), 0.5, np.float32)
    shrunk = np.asarray(cv2.resize(bgr, (columns, rows), interpolation=cv2.INTER_AREA), np.uint8)
    margin, fx, fy = 3 * reach + 1, width / columns, height / rows
    for label, box in enumerate(ndimage.find_objects(small), 1):
        if box is None:
            continue
        y0, y1 = max(box[0].start - margin, 0), min(box[0].stop + margin, rows)
        x0, x1 = max(box[1].start - margin, 0), min(box[1].stop + margin, columns)
        factors = _Guide.of(shrunk[y0:y1, x0:x1], reach).factors(small[y0:y1, x0:x1] == label)
        top, left = int(y0 * fy), int(x0 * fx)
        there = np.s_[top : int(np.ceil(y1 * fy)), left : int(np.ceil(x1 * fx))]
        to_small = np.array(
            [
                [1 / fx, 0, (left + 0.5) / fx - 0.5 - x0],
                [0, 1 / fy, (top + 0.5) / fy - 0.5 - y0],
            ]
        )
        share = _share(factors, bgr[there], to_small)
        mine = share > best[there]
        out[there][mine], best[there][mine] = label, share[mine]
    return out


def _blurred(planes: F32, reach: int) -> F32:
    window = 2 * reach + 1, 2 * reach + 1
    return np.stack([cv2.blur(plane, window, borderType=cv2.BORDER_REFLECT) for plane in planes])


def _inverse(matrix: F64) -> F32:
    """Inverses of symmetric matrices (3, 3, h, w); `linalg.inv` takes ten times as long."""
    (a, b, c), (_, d, e), (_, _, f) = matrix
    p, q, r = d * f - e * e, c * e - b * f, b * e - c * d
    s, t, u = a * f - c * c, b * c - a * e, a * d - b * b
    adjugate = np.array([[p, q, r], [q, s, t], [r, t, u]])
    return np.asarray(adjugate / (a * p + b * q + c * r), np.float32)


def _share(factors: F32, bgr: U8, to_small: F64) -> F32:
    """A lump's share of the pixels of a rectangle of the picture, by the factors there."""
    size, flags = bgr.shape[1::-1], cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    *slopes, share = (
        cv2.warpAffine(plane, to_small, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        for plane in factors
    )
    for slope, colour in zip(slopes, cv2.split(bgr), strict=True):
        share += slope * (colour / np.float32(255))
    return np.asarray(np.round(share * np.float32(_LEVELS)) / np.float32(_LEVELS), np.float32)


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
