"""Lumps by votes: pixels that agree on a middle and a size are one lump.

Each pixel votes for the middle of its lump among votes of like size, with a weight at which all
pixels of a whole lump make 1. Maxima are lumps; every pixel goes to the one that is nearest to its
vote in place and size. The contact line cuts off what it parts from a lump's main body.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
from scipy import ndimage

from stereo_ore.stages.segment.outputs import Outputs
from stereo_ore.threads import pool
from stereo_ore.types import F32, F64, I32, Mask

SIZE_RATIO, SIZE_REACH = 1.35, 0.4
"""Ratio of successive sizes that are looked at, and how far (of a logarithm) votes count there."""
BLUR, _APART = 0.12, 0.3
"""Width of a vote, and least distance of two lumps' middles, in diameters."""
LIKE = 0.5
"""Sizes that differ less (of a logarithm) are like ones."""
PLACE, _SIZE = 0.25, 0.35
"""How far (in diameters), and by how much of a logarithm, pixels miss a lump's middle and size."""
WHOLE = 0.3
"""A lump with a smaller share than this of the pixels that it should have is none."""
BACK = 12
"""Steps by which lumps grow back over contact lines and scraps."""
_NEAR = np.ones((3, 3), np.uint8)
CROSS = np.asarray(cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3)), np.uint8)

_I64 = npt.NDArray[np.int64]
_Middle = tuple[float, float, float, float]


def lumps(seen: Outputs, least: float, ore: float, mass: float, line: float) -> I32:
    """Labels (h, w) of lumps, 0 for none.

    Parameters
    ----------
    seen : Outputs
        Of the network.
    least : float
        Fewest pixels of a lump.
    ore, mass, line : float
        Limits of a pixel's probability of ore, of the share of a lump's votes that agree, and of
        the probability of a contact line that cuts.
    """
    at = np.flatnonzero(seen.ore > ore)
    labels = np.zeros(seen.ore.shape, np.int32)
    if not len(at):
        return labels
    x, y, size = (image.ravel()[at] for image in (seen.x, seen.y, seen.diameter))
    middles = _middles(x, y, size, labels.shape, mass)
    labels.ravel()[at] = _nearest(x, y, size, middles)
    whole = _uncut(labels, seen.line < line)
    return _large(_grown_back(whole, seen.ore > ore), least)


def _middles(x: F32, y: F32, size: F32, shape: tuple[int, ...], mass: float) -> F64:
    """Middles (M, 3): x, y and diameter [px] of where votes agree."""
    height, width = shape
    column = np.clip(np.rint(x), 0, width - 1).astype(np.int64)
    cell = np.clip(np.rint(y), 0, height - 1).astype(np.int64) * width + column
    level = np.log(size)

    def agreed(log_d: float) -> list[_Middle]:
        """Number of votes, x, y and diameter where most agree among those of about a size."""
        d = float(np.exp(log_d))
        like = np.flatnonzero(np.abs(level - log_d) < SIZE_REACH)
        if not len(like):
            return []
        sigma = max(1.2, BLUR * d)
        reach = max(3, int(0.2 * d)) | 1
        votes, (top, left) = _voted(cell[like], size[like], width, int(4 * sigma) + reach)
        votes = cv2.GaussianBlur(votes, (0, 0), sigma) * np.float32(2 * np.pi * sigma * sigma)
        votes = np.round(votes * 4096) / np.float32(4096)
        highest = cv2.dilate(votes, np.ones((reach, reach), np.uint8))
        rows, columns = np.nonzero((votes == highest) & (votes > mass))
        return [
            (float(votes[i, j]), float(j + left), float(i + top), d)
            for i, j in zip(rows, columns, strict=True)
        ]

    sizes = np.arange(level.min(), level.max() + np.log(SIZE_RATIO), np.log(SIZE_RATIO))
    return _apart([middle for found in pool().map(agreed, sizes) for middle in found])


def _voted(cell: _I64, size: F32, width: int, margin: int) -> tuple[F32, tuple[int, int]]:
    """Map of votes around where there are any, and its upper left corner (row, column)."""
    row, column = np.divmod(cell, width)
    top, left = int(row.min()) - margin, int(column.min()) - margin
    h, w = int(row.max()) - top + margin + 1, int(column.max()) - left + margin + 1
    weight = np.float64(1) / size.astype(np.float64) ** 2
    votes = np.bincount((row - top) * w + column - left, weight, h * w)
    return votes.reshape(h, w).astype(np.float32), (top, left)


def _apart(found: list[_Middle]) -> F64:
    """Of middles near each other the one with most votes, unless they differ much in size."""
    kept: list[tuple[float, float, float]] = []
    for _, x, y, d in sorted(found, key=lambda f: (-f[0], f[2], f[1], f[3])):
        if all(
            np.hypot(x - a, y - b)
            > _APART * (min if abs(np.log(d / other)) > LIKE else max)(d, other)
            for a, b, other in kept
        ):
            kept.append((x, y, d))
    return np.array(kept, np.float64).reshape(-1, 3)


def _nearest(x: F32, y: F32, size: F32, middles: F64) -> I32:
    """Number 1…M of the middle (M, 3) that each pixel's vote is nearest to; 0 without any.

    One after the other, middles whose pixels are far too few for their size go.
    """
    if not len(middles):
        return np.zeros(len(x), np.int32)
    a, b, d = (column.astype(np.float32) for column in middles.T)
    away = ((x[:, None] - a) ** 2 + (y[:, None] - b) ** 2) / (np.float32(PLACE) * d) ** 2
    away += (np.log(size[:, None] / d) / np.float32(_SIZE)) ** 2
    there = np.arange(len(d))
    while len(there):
        mine = away[:, there].argmin(1)
        share = np.bincount(mine, minlength=len(there)) / d[there].astype(np.float64) ** 2
        if share.min() > WHOLE:
            return np.asarray(mine + 1, np.int32)
        there = np.delete(there, int(share.argmin()))
    return np.zeros(len(x), np.int32)


def _uncut(labels: I32, free: Mask) -> I32:
    """The largest part of each label that no contact line cuts off."""
    out = np.zeros_like(labels)
    for label, box in enumerate(ndimage.find_objects(labels), 1):
        if box is None:
            continue
        mine = ((labels[box] == label) & free[box]).astype(np.uint8)
        _, parts, stats, _ = cv2.connectedComponentsWithStats(mine, connectivity=4)
        if len(stats) > 1:
            out[box][parts == 1 + stats[1:, cv2.CC_STAT_AREA].argmax()] = label
    return out


def _grown_back(labels: I32, ore: Mask) -> I32:
    """Labels grown over the ore beside them."""
    grown = labels.astype(np.float32)
    room = ore & (labels == 0)
    for _ in range(BACK):
        wider = cv2.dilate(grown, CROSS)
        new = room & (wider > 0)
        if not new.any():
            break
        grown[new] = wider[new]
        room &= ~new
    return grown.astype(np.int32)


def _large(labels: I32, least: float) -> I32:
    area = np.bincount(labels.ravel())
    out = labels.copy()
    out[area[labels] < least] = 0
    return out
