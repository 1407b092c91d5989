"""What is measured on the parts that ore was cut into: on pairs of neighbours, and on each part
alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy import ndimage

from stereo_ore.stages.segment.weights import PAIR_FEATURES
from stereo_ore.types import F32, F64, I32, U8, Mask

CHORDS, STATIONS = 16, 8
"""Chords drawn between two parts, and points looked at on each."""
I64 = npt.NDArray[np.int64]
GOLDEN = 0.61803398875
"""Steps of this share of a set spread over it evenly."""


@dataclass(frozen=True)
class Scene:
    """What parts are measured against, all (h, w) but the scalars.

    `relief` is smoothed, 0 outside the ore [px]; `raw` as measured, NaN where not. `valleys` (3, h,
    w) are valley depths [px] at three reaches, `edge` the strength of image edges over its mean on
    ore, `step` the slope of the relief [sigma/px], `colour` (h, w, 3) CIE Lab; `likely` is the
    probability of ore, `on_bar` where a point lies over a bar, `inside` how far from the screen's
    sides [openings, at most 1]. `opening_px` is the opening, `threshold_px` the relief that stands
    out.
    """

    relief: F32
    raw: F32
    valleys: F32
    edge: F32
    step: F32
    colour: F32
    likely: F32
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


@dataclass(frozen=True)
class Parts:
    """Parts 1…n of the ore, with what adds up when parts are joined.

    `first` (h, w) are the labels they began with and `name` (n + 1,) what each of these is called
    now. Of each label: `sums` (n + 1, 6) of the number of pixels, relief, edge and colour, `pixels`
    (ascending flat indices) and `hull` (N, 2), its corner pixels. Of neighbours: `pairs` (K, 2),
    smaller label first, and `borders` (K, 5), the length of their border and the sums of
    `_border_maps` over it.
    """

    first: I32
    name: I32
    sums: F64
    pixels: tuple[I64, ...]
    hulls: tuple[I32, ...]
    pairs: I64
    borders: F64


def measure(scene: Scene, labels: I32) -> Parts:
    """Measure parts with labels 1…n, 0 outside."""
    inside = np.flatnonzero(labels > 0)
    mine = labels.ravel()[inside].astype(np.intp)
    count = int(labels.max(initial=0)) + 1
    maps = (
        scene.relief.ravel()[inside],
        scene.edge.ravel()[inside],
        *scene.colour.reshape(-1, 3)[inside].T,
    )
    sums = np.stack([np.bincount(mine, m, count) for m in (np.ones(len(mine)), *maps)], 1)
    order = inside[np.argsort(mine.astype(np.uint16), kind="stable")]
    pixels = np.split(order, np.cumsum(sums[:-1, 0]).astype(np.intp).tolist())
    hulls = tuple(_hull(outline) for outline in _outlines(labels))
    pairs, borders = _gathered(*_touching(scene, labels), count)
    return Parts(
        labels,
        np.arange(count, dtype=np.int32),
        np.asarray(sums, np.float64),
        tuple(pixels),
        hulls,
        pairs,
        borders,
    )


def join(parts: Parts, into: I32) -> Parts:
    """The parts when each label is called `into[label]`."""
    sums = np.zeros_like(parts.sums)
    np.add.at(sums, into, parts.sums)
    pixels, hulls = list(parts.pixels), list(parts.hulls)
    for label in np.flatnonzero(into != np.arange(len(into))).tolist():
        pixels[label], hulls[label] = pixels[label][:0], hulls[label][:0]
    for label in np.flatnonzero(into != np.arange(len(into))).tolist():
        to = int(into[label])
        pixels[to] = np.sort(np.concatenate([pixels[to], parts.pixels[label]]), kind="stable")
        hulls[to] = _hull(np.concatenate([hulls[to], parts.hulls[label]]))
    ends = np.sort(into[parts.pairs], axis=1)
    apart = ends[:, 0] != ends[:, 1]
    pairs, borders = _gathered(ends[apart], parts.borders[apart], len(into))
    return Parts(parts.first, into[parts.name], sums, tuple(pixels), tuple(hulls), pairs, borders)


def pair_features(scene: Scene, parts: Parts) -> F64:
    """Features (K, len(PAIR_FEATURES)) of the neighbouring pairs of parts."""
    if not len(parts.pairs):
        return np.zeros((0, len(PAIR_FEATURES)))
    a, b = parts.pairs.T
    area = parts.sums[:, 0]
    means = parts.sums[:, 1:] / np.maximum(area, 1)[:, None]
    relief, edge, colour = means[:, 0], means[:, 1], means[:, 2:]
    length = parts.borders[:, 0]
    on_border = parts.borders[:, 1:] / length[:, None]
    small, large = np.minimum(area[a], area[b]), np.maximum(area[a], area[b])
    hull = np.array([_area(corners) for corners in parts.hulls])
    union = np.array(
        [
            _area(_hull(np.concatenate([parts.hulls[i], parts.hulls[j]])))
            for i, j in parts.pairs.tolist()
        ]
    )
    skewed = np.column_stack(
        [
            on_border,
            on_border[:, 3] / np.maximum(np.minimum(edge[a], edge[b]), 0.2),
            length / np.sqrt(small),
            np.sqrt(((colour[a] - colour[b]) ** 2).sum(1)) / 10,
            np.abs(relief[a] - relief[b])
            / np.maximum(np.maximum(relief[a], relief[b]), scene.sigma_px),
            _chord_features(scene, parts),
        ]
    )
    solidity = (area[a] + area[b]) * (
        1 / np.maximum(union, 1) - 1 / np.maximum(hull[a] + hull[b], 1)
    )
    plain = np.column_stack([np.log(large / small), np.sqrt(small) / scene.opening_px, solidity])
    return np.column_stack([np.log1p(np.maximum(skewed, 0)), plain])


def part_features(scene: Scene, labels: I32) -> F64:
    """Features (n + 1, len(PART_FEATURES)) of the parts 0…n."""
    t, count = scene.threshold_px, int(labels.max(initial=0)) + 1
    inside = np.flatnonzero(labels > 0)
    mine = labels.ravel()[inside].astype(np.intp)
    area = np.maximum(np.bincount(mine, minlength=count), 1)
    rim = np.flatnonzero(
        (cv2.erode((labels > 0).astype(np.uint8), np.ones((3, 3), np.uint8)) == 0) & (labels > 0)
    )
    on_rim = labels.ravel()[rim].astype(np.intp)
    rim_length = np.maximum(np.bincount(on_rim, minlength=count), 1)
    raw = scene.raw.ravel()[inside]
    measured = np.isfinite(raw)
    relief = np.where(measured, raw, np.float32(0)) / np.float32(t)

    def mean(values: np.ndarray) -> F64:
        return np.bincount(mine, values, count) / area

    hull = np.array([max(_area(_hull(outline)), 1.0) for outline in _outlines(labels)])
    return np.column_stack(
        [
            mean(np.clip(relief, -2, 4)),
            mean(relief > 1.5),
            np.log(area / scene.opening_px**2),
            mean(measured),
            mean(scene.on_bar.ravel()[inside]),
            area / hull,
            np.log1p(_sums(on_rim, scene.edge, rim, count) / rim_length),
            np.log1p(mean(scene.edge.ravel()[inside])),
            np.log1p(_sums(on_rim, scene.step, rim, count) / rim_length),
            mean(scene.inside.ravel()[inside]),
            mean(scene.likely.ravel()[inside]),
            np.log1p(mean(np.maximum(relief, 0)) * (t / scene.sigma_px)),
        ]
    )


def _sums(labels: npt.NDArray[np.intp], values: F32, at: I64, count: int) -> F64:
    """Sums (count,) over each label of the values at flat indices, whose labels these are."""
    return np.asarray(np.bincount(labels, values.ravel()[at], count))


def _touching(scene: Scene, labels: I32) -> tuple[I64, F64]:
    """Labels (M, 2), smaller first, on the two sides of each step between parts, and (M, 5) ones
    and border maps.

    Of the two pixels beside the step the larger value of a map counts.
    """
    pairs, maps = [], []
    for rows, columns in ((1, 0), (0, 1)):
        a, b = labels[: -rows or None, : -columns or None], labels[rows:, columns:]
        row, column = np.nonzero((a != b) & (np.minimum(a, b) > 0))
        ends = np.stack([a[row, column], b[row, column]], 1)
        pairs.append(np.sort(ends, axis=1).astype(np.int64))
        here, there = (
            _border_maps(scene, row + i, column + j) for i, j in ((0, 0), (rows, columns))
        )
        maps.append(np.maximum(here, there))
    return np.concatenate(pairs), np.concatenate(maps)


def _border_maps(scene: Scene, row: I64, column: I64) -> F64:
    """One, valleys at two reaches [sigma], the finer over its tolerance, and edges at M pixels: (M,
    5).
    """
    middle, fine = scene.valleys[1][row, column], scene.valleys[2][row, column]
    tolerance = 2 * scene.sigma_px + 0.05 * scene.relief[row, column]
    maps = (
        np.ones_like(fine),
        middle / scene.sigma_px,
        fine / scene.sigma_px,
        fine / tolerance,
        scene.edge[row, column],
    )
    return np.stack(maps, 1).astype(np.float64)


def _gathered(pairs: I64, values: F64, count: int) -> tuple[I64, F64]:
    """Different ones of the pairs (M, 2) of labels below `count`, and the sums of the values (M, F)
    over each.
    """
    key, inverse = np.unique(pairs[:, 0] * count + pairs[:, 1], return_inverse=True)
    sums = np.stack([np.bincount(inverse, column, len(key)) for column in values.T], 1)
    return np.stack(np.divmod(key, count), 1), np.asarray(sums, np.float64)


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


def _hull(points: I32) -> I32:
    """Corners (K, 2) of the convex hull of points (N, 2)."""
    return (
        np.asarray(cv2.convexHull(points), np.int32).reshape(-1, 2) if len(points) > 2 else points
    )


def _area(corners: I32) -> float:
    return float(cv2.contourArea(corners)) if len(corners) > 2 else 0.0


def _chord_features(scene: Scene, parts: Parts) -> F64:
    """Of each pair, how far chords between its parts pass in front of the surface, (K, 2).

    The mean over all chords relative to the tolerance, and the median of each chord's largest
    [sigma]. A convex body holds all its chords.
    """
    step, width = np.arange(CHORDS) * GOLDEN, parts.first.shape[1]

    def ends(labels: I64, shift: float) -> tuple[I64, I64]:
        pixels = [parts.pixels[label] for label in labels.tolist()]
        return np.divmod(
            np.stack([p[((step + shift) % 1 * len(p)).astype(np.intp)] for p in pixels]), width
        )

    (row_a, column_a), (row_b, column_b) = (
        ends(parts.pairs[:, 0], 0.0),
        ends(parts.pairs[:, 1], 0.37),
    )
    share = np.linspace(0.15, 0.85, STATIONS)

    def along(a: I64 | F32, b: I64 | F32) -> F64:
        return np.asarray(a[..., None] + (b - a)[..., None] * share, dtype=np.float64)

    row = np.rint(along(row_a, row_b)).astype(np.intp)
    column = np.rint(along(column_a, column_b)).astype(np.intp)
    at_a, at_b = scene.relief[row_a, column_a], scene.relief[row_b, column_b]
    met = parts.name[parts.first[row, column]]
    own = (met == parts.pairs[:, 0, None, None]) | (met == parts.pairs[:, 1, None, None])
    front = np.where(own, np.maximum(along(at_a, at_b) - scene.relief[row, column], 0), 0)
    tolerance = 2 * scene.sigma_px + 0.05 * np.maximum(at_a.mean(1), at_b.mean(1))
    return np.column_stack(
        [front.mean((1, 2)) / tolerance, np.median(front.max(2), axis=1) / scene.sigma_px]
    )
