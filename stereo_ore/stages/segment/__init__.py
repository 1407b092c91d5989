"""Lumps in the image: a network names them, and edges of the image draw their outlines."""

from __future__ import annotations

import numpy as np

from stereo_ore.config import SegmentConfig
from stereo_ore.stages.segment import channels, outputs, votes, whole
from stereo_ore.stages.segment.frame import inside_screen
from stereo_ore.stages.segment.model import LumpModel, load_lump_model
from stereo_ore.stages.segment.outline import drawn, filled, renumbered
from stereo_ore.types import (
    F64,
    I16,
    I32,
    Disparity,
    Grizzly,
    Mask,
    OreMap,
    Region,
    Surface,
    Volume,
)

__all__ = ["LumpModel", "load_lump_model", "segment"]

_MARGIN = 0.5
"""What the network sees around the kept points [openings]."""
FEWEST = 8.0
"""Pixels of the network's images below which nothing is a lump."""


def segment(
    disparity: Disparity,
    surface: Surface,
    screen: Grizzly,
    volume: Volume | None,
    config: SegmentConfig,
    model: LumpModel,
) -> OreMap:
    """Label every lump in the image.

    Parameters
    ----------
    disparity : Disparity
        All of it, noise too: see `channels`.
    surface : Surface
        Kept points in the image.
    screen : Grizzly
        The screen; its opening is the unit of lengths.
    volume : Volume or None
        The working volume that the surface was cropped to. Without one, what lies more than an
        opening beside the screen, or wholly beside it, is no ore.
    config : SegmentConfig
        Limits.
    model : LumpModel
        The network.

    Returns
    -------
    OreMap
        Full-image labels numbered from the top of the image; counts of what was dropped.
    """
    measured = np.isfinite(surface.xyz[..., 2])
    labels = np.zeros(measured.shape, np.int32)
    counts = dict.fromkeys(("parts", "dropped_small", "dropped_unlike"), 0)
    if not measured.any():
        return _ore_map(surface, labels, counts)
    opening = screen.opening_m or config.default_opening_m
    pixel_m = channels.pixel_m(disparity, surface, screen)
    opening_px = opening / pixel_m
    region = _around(measured, disparity.region, _MARGIN * opening_px)
    small, likely = _named(
        channels.measure_channels(disparity, surface, screen, opening, region), config, model
    )
    box = np.s_[
        region.y0 - surface.y0 : region.y1 - surface.y0,
        region.x0 - surface.x0 : region.x1 - surface.x0,
    ]
    reach = max(1, round(config.band * channels.UNIT))
    labels[box] = filled(drawn(small, surface.bgr[box], reach))
    if volume is None:
        labels = _on_the_screen(labels, inside_screen(surface, screen, opening))
    counts["parts"] = int(small.max(initial=0))
    keep, dropped = _selected(labels, measured, likely, pixel_m, config)
    return _ore_map(surface, renumbered(labels, keep), counts | dropped)


def _around(measured: Mask, matched: Region, margin_px: float) -> Region:
    """The rectangle of the image around the measured pixels of the matched one."""
    margin = int(margin_px)
    (rows, columns) = (np.flatnonzero(measured.any(axis)) for axis in (1, 0))
    h, w = measured.shape
    return Region(
        matched.x0 + max(int(columns[0]) - margin, 0),
        matched.y0 + max(int(rows[0]) - margin, 0),
        matched.x0 + min(int(columns[-1]) + 1 + margin, w),
        matched.y0 + min(int(rows[-1]) + 1 + margin, h),
        matched.min_disparity,
        matched.num_disparities,
    )


def _named(seen: channels.Channels, config: SegmentConfig, model: LumpModel) -> tuple[I32, F64]:
    """Labels 1…n (h, w) in the network's images, and how likely each of 0…n is a whole lump."""
    _, height, width = seen.x.shape
    said = outputs.read(model(seen.padded)[:, :height, :width])
    least = max(config.min_pixels * seen.scale**2 / 2, FEWEST)
    labels = votes.lumps(
        said, least, config.ore_probability, config.agreement, config.line_probability
    )
    numbered = renumbered(labels, np.arange(int(labels.max(initial=0)) + 1) > 0)
    found = whole.features(numbered, said, seen.x)
    likely = model.whole.probability(found) if model.whole else np.ones(len(found))
    return numbered, np.concatenate([[0.0], likely])


def _on_the_screen(labels: I32, inside: np.ndarray) -> I32:
    """Labels of what is not wholly beside the screen, without what is far beside it."""
    out = np.where(inside > -1, labels, 0).astype(np.int32)
    on = np.bincount(labels.ravel(), (inside > 0).ravel(), int(labels.max(initial=0)) + 1) > 0
    out[~on[out]] = 0
    return out


def _selected(
    labels: I32, measured: Mask, likely: F64, pixel_m: float, config: SegmentConfig
) -> tuple[Mask, dict[str, int]]:
    """Which labels 0…n are lumps, and how many are none for being small or unlike one."""
    count, inside = len(likely), labels > 0
    area = np.bincount(labels[inside], minlength=count)
    kept = np.bincount(labels[inside & measured], minlength=count) / np.maximum(area, 1)
    large = area >= max((config.min_size_m / pixel_m) ** 2, config.min_pixels)
    rim = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    doubtful = area < config.small_pixels
    doubtful[rim] = True
    wanted = np.where(doubtful, config.doubtful_probability, config.lump_probability)
    keep = large & (likely > wanted) & (kept > config.least_measured)
    keep[0] = large[0] = False
    return keep, {
        "dropped_small": int((~large[1:]).sum()),
        "dropped_unlike": int((large & ~keep).sum()),
    }


def _ore_map(surface: Surface, labels: I32, diagnostics: dict[str, int]) -> OreMap:
    """Labels of the crop laid into the full image, with the ids that its border cuts."""
    full: I16 = np.zeros((surface.rig.height, surface.rig.width), np.int16)
    row, column = surface.y0, surface.x0
    full[row : row + labels.shape[0], column : column + labels.shape[1]] = labels
    rim = np.concatenate([full[0], full[-1], full[:, 0], full[:, -1]])
    return OreMap(full, frozenset(int(i) for i in np.unique(rim) if i), diagnostics)
