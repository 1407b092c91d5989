"""From a rectified pair to disparities: match both ways, compare, drop what can't be right, say
what is doubtful.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from stereo_ore.config import MatchingConfig
from stereo_ore.stages.matching import (
    confidence,
    consistency,
    cues,
    light,
    relief,
    sgbm,
    subpixel,
    windows,
)
from stereo_ore.stages.matching.bands import in_bands
from stereo_ore.stages.matching.consistency import Agreement
from stereo_ore.stages.matching.region import default_disparities
from stereo_ore.types import F32, PIXEL_CUES, U8, Disparity, RectifiedPair, Region, Rig


def match(pair: RectifiedPair, region: Region, config: MatchingConfig) -> Disparity:
    """Disparity of the left image's pixels inside a region.

    Parameters
    ----------
    pair : RectifiedPair
        Row-aligned BGR images.
    region : Region
        Where to match, from `find_region` or `narrow`.
    config : MatchingConfig
        Parameters of the matcher.

    Returns
    -------
    Disparity
        Full-image values [px], the calibration's correction added, NaN outside the region and where
        nothing reliable was found; the probability that each is right; cues of each pixel of the
        region; what is less likely than `config.min_confidence` in `measured` alone; counts of what
        each step left.
    """
    images, compared = light.evened(sgbm.crop(grey(pair.left), grey(pair.right), region), config)
    found = consistency.match_both(images, config, compared)
    surface = relief.relief_cues(found.filled, found.valid)
    measured = _measure(images, found, surface)
    matched = found.left >= 0
    textured = matched & (found.texture >= np.float32(config.min_texture))
    sure = found.valid & (measured.confidence >= np.float32(config.min_confidence))
    values, chances, every = (
        np.full((pair.rig.height, pair.rig.width), np.nan, np.float32) for _ in range(3)
    )
    shifted = measured.values + np.float32(region.min_disparity + pair.rig.disparity_offset_px)
    np.copyto(values[region.slices], shifted, where=sure)
    np.copyto(chances[region.slices], measured.confidence, where=sure)
    np.copyto(every[region.slices], shifted, where=found.valid)
    masks = {"matched": matched, "textured": textured, "disparities": sure}
    counts = {name: int(mask.sum()) for name, mask in masks.items()}
    doubts = measured.cues | surface | {"confidence": measured.confidence * found.valid}
    return Disparity(
        values, region, chances, doubts, search_saved(pair.rig, region) | counts, every
    )


@dataclass(frozen=True)
class _Measured:
    """Refined disparities in the crop [px], the probability that they are right, cues, all (h, w)
    float32.
    """

    values: F32
    confidence: F32
    cues: dict[str, F32]


def _measure(images: sgbm.Crop, found: Agreement, surface: Mapping[str, F32]) -> _Measured:
    shape = found.left.shape
    # One block: memory for many images costs more time to get than to fill.
    values, chances, *rest = np.empty((len(PIXEL_CUES) + 2, *shape), np.float32)
    doubts = dict(zip(PIXEL_CUES, rest, strict=True))
    context = confidence.context(images, found, surface)

    def measure(rows: slice, core: slice, band: slice) -> None:
        near = [image[rows] for image in context]
        refined, seen, features = evidence(images.rows(rows), found.rows(rows), near)
        values[band] = refined[core]
        chances[band] = confidence.probability_right([feature[core] for feature in features])
        for name, cue in seen.items():
            doubts[name][band] = cue[core]

    in_bands(shape[0], cues.CUES_REACH_PX, measure)
    return _Measured(values, chances, doubts)


def evidence(
    images: sgbm.Crop, found: Agreement, context: list[F32]
) -> tuple[F32, dict[str, F32], list[F32]]:
    """Refined disparities in the crop [px], cues, and what the confidence is judged by, all (h, w)
    float32.

    Parameters
    ----------
    images : Crop
        Grey images.
    found : Agreement
        Of both directions.
    context : list
        From `confidence.context`.
    """
    around, matched, filled = windows.support(found.valid), found.matched, found.filled
    refined = subpixel.refine_disparity(images, filled, around)
    seen = cues.pixel_cues(found, matched, around, refined.residual)
    return refined.values, seen, confidence.pixel_features(seen, context, refined.residual, filled)


def grey(image: U8) -> U8:
    """Brightness of a BGR image, (H, W) uint8."""
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)


def search_saved(rig: Rig, region: Region) -> dict[str, Any]:
    """The search, and the share of that of the whole image and the default range that it saves."""
    pixels = (region.x1 - region.x0) * (region.y1 - region.y0)
    whole = rig.width * rig.height * default_disparities(rig.width)
    return {
        "pixels": pixels,
        "min_disparity": region.min_disparity,
        "num_disparities": region.num_disparities,
        "saved_share": max(1 - pixels * region.num_disparities / whole, 0.0),
    }
