"""Whether both eyes show the same scene, in the same rows, with light enough to be matched."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np

from stereo_ore.config import HealthConfig
from stereo_ore.types import F32, F64, U8, Disparity, Mask, Reason, RectifiedPair

SMOOTHING_PX, WINDOW_PX, STEP_PX = 1.5, 15, 8
"""Images are smoothed by this much; a row shift is fitted in windows of this side, one each so many pixels."""
LEAST_GRADIENT = 1.0
"""Mean square of the vertical gradient [grey levels² a px²] below which a window tells nothing of rows."""
FINE_PX, COARSE_PX = (0.7, 1.4), (2.8, 5.6)
"""Bands of detail [standard deviations of the smoothings between which it lies]: the finest that a lens in focus
shows, and one that a blur of a few pixels leaves."""
DETAIL_ROWS = 160
"""Rows in the middle of the region on which detail is looked at."""
CELLS, STRIP_ROWS = (3, 4), 96
CELL_WINDOWS = 30
"""Shifts are gathered in so many cells, a row of them a strip of the image; one with fewer windows is left out."""


def doubts(pair: RectifiedPair, disparity: Disparity, config: HealthConfig) -> Iterator[Reason]:
    """Why a disparity is too poor to act on.

    FEW_DISPARITIES: a covered lens, dust, no light. EYES_DISAGREE: swapped eyes, or eyes of two moments, match by
    chance only, and neighbours differ. ROWS_DISAGREE: the calibration is not that of these images. TOO_DARK and
    OUT_OF_FOCUS: disparities come out smooth and wrong.
    """
    # A ninth of the pixels tells a median or a percentile as well.
    valid, region, every = np.isfinite(disparity.values), disparity.region, np.s_[::3, ::3]
    share = valid.sum() / max((region.x1 - region.x0) * (region.y1 - region.y0), 1)
    if share < config.min_disparity_share:
        wanted = f"{100 * config.min_disparity_share:.0f} % wanted"
        yield Reason("FEW_DISPARITIES", f"{100 * share:.0f} % of the pixels searched have a disparity; {wanted}")
    spreads = disparity.cues["spread_px"][every][valid[region.slices][every]]
    spread = float(np.median(spreads)) if len(spreads) else 0.0
    if spread > config.max_spread_px:
        text = f"neighbouring disparities differ by {spread:.2f} px, {config.max_spread_px} px at most are wanted"
        yield Reason("EYES_DISAGREE", f"{text}: are the eyes swapped, or of two moments?")
    left, right = (np.asarray(cv2.cvtColor(eye, cv2.COLOR_BGR2GRAY), np.uint8) for eye in (pair.left, pair.right))
    shift = row_shift(left, right, disparity, pair.rig.disparity_offset_px)
    if shift > config.max_row_shift_px:
        text = f"the rows of the eyes differ by {shift:.2f} px, {config.max_row_shift_px} px at most are wanted"
        yield Reason("ROWS_DISAGREE", f"{text}: is the calibration that of this camera? See calibrate check")
    yield from _image_doubts(left, right, disparity, pair.rig.disparity_offset_px, config)


def _image_doubts(
    left: U8, right: U8, disparity: Disparity, offset_px: float, config: HealthConfig
) -> Iterator[Reason]:
    brightest = min(float(np.percentile(eye[disparity.region.slices][::3, ::3], 95)) for eye in (left, right))
    if brightest < config.min_brightness:
        text = f"95 % of the pixels are darker than {brightest:.0f} of 255, {config.min_brightness:.0f} is wanted"
        yield Reason("TOO_DARK", f"{text}: is there light, is the exposure right?")
    detail = fine_detail(left, right, disparity, offset_px)
    if detail < config.min_fine_detail:
        text = f"detail of a pixel has {detail:.3f} of the energy of detail of four, {config.min_fine_detail} is wanted"
        yield Reason("OUT_OF_FOCUS", f"{text}: is there dirt or water on a lens, is it out of focus?")


def row_shift(left: U8, right: U8, disparity: Disparity, offset_px: float) -> float:
    """Root mean square over the image of the row difference [px] that is left between matched pixels; 0: unknown.

    The right image is laid over the left by the disparity; what differs then, over the vertical gradient, is a row
    shift (Lucas & Kanade 1981, one unknown). Disparities give way to a shift where edges slant, so about a third
    of a shift of up to 2 px is seen; more spoils the matching itself. Some strips of rows tell it as well as all.
    """
    region = disparity.region
    step = (region.y1 - region.y0) / CELLS[0]
    medians = []
    for strip in range(CELLS[0]):
        rows, part = _strip(disparity, round(region.y0 + (strip + 0.5) * step), min(round(step), STRIP_ROWS))
        one, other = (_smooth(image[rows], SMOOTHING_PX) for image in (left, right))
        medians.append(_cell_medians(*_window_shifts(one, other, part, offset_px)))
    shifts = np.concatenate(medians)
    return float(np.sqrt(np.mean(shifts**2))) if len(shifts) else 0.0


def _strip(disparity: Disparity, middle: int, height: int) -> tuple[slice, Disparity]:
    """Rows about a middle one, as far as they lie in the region, and the disparity in them."""
    region = disparity.region
    top = max(middle - height // 2, region.y0)
    rows = slice(top, min(top + height, region.y1))
    return rows, Disparity(disparity.values[rows], replace(region, y0=0, y1=rows.stop - rows.start))


def fine_detail(left: U8, right: U8, disparity: Disparity, offset_px: float) -> float:
    """Energy of the finest detail that both grey eyes show, over that of coarser detail; 1: unknown.

    Noise does not count: it is not the same in both eyes, so it drops out of the product of matched pixels.
    """
    rows, part = _strip(disparity, (disparity.region.y0 + disparity.region.y1) // 2, DETAIL_ROWS)
    valid = np.isfinite(part.values[part.region.slices])
    energies = (_common_energy(left[rows], right[rows], part, offset_px, band) for band in (FINE_PX, COARSE_PX))
    fine, coarse = (energy[valid] for energy in energies)
    both = float(coarse.sum())
    return float(fine.sum()) / both if both > 0 else 1.0


def _common_energy(left: U8, right: U8, disparity: Disparity, offset_px: float, band: tuple[float, float]) -> F32:
    one, other = (_smooth(image, band[0]) - _smooth(image, band[1]) for image in (left, right))
    return one[disparity.region.slices] * _laid_over(other, disparity, offset_px)


def _smooth(image: U8, sigma_px: float) -> F32:
    return np.asarray(cv2.GaussianBlur(image.astype(np.float32), (0, 0), sigma_px), np.float32)


def _laid_over(right: F32, disparity: Disparity, offset_px: float) -> F32:
    """The right image as the left eye would see it, in the matched rectangle; as it is where nothing matched."""
    rows, columns = disparity.region.slices
    v, u = np.mgrid[rows, columns].astype(np.float32)
    # A correction of the calibration is in the disparity, but not in the images.
    there = u - np.nan_to_num(disparity.values[rows, columns] - np.float32(offset_px))
    return np.asarray(cv2.remap(right, there, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)


def _window_shifts(left: F32, right: F32, disparity: Disparity, offset_px: float) -> tuple[F32, Mask]:
    """Row shift [px] of each window, and where it is known."""
    rows, columns = disparity.region.slices
    valid = np.isfinite(disparity.values[rows, columns])
    laid = _laid_over(right, disparity, offset_px)
    weight = valid.astype(np.float32)
    share = _mean(weight)
    gradient = np.asarray(cv2.Sobel(laid, -1, 0, 1, scale=1 / 8), np.float32)
    difference = left[rows, columns] - laid
    difference -= _mean(difference * weight) / np.maximum(share, np.float32(1e-6))
    energy = _mean(gradient**2 * weight)
    shift = _mean(gradient * difference * weight) / np.maximum(energy, np.float32(1e-6))
    sure = valid & (energy > LEAST_GRADIENT) & (share > 0.5)
    return np.asarray(shift[::STEP_PX, ::STEP_PX], np.float32), sure[::STEP_PX, ::STEP_PX]


def _mean(image: F32) -> F32:
    return np.asarray(cv2.boxFilter(image, -1, (WINDOW_PX, WINDOW_PX)), np.float32)


def _cell_medians(shift: F32, sure: Mask) -> F64:
    """Median shift of each cell of the strip that has windows enough."""
    cell = sure.nonzero()[1] * CELLS[1] // sure.shape[1]
    shifts = shift[sure]
    counts = np.bincount(cell, minlength=CELLS[1])
    return np.array([np.median(shifts[cell == k]) for k in np.flatnonzero(counts >= CELL_WINDOWS)], np.float64)
