"""Cores of single lumps: the ore mask cut along valleys and steps of the relief and at its necks."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from stereo_ore.types import F32, I32, Mask

LEVEL_RATIO = 1.06
"""Ratio of successive levels of the tree of cores."""


def smooth_relief(relief: F32, mask: Mask, sigma: float) -> F32:
    """Gaussian mean of the relief over the mask's measured pixels; 0, the plane, outside the mask."""
    weight = (np.isfinite(relief) & mask).astype(np.float32)
    value = np.where(weight > 0, relief, 0).astype(np.float32)
    mean = cv2.GaussianBlur(value, (0, 0), sigma) / np.maximum(cv2.GaussianBlur(weight, (0, 0), sigma), 1e-3)
    return np.where(mask, mean, 0).astype(np.float32)


def valley_depth(relief: F32, reach: int) -> F32:
    """How far [px] each pixel lies behind the deepest-lying chord of length 2·reach centred on it.

    Inside one convex body no chord passes in front of the surface, so this is not positive; it is at a crease between
    bodies and at the foot of a step. Four directions are tried.
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


def cores(mask: Mask, barrier: Mask, ratio: float, least: float) -> I32:
    """Label the cores of the mask's parts, 1…n.

    A tree of cores (connected sets farther than a level from the mask's border and from barriers) is followed from
    the thickest down. Where two cores meet both stay if each is thicker than the neck by 1/ratio; otherwise the
    thinner one belongs to the thicker.

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
    thickness = np.asarray(cv2.distanceTransform(free, cv2.DIST_L2, 5)[1:-1, 1:-1], dtype=np.float32)
    top = float(thickness.max(initial=0.0))
    count = int(np.log(top / least) / np.log(LEVEL_RATIO)) + 1 if top > least else 0
    found = Cores(np.zeros(mask.shape, np.int32), [0.0], [(0, 0)])
    for level in least * LEVEL_RATIO ** np.arange(count - 1, -1, -1):
        found = _descend(thickness, found, float(level), ratio)
    return found.labels


@dataclass(frozen=True)
class Cores:
    """Cores found so far: labels (h, w), and of each label its greatest thickness [px] and where that is."""

    labels: I32
    peaks: list[float]
    places: list[tuple[int, int]]


def _descend(thickness: F32, found: Cores, level: float, ratio: float) -> Cores:
    """The cores one level lower: new ones appear, known ones grow, thin ones join the thicker they meet."""
    count, found_parts, stats, _ = cv2.connectedComponentsWithStats(
        (thickness > level).astype(np.uint8), connectivity=4
    )
    parts = np.asarray(found_parts, dtype=np.int32)
    peaks, places = list(found.peaks), list(found.places)
    members: list[list[int]] = [[] for _ in range(count)]
    for label in np.unique(found.labels[tuple(np.array(places).T)]):
        if label:
            members[parts[places[label]]].append(int(label))
    into = np.arange(len(peaks), dtype=np.int32)
    fill = np.zeros(count, np.int32)
    for part in range(1, count):
        if not members[part]:
            place = _thickest(thickness, parts, part, stats[part])
            peaks.append(float(thickness[place]))
            places.append(place)
            fill[part] = len(peaks) - 1
            continue
        thickest = max(members[part], key=lambda m: peaks[m])
        thin = [m for m in members[part] if peaks[m] * ratio <= level and m != thickest]
        into[thin] = thickest
        if len(thin) == len(members[part]) - 1:
            fill[part] = thickest
    labels = np.take(fill, parts)
    np.copyto(labels, np.take(into, found.labels), where=labels == 0)
    return Cores(labels, peaks, places)


def _thickest(thickness: F32, parts: I32, part: int, stats: I32) -> tuple[int, int]:
    """Row and column of the greatest thickness in a part, given its box in OpenCV's statistics."""
    x, y, w, h = (int(value) for value in stats[:4])
    box = np.s_[y : y + h, x : x + w]
    row, column = divmod(int(np.argmax(np.where(parts[box] == part, thickness[box], 0))), w)
    return y + row, x + column


def long_parts(barrier: Mask, length: float) -> Mask:
    """The barrier without its connected parts shorter than `length` [px]: noise, not a crease."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(barrier.astype(np.uint8), connectivity=8)
    keep = np.maximum(stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT]) >= length
    keep[0] = False
    return np.asarray(keep[labels])
