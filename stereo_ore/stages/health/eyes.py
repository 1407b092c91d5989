"""Whether both eyes show the same scene, in the same rows, with light enough to be matched."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from stereo_ore.config import HealthConfig
from stereo_ore.stages.health.rows import laid_over, row_shift, smooth_rows, strip
from stereo_ore.types import F32, U8, Disparity, Reason, RectifiedPair, Registration

FINE_PX, COARSE_PX = (0.7, 1.4), (2.8, 5.6)
"""Bands of detail [standard deviations of the smoothings between which it lies]: the finest that a
lens in focus shows, and one that a blur of a few pixels leaves."""
WITH_BARS = 1.5
"""So many times the difference of neighbours is noise, and no chance, where bars were measured:
eyes that don't agree show none, whatever the light."""
_BEARABLE_SHARE, _BEARABLE_PX = 0.12, 0.6
"""What matching bears: with so few right pixels eyes of one scene still stand out from swapped ones
(0.10 at most on a chessboard, 0.14 on rooms), and up to so many pixels of row difference bad-1 of
photographs grows by 1 to 4 points."""
DETAIL_ROWS = 160
"""Rows in the middle of the region on which detail is looked at."""


def eye_doubts(
    pair: RectifiedPair,
    disparity: Disparity,
    config: HealthConfig,
    bars: Registration | None = None,
    acting: bool = True,
) -> Iterator[Reason]:
    """Why a disparity is too poor to act on.

    FEW_DISPARITIES: a covered lens, dust, no light. EYES_DISAGREE: swapped eyes, or eyes of two
    moments, match by chance only, and hardly a disparity is likely to be right; where `bars` were
    measured in one plane, noise alone makes them so. ROWS_DISAGREE: the calibration is not that of
    these images. TOO_DARK and OUT_OF_FOCUS: disparities come out smooth and wrong.

    Where no target can follow (`acting` false), eyes are held to what matching bears, not to what
    an arm needs: cameras as sold are often wrong by half a pixel of rows.
    """
    valid, region = np.isfinite(disparity.values), disparity.region
    share = valid.sum() / max((region.x1 - region.x0) * (region.y1 - region.y0), 1)
    if share < config.min_disparity_share:
        wanted = f"{100 * config.min_disparity_share:.0f} % wanted"
        yield Reason(
            "FEW_DISPARITIES",
            f"{100 * share:.0f} % of the pixels searched have a disparity; {wanted}",
        )
    right = float(np.nansum(disparity.confidence)) / max(
        disparity.diagnostics.get("textured", valid.sum()), 1
    )
    least = config.min_right_share / (1.0 if bars is None else WITH_BARS)
    if not acting:
        least = min(least, _BEARABLE_SHARE)
    if right < least:
        text = (
            f"{100 * right:.0f} % of the textured pixels are matched rightly, by their confidence"
        )
        wanted = f"{100 * least:.0f} % are wanted"
        yield Reason("EYES_DISAGREE", f"{text}, {wanted}: are the eyes swapped, or of two moments?")
    left, right = (
        np.asarray(cv2.cvtColor(eye, cv2.COLOR_BGR2GRAY), np.uint8)
        for eye in (pair.left, pair.right)
    )
    shift = row_shift(left, right, disparity, pair.rig.disparity_offset_px)
    limit, most = config.max_row_shift_rad * pair.rig.fy, config.max_local_row_shift_px
    if not acting:
        limit, most = max(limit, _BEARABLE_PX), max(most, _BEARABLE_PX)
    if shift.local > most:
        wanted = f"{most} px at most are wanted (health.max_local_row_shift_px)"
        text = (
            f"in a part of the image the rows of the eyes differ by {shift.local:.2f} px more than"
            " elsewhere"
        )
        yield Reason("PARTS_DISAGREE", f"{text}, {wanted}: is there a drop on a lens?")
    if shift.systematic > limit:
        wanted = f"{limit:.2f} px at most are wanted (health.max_row_shift_rad)"
        text = f"the rows of the eyes differ by {shift.systematic:.2f} px, {wanted}"
        yield Reason(
            "ROWS_DISAGREE", f"{text}: is the calibration that of this camera? See calibrate check"
        )
    yield from _image_doubts(left, right, disparity, pair.rig.disparity_offset_px, config)


def _image_doubts(
    left: U8, right: U8, disparity: Disparity, offset_px: float, config: HealthConfig
) -> Iterator[Reason]:
    # A ninth of the pixels tells a percentile as well.
    brightest = min(
        float(np.percentile(eye[disparity.region.slices][::3, ::3], 95)) for eye in (left, right)
    )
    if brightest < config.min_brightness:
        text = (
            f"95 % of the pixels are darker than {brightest:.0f} of 255,"
            f" {config.min_brightness:.0f} is wanted"
        )
        yield Reason("TOO_DARK", f"{text}: is there light, is the exposure right?")
    detail = fine_detail(left, right, disparity, offset_px)
    if detail < config.min_fine_detail:
        text = (
            f"detail of a pixel has {detail:.3f} of the energy of detail of four,"
            f" {config.min_fine_detail} is wanted"
        )
        yield Reason(
            "OUT_OF_FOCUS", f"{text}: is there dirt or water on a lens, is it out of focus?"
        )


def fine_detail(left: U8, right: U8, disparity: Disparity, offset_px: float) -> float:
    """Energy of the finest detail that both grey eyes show, over that of coarser detail; 1:
    unknown.

    Noise does not count: it is not the same in both eyes, so it drops out of the product of matched
    pixels.
    """
    rows, part = strip(disparity, (disparity.region.y0 + disparity.region.y1) // 2, DETAIL_ROWS)
    valid = np.isfinite(part.values[part.region.slices])
    energies = (
        _common_energy(left[rows], right[rows], part, offset_px, band)
        for band in (FINE_PX, COARSE_PX)
    )
    fine, coarse = (energy[valid] for energy in energies)
    both = float(coarse.sum())
    return float(fine.sum()) / both if both > 0 else 1.0


def _common_energy(
    left: U8, right: U8, disparity: Disparity, offset_px: float, band: tuple[float, float]
) -> F32:
    one, other = (
        smooth_rows(image, band[0]) - smooth_rows(image, band[1]) for image in (left, right)
    )
    here = disparity.region.slices
    # A correction of the calibration is in the disparity, but not in the images; what is not
    # matched does not count.
    matched = np.nan_to_num(disparity.values[here] - np.float32(offset_px))
    return one[here] * laid_over(other, matched, disparity.region.x0)
