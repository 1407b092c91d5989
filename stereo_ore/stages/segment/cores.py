"""Cores of single lumps: the thick parts of the ore mask, told apart where the necks between them
are thin.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter

import cv2
import numpy as np
import numpy.typing as npt

from stereo_ore.types import F32, F64, I32, Mask

LEVEL_RATIO = 1.06
"""Ratio of successive levels of the tree of cores."""

I64 = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Peaks:
    """The N places that are thicker than what surrounds them, and the saddles between them.

    `rank` (N,) is the number of levels below each peak and `thickness` (N,) its thickness [px];
    `saddles` (S, 3) are the number of levels below a saddle and the two peaks that it joins, the
    highest saddle first.
    """

    rank: I64
    thickness: F32
    saddles: I64


def cores(mask: Mask, barrier: Mask, ratio: float, least: float) -> I32:
    """Label the cores of the mask's parts, 1…n.

    A tree of cores (connected sets farther than a level from the mask's border and from barriers)
    is followed from the thickest down. Where cores meet all stay if each is thicker than the neck
    by 1/ratio; otherwise the thinner ones belong to the thickest.

    Parameters
    ----------
    mask, barrier : (h, w) masks
        Ore, and where it is cut.
    ratio : float
        Neck over core thickness from which on they are one.
    least : float
        Thickness [px] under which nothing is a core.
    """
    free = cv2.copyMakeBorder((mask & ~barrier).astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT)
    thickness = np.asarray(cv2.distanceTransform(free, cv2.DIST_L2, 5), dtype=np.float32)
    top = float(thickness.max(initial=0.0))
    labels = np.zeros(free.shape, np.int32)
    if top > least:
        count = int(np.log(top / least) / np.log(LEVEL_RATIO)) + 1
        levels = np.asarray(least * LEVEL_RATIO ** np.arange(count), np.float64)
        place = np.flatnonzero(thickness > least)
        rank = np.searchsorted(levels, thickness.ravel()[place].astype(np.float64))
        peak, peaks = _find_peaks(thickness.ravel(), place, rank, free.shape[1])
        labels.ravel()[place] = _join(peaks, levels, ratio)[peak, rank]
    return labels[1:-1, 1:-1]


def _find_peaks(thickness: F32, place: I64, rank: I64, width: int) -> tuple[I64, Peaks]:
    """The peak that the way up from each place (flat index into rows of `width`) leads to, and the
    peaks.

    Peaks are numbered from the highest level down, at one level from the top of the image.
    """
    to = np.full(thickness.size, -1, np.int64)
    to[place] = np.arange(len(place))
    height, best, up = thickness[place], thickness[place], np.arange(len(place))
    for offset in (1, -1, width, -width):
        beside = thickness[place + offset]
        higher = beside > best
        np.copyto(best, beside, where=higher)
        np.copyto(up, to[place + offset], where=higher)
    up = _followed(up)
    summit = np.flatnonzero(up == np.arange(len(up)))
    up = _numbers(summit, len(up))[up]
    edges = []
    for offset in (1, width):
        other = to[place + offset]
        cut = np.flatnonzero((other >= 0) & (up != up[other]))
        edges.append(
            np.stack([np.minimum(rank[cut], rank[other[cut]]), up[cut], up[other[cut]]], 1)
        )
    tops = rank[summit]
    into, saddles = _contracted(tops, np.concatenate(edges))
    up = into[up]
    at_top = np.flatnonzero(rank == tops[up])
    peak, first = np.unique(up[at_top], return_index=True)
    number = _numbers(peak[np.lexsort((at_top[first], -tops[peak]))], len(tops))
    highest = np.zeros(len(peak), np.float32)
    np.maximum.at(highest, number[up[summit]], height[summit])
    saddles[:, 1:] = number[saddles[:, 1:]]
    return number[up], Peaks(
        -np.sort(-tops[peak]), highest, saddles[np.argsort(-saddles[:, 0], kind="stable")]
    )


def _contracted(tops: I64, edges: I64) -> tuple[I64, I64]:
    """Peaks merged that are one at the level at which the lower of them appears.

    Returns the peak that each becomes part of, and the highest saddle (rank, peak, peak) between
    each two left.
    """
    into, levels = np.arange(len(tops)), int(tops.max(initial=0)) + 1
    while len(edges):
        level, (a, b) = edges[:, 0], edges[:, 1:].T
        swap = (tops[a] > tops[b]) | ((tops[a] == tops[b]) & (a < b))
        low, high = np.where(swap, b, a), np.where(swap, a, b)
        pair, level = np.divmod(np.sort((low * len(tops) + high) * levels + level), levels)
        last = np.append(pair[1:] != pair[:-1], True)
        level, (low, high) = level[last], np.divmod(pair[last], len(tops))
        one = level == tops[low]
        edges = np.stack([level, low, high], 1)
        if not one.any():
            break
        step = np.arange(len(tops))
        step[low[one]] = high[one]
        step = _followed(step)
        into, edges[:, 1:] = step[into], step[edges[:, 1:]]
        edges = edges[edges[:, 1] != edges[:, 2]]
    return into, edges


def _numbers(members: I64, count: int) -> I64:
    """The number (count,) of each member of a list; 0 for what is none."""
    number = np.zeros(count, np.int64)
    number[members] = np.arange(len(members))
    return number


def _followed(up: I64) -> I64:
    """Where the steps `up` lead in the end."""
    while not np.array_equal(up, further := up[up]):
        up = further
    return up


def _join(peaks: Peaks, levels: F64, ratio: float) -> I32:
    """Label (N, levels + 1) of what belongs to each peak, by the number of levels below it; 0 in
    undecided necks.
    """
    count = len(peaks.rank)
    table = np.repeat(np.arange(1, count + 1, dtype=np.int32)[:, None], len(levels) + 1, 1)
    part, members = np.arange(count), {peak: [peak] for peak in range(count)}
    for rank, met in groupby(peaks.saddles.tolist(), key=itemgetter(0)):
        changed: set[int] = set()
        for _, a, b in met:
            one, other = int(part[a]), int(part[b])
            if one != other:
                part[part == other] = one
                members[one] = sorted(members[one] + members.pop(other))
                changed = changed - {other} | {one}
        for one in changed:
            mine, whole = members[one], part == one
            thickest = max(mine, key=lambda peak: peaks.thickness[peak])
            thick = [
                p for p in mine if p == thickest or peaks.thickness[p] * ratio > levels[rank - 1]
            ]
            members[one] = thick
            if thin := [p + 1 for p in mine if p not in thick]:
                table[np.isin(table, thin)] = thickest + 1
            table[whole, : rank + 1] = 0
            if len(thick) == 1:
                table[whole] = thickest + 1
    return table
