"""What segmentation looks at: relief, image and ore in the crop around the working volume."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from stereo_ore.config import SegmentConfig
from stereo_ore.network import Network
from stereo_ore.stages.segment.evidence import bar_margin, ore_evidence, ore_mask, threshold_px
from stereo_ore.stages.segment.features import edges
from stereo_ore.stages.segment.frame import find_frame
from stereo_ore.stages.segment.pixels import Sight, ore_probability
from stereo_ore.stages.segment.relief import (
    Relief,
    bar_clearance,
    bar_coordinates,
    fill_occlusions,
    measure_relief,
)
from stereo_ore.types import F32, U8, Grizzly, Mask, Surface

NOT_BELOW = 0.2
"""Relief [thresholds] down to which a point between two bars is not below their tops."""


@dataclass(frozen=True)
class View:
    """The crop around the ore: what segmentation looks at, all (h, w).

    Relief with its gaps filled and as measured [px], grey and colour image, probability of ore,
    ore, where a point lies over a bar, and the distance from the screen's sides [openings, at most
    1], the strength of image edges, and the crop's border.
    """

    filled: F32
    raw: F32
    grey: U8
    bgr: U8
    likely: F32
    mask: Mask
    on_bar: Mask
    inside: F32
    edge: F32
    border: Mask
    relief: Relief
    threshold_px: float
    opening_px: float


@dataclass(frozen=True)
class Measured:
    """What is known before it is told which pixels are ore: see `View`."""

    sight: Sight
    filled: F32
    raw: F32
    relief: Relief
    threshold_px: float
    opening_px: float


def look(
    surface: Surface,
    grizzly: Grizzly,
    config: SegmentConfig,
    network: Network,
    bounded: bool = True,
) -> View:
    """What segmentation looks at, of the whole crop; `bounded` when a working volume has cropped
    it.
    """
    found = measure_view(surface, grizzly, config, bounded)
    grey = found.sight.grey
    likely = ore_probability(found.sight, network)
    mask = ore_mask(likely, grey, config, (config.least_part * found.opening_px) ** 2)
    border = np.ones(mask.shape, np.bool_)
    border[1:-1, 1:-1] = False
    return View(
        found.filled, found.raw, grey, surface.bgr, likely, mask, found.sight.on_bar,
        found.sight.inside,
        edges(grey, mask), border, found.relief, found.threshold_px, found.opening_px,
    )  # fmt: skip


def measure_view(
    surface: Surface, grizzly: Grizzly, config: SegmentConfig, bounded: bool
) -> Measured:
    """Relief and evidence of the whole crop; beside a screen that is not `bounded` nothing is
    evident.
    """
    relief = measure_relief(surface, grizzly)
    threshold = threshold_px(relief, grizzly.opening_m, config)
    opening = grizzly.opening_m or config.default_opening_m
    raw, on_bar, between, inside = _place(surface, grizzly, relief, -NOT_BELOW * threshold, opening)
    px = fill_occlusions(raw)
    if not bounded:
        px = np.where(inside > -1, px, np.float32(0))
    grey = np.asarray(cv2.cvtColor(surface.bgr, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    evidence = ore_evidence(px, between, threshold)
    sight = Sight(evidence, raw / np.float32(threshold), on_bar, inside, surface.bgr, grey)
    return Measured(sight, px, raw, relief, threshold, opening / relief.pixel_m)


def _place(
    surface: Surface, grizzly: Grizzly, relief: Relief, least: float, opening: float
) -> tuple[F32, Mask, Mask, F32]:
    """Where points higher than `least` [px] are on the screen.

    Returns
    -------
    tuple
        Relief with the frame set to 0, points over a bar, points well between bars, and how far
        points are from the screen's sides [openings, −1…1], all (h, w).
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


def shrunk(view: View, factor: int) -> View:
    """The view at 1/factor of its size: what parts lumps needs no more pixels than that, and noise
    averages out.
    """
    if factor == 1:
        return view
    height, width = view.mask.shape
    size = max(width // factor, 1), max(height // factor, 1)

    def mean(image: F32 | U8 | Mask) -> F32:
        return np.asarray(
            cv2.resize(image.astype(np.float32), size, interpolation=cv2.INTER_AREA),
            dtype=np.float32,
        )

    def of_measured(values: F32) -> F32:
        valid = mean(np.isfinite(values))
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(
                valid > 0.5, mean(np.nan_to_num(values, nan=0.0)) / valid, np.nan
            ).astype(np.float32)

    return replace(
        view, filled=of_measured(view.filled), raw=of_measured(view.raw),
        grey=mean(view.grey).astype(np.uint8),
        bgr=mean(view.bgr).astype(np.uint8), likely=mean(view.likely), mask=mean(view.mask) > 0.5,
        on_bar=mean(view.on_bar) > 0.5, inside=mean(view.inside), edge=mean(view.edge),
        border=mean(view.border) > 0,
        opening_px=view.opening_px / factor,
        relief=replace(view.relief, pixel_m=view.relief.pixel_m * factor),
    )  # fmt: skip
