"""Lumps in the image: what stands out of the screen, split into single lumps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy import ndimage

from stereo_ore.config import SegmentConfig
from stereo_ore.segment.cores import cores
from stereo_ore.segment.evidence import bar_margin, ore_evidence, ore_mask, threshold_px
from stereo_ore.segment.features import Scene, edges, gradient
from stereo_ore.segment.frame import find_frame
from stereo_ore.segment.merge import lump_probability, merge_parts
from stereo_ore.segment.outline import filled, grow, renumbered
from stereo_ore.segment.relief import Relief, bar_clearance, bar_coordinates, fill_occlusions, measure_relief
from stereo_ore.segment.split import long_parts, smooth_relief, valley_depth
from stereo_ore.segment.weights import Weights, load
from stereo_ore.threads import pool
from stereo_ore.types import F32, I16, I32, U8, Grizzly, Mask, OreMap, Surface, Volume

__all__ = ["Scene", "coarse_heaps", "look", "oversegment", "segment"]

REACHES = (16, 8, 4)
"""Half lengths of the chords that look for valleys, as fractions 1/n of the opening."""
NOT_BELOW = 0.2
"""Relief [thresholds] down to which a point between two bars is not below their tops."""
REACH_WEIGHTS = (1.0, 1.0, 1.3)

Box = tuple[slice, slice]


@dataclass(frozen=True)
class View:
    """The crop around the ore: what segmentation looks at, all (h, w).

    Relief with its gaps filled and as measured [px], grey and colour image, ore, where a point lies over a bar, and
    the distance from the screen's sides [openings, at most 1], the strength of image edges, and the crop's border.
    """

    filled: F32
    raw: F32
    grey: U8
    bgr: U8
    mask: Mask
    on_bar: Mask
    inside: F32
    edge: F32
    border: Mask
    relief: Relief
    threshold_px: float
    opening_px: float


def segment(
    surface: Surface, grizzly: Grizzly, volume: Volume | None, config: SegmentConfig, weights: Weights | None = None
) -> OreMap:
    """Label every lump in the image.

    Parameters
    ----------
    surface : Surface
        Kept points in the image.
    grizzly : Grizzly
        The screen; its bars, when known, tell steel from ore between bars.
    volume : Volume or None
        The working volume that the surface was cropped to. Without one, what lies more than an opening beside the
        screen, or wholly beside it, is no ore.
    config : SegmentConfig
        Thresholds.
    weights : Weights or None
        Models of pairs and parts; None for those that ship with the package.

    Returns
    -------
    OreMap
        Full-image labels numbered from the top of the image; counts of what was dropped.
    """
    if not np.isfinite(surface.xyz[..., 2]).any():
        return _ore_map(surface, np.zeros(surface.sigma_z.shape, np.int32), {"parts": 0})
    view, models = look(surface, grizzly, config, bounded=volume is not None), weights or load()
    labels = np.zeros(view.mask.shape, np.int32)
    counts, lumps_before = dict.fromkeys(("parts", "dropped_small", "dropped_unlike"), 0), 0
    heaps = [(b, heap) for b, heap in _heaps(view, config) if volume or (heap.inside[heap.mask] > 0).any()]
    found = pool().map(lambda heap: _segment_heap(heap[1], config, models), heaps)
    for (box, _), (lumps, tally) in zip(heaps, found, strict=True):
        room = (labels[box] == 0) & (lumps > 0)
        labels[box][room] = lumps[room] + lumps_before
        lumps_before += int(lumps.max(initial=0))
        counts = {key: counts[key] + tally[key] for key in counts}
    numbered = renumbered(labels, np.arange(lumps_before + 1) > 0)
    return _ore_map(surface, numbered, counts)


def look(surface: Surface, grizzly: Grizzly, config: SegmentConfig, bounded: bool = True) -> View:
    """What segmentation looks at, of the whole crop; `bounded` when a working volume has cropped it."""
    relief = measure_relief(surface, grizzly)
    threshold = threshold_px(relief, grizzly.opening_m, config)
    opening = grizzly.opening_m or config.default_opening_m
    raw, on_bar, between, inside = _place(surface, grizzly, relief, -NOT_BELOW * threshold, opening)
    px = fill_occlusions(raw)
    grey = np.asarray(cv2.cvtColor(surface.bgr, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    size = opening / relief.pixel_m
    if not bounded:
        px = np.where(inside > -1, px, np.float32(0))
    mask = ore_mask(ore_evidence(px, between, threshold), grey, config, (config.least_part * size) ** 2)
    border = np.ones(mask.shape, np.bool_)
    border[1:-1, 1:-1] = False
    return View(px, raw, grey, surface.bgr, mask, on_bar, inside, edges(grey, mask), border, relief, threshold, size)


def _place(
    surface: Surface, grizzly: Grizzly, relief: Relief, least: float, opening: float
) -> tuple[F32, Mask, Mask, F32]:
    """Where points higher than `least` [px] are on the screen.

    Returns
    -------
    tuple
        Relief with the frame set to 0, points over a bar, points well between bars, and how far points are from the
        screen's sides [openings, −1…1], all (h, w).
    """
    raw = relief.px.copy()
    on_bar, between = np.zeros(raw.shape, np.bool_), np.zeros(raw.shape, np.bool_)
    if (bars := grizzly.bars) is None:
        return raw, on_bar, between, np.ones(raw.shape, np.float32)
    high = np.flatnonzero(raw > least)
    frame = find_frame(surface, relief, grizzly, bars)
    depth = surface.xyz[..., 2].ravel()[high]
    c, s = bar_coordinates(surface, bars, depth, at=high)
    tolerance = np.maximum(3 * surface.sigma_z.ravel()[high], np.float32(0.05 * opening))
    steel = frame.covers(c, s, relief.height_m(raw.ravel()[high], depth), tolerance)
    clearance = bar_clearance(c, bars)
    raw.ravel()[high[steel]] = 0
    on_bar.ravel()[high] = clearance < 0
    between.ravel()[high] = (clearance > bar_margin(relief, grizzly)) & ~steel
    inside = np.zeros(raw.shape, np.float32)
    inside.ravel()[high] = np.clip(frame.inside(c, s) / opening, -1, 1)
    return raw, on_bar, between, inside


def band_px(view: View, config: SegmentConfig) -> int:
    """Band [px] on either side of the outline within which the image may move it."""
    return max(3, round(config.band * view.opening_px))


def _heaps(view: View, config: SegmentConfig) -> Iterator[tuple[Box, View]]:
    """Box and view of each heap: what touches, or nearly so that outlines may meet."""
    band = band_px(view, config)
    near = cv2.dilate(view.mask.astype(np.uint8), np.ones((band + 1, band + 1), np.uint8))
    heaps = np.asarray(cv2.connectedComponents(near, connectivity=4)[1], dtype=np.int32)
    margin = band + 2
    for number, (rows, columns) in enumerate(ndimage.find_objects(heaps), start=1):
        top, left = max(rows.start - margin, 0), max(columns.start - margin, 0)
        box = np.s_[top : rows.stop + margin, left : columns.stop + margin]
        fields = {
            name: getattr(view, name)[box]
            for name in ("filled", "raw", "grey", "bgr", "on_bar", "inside", "edge", "border")
        }
        yield box, replace(view, mask=view.mask[box] & (heaps[box] == number), **fields)


def coarse_heaps(view: View, config: SegmentConfig) -> Iterator[tuple[Box, View]]:
    """Box of each heap, and its view at the size at which lumps are told apart."""
    for box, heap in _heaps(view, config):
        yield box, _coarse(heap, config)


def _coarse(heap: View, config: SegmentConfig) -> View:
    return _shrunk(heap, max(1, int(heap.opening_px / config.opening_px)))


def _segment_heap(view: View, config: SegmentConfig, models: Weights) -> tuple[I32, dict[str, int]]:
    """Lumps of one heap."""
    coarse = _coarse(view, config)
    scene, parts = oversegment(coarse, config)
    merged = filled(merge_parts(scene, parts, config.merge_probability, models.pair))
    lumps, dropped = _select(scene, merged, coarse, view.relief.pixel_m, config, models)
    tally = {"parts": int(np.count_nonzero(np.bincount(parts.ravel())) - 1)} | dropped
    if coarse is view:
        return lumps, tally
    seeds = cv2.resize(lumps.astype(np.float32), view.mask.shape[::-1], interpolation=cv2.INTER_NEAREST)
    relief = smooth_relief(view.filled, view.mask, config.smooth_px)
    weight = config.relief_weight / view.relief.sigma_px
    grown = grow(seeds.astype(np.int32), view.mask, view.grey, relief, weight, band_px(view, config))
    return filled(grown), tally


def _shrunk(view: View, factor: int) -> View:
    """The view at 1/factor of its size: what parts lumps needs no more pixels than that, and noise averages out."""
    if factor == 1:
        return view
    height, width = view.mask.shape
    size = max(width // factor, 1), max(height // factor, 1)

    def mean(image: F32 | U8 | Mask) -> F32:
        return np.asarray(cv2.resize(image.astype(np.float32), size, interpolation=cv2.INTER_AREA), dtype=np.float32)

    def of_measured(values: F32) -> F32:
        valid = mean(np.isfinite(values))
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(valid > 0.5, mean(np.nan_to_num(values, nan=0.0)) / valid, np.nan).astype(np.float32)

    return replace(
        view, filled=of_measured(view.filled), raw=of_measured(view.raw), grey=mean(view.grey).astype(np.uint8),
        bgr=mean(view.bgr).astype(np.uint8), mask=mean(view.mask) > 0.5, on_bar=mean(view.on_bar) > 0.5,
        inside=mean(view.inside), edge=mean(view.edge), border=mean(view.border) > 0,
        opening_px=view.opening_px / factor,
        relief=replace(view.relief, pixel_m=view.relief.pixel_m * factor),
    )  # fmt: skip


def oversegment(view: View, config: SegmentConfig) -> tuple[Scene, I32]:
    """The ore cut into more parts than there are lumps, and what these are measured against."""
    sigma = view.relief.sigma_px
    relief = smooth_relief(view.filled, view.mask, config.smooth_px)
    valleys = np.stack([valley_depth(relief, max(2, round(view.opening_px / n))) for n in REACHES])
    tolerance = config.valley_sigmas * sigma + config.valley_share * np.maximum(relief, 0)
    strength = np.max([v / (w * tolerance) for v, w in zip(valleys, REACH_WEIGHTS, strict=True)], axis=0)
    barrier = long_parts(view.mask & (strength > 1), config.least_crease * view.opening_px)
    least = max(1.5, config.least_core * view.opening_px)
    seeds = cores(view.mask, barrier, config.neck, least)
    parts = grow(seeds, view.mask, view.grey, relief, config.relief_weight / sigma, band_px(view, config))
    colour = cv2.cvtColor(cv2.GaussianBlur(view.bgr, (0, 0), 1.5), cv2.COLOR_BGR2Lab).astype(np.float32)
    scene = Scene(
        relief, view.raw, valleys, view.edge, gradient(relief) / np.float32(sigma), colour,
        view.on_bar, view.inside, sigma, view.threshold_px, view.opening_px,
    )  # fmt: skip
    return scene, parts


def _select(
    scene: Scene, labels: I32, view: View, full_pixel_m: float, config: SegmentConfig, models: Weights
) -> tuple[I32, dict[str, int]]:
    """Lumps numbered anew, and how many parts were dropped for being small or unlike a lump."""
    area = np.bincount(labels.ravel())
    present = area > 0
    present[0] = False
    shrink = view.relief.pixel_m / full_pixel_m
    least = max((config.min_size_m / view.relief.pixel_m) ** 2, config.min_pixels / shrink**2)
    large = present & (area >= least)
    doubtful = area < config.small_pixels / shrink**2
    doubtful[labels[view.border]] = True
    wanted = np.where(doubtful, config.doubtful_probability, config.lump_probability)
    likely = large & (lump_probability(scene, labels, models.part) > wanted)
    dropped = {"dropped_small": int((present & ~large).sum()), "dropped_unlike": int((large & ~likely).sum())}
    return renumbered(labels, likely), dropped


def _ore_map(surface: Surface, labels: I32, diagnostics: dict[str, int]) -> OreMap:
    """Labels of the crop laid into the full image, with the ids that its border cuts."""
    full: I16 = np.zeros((surface.rig.height, surface.rig.width), np.int16)
    row, column = surface.y0, surface.x0
    full[row : row + labels.shape[0], column : column + labels.shape[1]] = labels
    rim = np.concatenate([full[0], full[-1], full[:, 0], full[:, -1]])
    return OreMap(full, frozenset(int(i) for i in np.unique(rim) if i), diagnostics)
