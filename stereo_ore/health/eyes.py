"""Whether both eyes show the same scene, in the same rows, with light enough to be matched."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from stereo_ore.config import HealthConfig
from stereo_ore.types import F32, F64, U8, Disparity, Mask, Reason, RectifiedPair

SMOOTHING_PX, WINDOW_PX, STEP_PX = 1.5, 15, 8
"""Images are smoothed by this much; a row shift is fitted in windows of this side, one each so many pixels."""
LEAST_GRADIENT = 1.0
"""Mean square of the vertical gradient [grey levels² a px²] below which a window tells nothing of rows."""
CELLS = (3, 4)
CELL_WINDOWS = 30
"""Shifts are gathered in so many cells of the image; a cell with fewer windows is left out."""


def doubts(pair: RectifiedPair, disparity: Disparity, config: HealthConfig) -> Iterator[Reason]:
    """Why a disparity is too poor to act on.

    FEW_DISPARITIES: a covered lens, dust, no light. EYES_DISAGREE: swapped eyes, or eyes of two moments, match by
    chance only, and neighbours differ. ROWS_DISAGREE: the calibration is not that of these images.
    """
    valid, region = np.isfinite(disparity.values), disparity.region
    share = valid.sum() / max((region.x1 - region.x0) * (region.y1 - region.y0), 1)
    if share < config.min_disparity_share:
        wanted = f"{100 * config.min_disparity_share:.0f} % wanted"
        yield Reason("FEW_DISPARITIES", f"{100 * share:.0f} % of the pixels searched have a disparity; {wanted}")
    spread = float(np.median(disparity.cues["spread_px"][valid])) if valid.any() else 0.0
    if spread > config.max_spread_px:
        text = f"neighbouring disparities differ by {spread:.2f} px, {config.max_spread_px} px at most are wanted"
        yield Reason("EYES_DISAGREE", f"{text}: are the eyes swapped, or of two moments?")
    shift = row_shift(pair, disparity)
    if shift > config.max_row_shift_px:
        text = f"the rows of the eyes differ by {shift:.2f} px, {config.max_row_shift_px} px at most are wanted"
        yield Reason("ROWS_DISAGREE", f"{text}: is the calibration that of this camera? See calibrate check")


def row_shift(pair: RectifiedPair, disparity: Disparity) -> float:
    """Root mean square over the image of the row difference [px] that is left between matched pixels; 0: unknown.

    The right image is laid over the left by the disparity; what differs then, over the vertical gradient, is a row
    shift (Lucas & Kanade 1981, one unknown). Disparities give way to a shift where edges slant, so about a third
    of a shift of up to 2 px is seen; more spoils the matching itself.
    """
    left, right = (_smooth(image) for image in (pair.left, pair.right))
    shift, sure = _window_shifts(left, right, disparity, pair.rig.disparity_offset_px)
    medians = _cell_medians(shift, sure)
    return float(np.sqrt(np.mean(medians**2))) if len(medians) else 0.0


def _smooth(image: U8) -> F32:
    grey = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), (0, 0), SMOOTHING_PX)
    return np.asarray(grey, np.float32)


def _window_shifts(left: F32, right: F32, disparity: Disparity, offset_px: float) -> tuple[F32, Mask]:
    """Row shift [px] of each window, and where it is known."""
    rows, columns = disparity.region.slices
    values = disparity.values[rows, columns]
    valid = np.isfinite(values)
    v, u = np.mgrid[rows, columns].astype(np.float32)
    # A correction of the calibration is in the disparity, but not in the images.
    there = u - np.where(valid, values - np.float32(offset_px), np.float32(0))
    laid = cv2.remap(right, there, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
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
    """Median shift of each cell of the image that has windows enough."""
    row, column = (index * count // size for index, count, size in zip(sure.nonzero(), CELLS, sure.shape, strict=True))
    cell, shifts = row * CELLS[1] + column, shift[sure]
    counts = np.bincount(cell, minlength=CELLS[0] * CELLS[1])
    return np.array([np.median(shifts[cell == k]) for k in np.flatnonzero(counts >= CELL_WINDOWS)], np.float64)
