"""Lumps in the image: what stands out of the screen, split into single lumps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
from scipy import ndimage

from stereo_ore.config import SegmentConfig
from stereo_ore.stages.segment.cores import cores
from stereo_ore.stages.segment.features import Scene, gradient
from stereo_ore.stages.segment.merge import lump_probability, merge_parts
from stereo_ore.stages.segment.outline import filled, grow, renumbered
from stereo_ore.stages.segment.split import long_parts, smooth_relief, valley_depth
from stereo_ore.stages.segment.view import View, look, shrunk
from stereo_ore.stages.segment.weights import Weights, load
from stereo_ore.threads import pool
from stereo_ore.types import I16, I32, Grizzly, OreMap, Surface, Volume

__all__ = ["Scene", "coarse_heaps", "look", "oversegment", "segment"]

REACHES = (16, 8, 4)
"""Half lengths of the chords that look for valleys, as fractions 1/n of the opening."""
REACH_WEIGHTS = (1.0, 1.0, 1.3)

Box = tuple[slice, slice]


def segment(
    surface: Surface,
    grizzly: Grizzly,
    volume: Volume | None,
    config: SegmentConfig,
    weights: Weights | None = None,
) -> OreMap:
    """Label every lump in the image.

    Parameters
    ----------
    surface : Surface
        Kept points in the image.
    grizzly : Grizzly
        The screen; its bars, when known, tell steel from ore between bars.
    volume : Volume or None
        The working volume that the surface was cropped to. Without one, what lies more than an
        opening beside the screen, or wholly beside it, is no ore.
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
    models = weights or load()
    view = look(surface, grizzly, config, models.pixel, bounded=volume is not None)
    labels = np.zeros(view.mask.shape, np.int32)
    counts, lumps_before = dict.fromkeys(("parts", "dropped_small", "dropped_unlike"), 0), 0
    heaps = [
        (b, heap)
        for b, heap in _heaps(view, config)
        if volume or (heap.inside[heap.mask] > 0).any()
    ]
    found = pool().map(lambda heap: _segment_heap(heap[1], config, models), heaps)
    for (box, _), (lumps, tally) in zip(heaps, found, strict=True):
        room = (labels[box] == 0) & (lumps > 0)
        labels[box][room] = lumps[room] + lumps_before
        lumps_before += int(lumps.max(initial=0))
        counts = {key: counts[key] + tally[key] for key in counts}
    numbered = renumbered(labels, np.arange(lumps_before + 1) > 0)
    return _ore_map(surface, numbered, counts)


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
            for name in (
                "filled",
                "raw",
                "grey",
                "bgr",
                "likely",
                "on_bar",
                "inside",
                "edge",
                "border",
            )
        }
        yield box, replace(view, mask=view.mask[box] & (heaps[box] == number), **fields)


def coarse_heaps(view: View, config: SegmentConfig) -> Iterator[tuple[Box, View]]:
    """Box of each heap, and its view at the size at which lumps are told apart."""
    for box, heap in _heaps(view, config):
        yield box, _coarse(heap, config)


def _coarse(heap: View, config: SegmentConfig) -> View:
    return shrunk(heap, max(1, int(heap.opening_px / config.opening_px)))


def _segment_heap(view: View, config: SegmentConfig, models: Weights) -> tuple[I32, dict[str, int]]:
    """Lumps of one heap."""
    coarse = _coarse(view, config)
    scene, parts = oversegment(coarse, config)
    merged = filled(merge_parts(scene, parts, config.merge_probability, models.pair))
    lumps, dropped = _select(scene, merged, coarse, view.relief.pixel_m, config, models)
    tally = {"parts": int(np.count_nonzero(np.bincount(parts.ravel())) - 1)} | dropped
    if coarse is view:
        return lumps, tally
    seeds = cv2.resize(
        lumps.astype(np.float32), view.mask.shape[::-1], interpolation=cv2.INTER_NEAREST
    )
    relief = smooth_relief(view.filled, view.mask, config.smooth_px)
    weight = config.relief_weight / view.relief.sigma_px
    grown = grow(
        seeds.astype(np.int32), view.mask, view.grey, relief, weight, band_px(view, config)
    )
    return filled(grown), tally


def oversegment(view: View, config: SegmentConfig) -> tuple[Scene, I32]:
    """The ore cut into more parts than there are lumps, and what these are measured against."""
    sigma = view.relief.sigma_px
    relief = smooth_relief(view.filled, view.mask, config.smooth_px)
    valleys = np.stack([valley_depth(relief, max(2, round(view.opening_px / n))) for n in REACHES])
    tolerance = config.valley_sigmas * sigma + config.valley_share * np.maximum(relief, 0)
    strength = np.max(
        [v / (w * tolerance) for v, w in zip(valleys, REACH_WEIGHTS, strict=True)], axis=0
    )
    barrier = long_parts(view.mask & (strength > 1), config.least_crease * view.opening_px)
    least = max(1.5, config.least_core * view.opening_px)
    seeds = cores(view.mask, barrier, config.neck, least)
    parts = grow(
        seeds, view.mask, view.grey, relief, config.relief_weight / sigma, band_px(view, config)
    )
    colour = cv2.cvtColor(cv2.GaussianBlur(view.bgr, (0, 0), 1.5), cv2.COLOR_BGR2Lab).astype(
        np.float32
    )
    scene = Scene(
        relief, view.raw, valleys, view.edge, gradient(relief) / np.float32(sigma), colour,
        view.likely, view.on_bar, view.inside, sigma, view.threshold_px, view.opening_px,
    )  # fmt: skip
    return scene, parts


def _select(
    scene: Scene,
    labels: I32,
    view: View,
    full_pixel_m: float,
    config: SegmentConfig,
    models: Weights,
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
    dropped = {
        "dropped_small": int((present & ~large).sum()),
        "dropped_unlike": int((large & ~likely).sum()),
    }
    return renumbered(labels, likely), dropped


def _ore_map(surface: Surface, labels: I32, diagnostics: dict[str, int]) -> OreMap:
    """Labels of the crop laid into the full image, with the ids that its border cuts."""
    full: I16 = np.zeros((surface.rig.height, surface.rig.width), np.int16)
    row, column = surface.y0, surface.x0
    full[row : row + labels.shape[0], column : column + labels.shape[1]] = labels
    rim = np.concatenate([full[0], full[-1], full[:, 0], full[:, -1]])
    return OreMap(full, frozenset(int(i) for i in np.unique(rim) if i), diagnostics)
