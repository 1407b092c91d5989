"""What is measured on the parts that ore was cut into: on pairs of neighbours, and on each part alone."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from stereo_ore.segment import weights
from stereo_ore.types import F32, F64, I32, U8, Mask

CHORDS, STATIONS = 16, 8
"""Chords drawn between two parts, and points looked at on each."""
GOLDEN = 0.61803398875
"""Steps of this share of a set spread over it evenly."""


@dataclass(frozen=True)
class Scene:
    """What parts are measured against, all (h, w) but the scalars.

    `relief` is smoothed, 0 outside the ore [px]; `raw` as measured, NaN where not. `valleys` (3, h, w) are valley
    depths [px] at three reaches, `edge` the strength of image edges over its mean on ore, `step` the slope of the
    relief [sigma/px], `colour` (h, w, 3) CIE Lab; `on_bar` where a point lies over a bar, `inside` how far from the
    screen's sides [openings, at most 1]. `opening_px` is the
    opening, `threshold_px` the relief that stands out.
    """

    relief: F32
    raw: F32
    valleys: F32
    edge: F32
    step: F32
    colour: F32
    on_bar: Mask
    inside: F32
    sigma_px: float
    threshold_px: float
    opening_px: float


def edges(grey: U8, mask: Mask) -> F32:
    """Strength of image edges relative to its mean over the mask."""
    strength = gradient(np.asarray(cv2.GaussianBlur(grey, (0, 0), 1.5), dtype=np.uint8))
    return strength / np.float32(max(float(strength[mask].mean()), 1e-6) if mask.any() else 1.0)


def gradient(image: U8 | F32) -> F32:
    """Length of the Sobel gradient a pixel."""
    x = cv2.Sobel(image, cv2.CV_32F, 1, 0, scale=0.125)
    y = cv2.Sobel(image, cv2.CV_32F, 0, 1, scale=0.125)
    return np.asarray(cv2.magnitude(x, y), dtype=np.float32)


def pair_features(scene: Scene, labels: I32) -> tuple[I32, F64]:
    """Neighbouring pairs (K, 2) of parts, smaller label first, and their features (K, len(PAIR)); see `weights`."""
    tolerance = 2 * scene.sigma_px + 0.05 * scene.relief
    maps = np.stack(
        [scene.valleys[1] / scene.sigma_px, scene.valleys[2] / scene.sigma_px, scene.valleys[2] / tolerance, scene.edge]
    )
    pairs, length, means = borders(labels, maps)
    if not len(pairs):
        return pairs, np.zeros((0, len(weights.PAIR)))
    a, b = pairs.T
    area, mean_relief, mean_edge, *colour = (
        _label_means(labels, x) for x in (None, scene.relief, scene.edge, *np.moveaxis(scene.colour, -1, 0))
    )
    small, large = np.minimum(area[a], area[b]), np.maximum(area[a], area[b])
    height = np.maximum(np.maximum(mean_relief[a], mean_relief[b]), scene.sigma_px)
    hulls = _outlines(labels)
    hull = np.array([_hull_area(hulls[i]) for i in range(len(hulls))])
    union = np.array([_hull_area(np.concatenate([hulls[i], hulls[j]])) for i, j in pairs])
    skewed = np.column_stack(
        [
            means,
            means[:, 3] / np.maximum(np.minimum(mean_edge[a], mean_edge[b]), 0.2),
            length / np.sqrt(small),
            np.sqrt(sum((c[a] - c[b]) ** 2 for c in colour)) / 10,
            np.abs(mean_relief[a] - mean_relief[b]) / height,
            _chord_features(scene, labels, pairs),
        ]
    )
    solidity = (area[a] + area[b]) * (1 / np.maximum(union, 1) - 1 / np.maximum(hull[a] + hull[b], 1))
    plain = np.column_stack([np.log(large / small), np.sqrt(small) / scene.opening_px, solidity])
    return pairs, np.column_stack([np.log1p(np.maximum(skewed, 0)), plain])


def part_features(scene: Scene, labels: I32) -> F64:
    """Features (n + 1, len(PART)) of the parts 0…n; see `weights`."""
    t = scene.threshold_px
    area = np.maximum(_label_means(labels, None), 1)
    raw = np.nan_to_num(scene.raw, nan=0.0)
    rim = (labels > 0) & (cv2.erode(labels.astype(np.float32), np.ones((3, 3), np.uint8)) == 0)
    on_rim = np.where(rim, labels, 0)
    hull = np.array([max(_hull_area(outline), 1.0) for outline in _outlines(labels)])
    return np.column_stack(
        [
            _label_means(labels, np.clip(raw / t, -2, 4)),
            _label_means(labels, raw > 1.5 * t),
            np.log(area / scene.opening_px**2),
            _label_means(labels, np.isfinite(scene.raw)),
            _label_means(labels, scene.on_bar),
            area / hull,
            np.log1p(_label_means(on_rim, scene.edge, len(hull))),
            np.log1p(_label_means(labels, scene.edge)),
            np.log1p(_label_means(on_rim, scene.step, len(hull))),
            _label_means(labels, scene.inside),
        ]
    )


def _label_means(labels: I32, values: np.ndarray | None, count: int = 0) -> F64:
    """Mean of the values over each label 0…n; the number of pixels without values."""
    area = np.bincount(labels.ravel(), minlength=count)
    if values is None:
        return area.astype(np.float64)
    return np.bincount(labels.ravel(), values.ravel().astype(np.float64), count) / np.maximum(area, 1)


def borders(labels: I32, maps: F32) -> tuple[I32, F64, F64]:
    """Neighbouring pairs (K, 2) of labels > 0, the length of their border (K,), and the means of maps on it (K, F).

    Of the two pixels across the border the larger value of a map (F, h, w) counts.
    """
    found = []
    for first, second in ((np.s_[:-1, :], np.s_[1:, :]), (np.s_[:, :-1], np.s_[:, 1:])):
        a, b = labels[first], labels[second]
        meet = (a != b) & (a > 0) & (b > 0)
        value = np.maximum(maps[(slice(None), *first)][:, meet], maps[(slice(None), *second)][:, meet])
        found.append((np.minimum(a, b)[meet], np.maximum(a, b)[meet], value))
    low, high, values = (np.concatenate(parts, axis=-1) for parts in zip(*found, strict=True))
    pairs, inverse, length = np.unique(np.stack([low, high], 1), axis=0, return_inverse=True, return_counts=True)
    means = [np.bincount(inverse.reshape(-1), v, len(pairs)) / np.maximum(length, 1) for v in values]
    return pairs.astype(np.int32), length.astype(np.float64), np.stack(means, 1)


def _outlines(labels: I32) -> list[I32]:
    """Outline pixels (N, 2) of each label 0…n; empty for 0 and for absent labels."""
    none = np.zeros((0, 2), np.int32)
    out = [none]
    for label, box in enumerate(ndimage.find_objects(labels), start=1):
        if box is None:
            out.append(none)
            continue
        mine = (labels[box] == label).astype(np.uint8)
        contours, _ = cv2.findContours(mine, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        corner = np.array([box[1].start, box[0].start], np.int32)
        out.append(np.concatenate(contours).reshape(-1, 2).astype(np.int32) + corner)
    return out


def _hull_area(points: I32) -> float:
    return float(cv2.contourArea(cv2.convexHull(points))) if len(points) > 2 else 0.0


def _chord_features(scene: Scene, labels: I32, pairs: I32) -> F64:
    """Of each pair, how far chords between its parts pass in front of the surface, (K, 2).

    The mean over all chords relative to the tolerance, and the median of each chord's largest [sigma]. A convex body
    holds all its chords.
    """
    order = np.argsort(labels, axis=None, kind="stable")
    start = np.concatenate([[0], np.cumsum(np.bincount(labels.ravel()))])
    step = np.arange(CHORDS) * GOLDEN

    def spread(label: I32, shift: float) -> tuple[I32, I32]:
        count = start[label + 1] - start[label]
        flat = order[start[label][:, None] + ((step + shift) % 1 * count[:, None]).astype(np.intp)]
        return np.divmod(flat, labels.shape[1])

    (row_a, column_a), (row_b, column_b) = spread(pairs[:, 0], 0.0), spread(pairs[:, 1], 0.37)
    share = np.linspace(0.15, 0.85, STATIONS)

    def along(a: I32 | F32, b: I32 | F32) -> F64:
        return np.asarray(a[..., None] + (b - a)[..., None] * share, dtype=np.float64)

    row = np.rint(along(row_a, row_b)).astype(np.intp)
    column = np.rint(along(column_a, column_b)).astype(np.intp)
    at_a, at_b = scene.relief[row_a, column_a], scene.relief[row_b, column_b]
    met = labels[row, column]
    own = (met == pairs[:, 0, None, None]) | (met == pairs[:, 1, None, None])
    front = np.where(own, np.maximum(along(at_a, at_b) - scene.relief[row, column], 0), 0)
    tolerance = 2 * scene.sigma_px + 0.05 * np.maximum(at_a.mean(1), at_b.mean(1))
    return np.column_stack([front.mean((1, 2)) / tolerance, np.median(front.max(2), axis=1) / scene.sigma_px])
