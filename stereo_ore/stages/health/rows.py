"""The row difference between the eyes that is left where they were matched: whether the calibration
is theirs.

`calibrate check` finds the same from thousands of features in about a second; here it has to cost a
few milliseconds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from stereo_ore.types import F32, F64, U8, Disparity, Mask, Region

SMOOTHING_PX, _STEP_PX, WINDOW_STEPS = 0.6, 8, 2
"""Images are smoothed by this much; a shift is fitted in windows of so many steps each way, one
each step."""
SURFACE_PX = 1.0
"""Pixels whose disparity differs by more from the mean around them are of another surface."""
_LEAST_SHARE, LEAST_ENERGY, LEAST_BOTH = 0.5, 1.0, 0.4
"""A window tells of rows where this share of it is one surface, where the vertical gradient that
the horizontal one does not explain has this mean square [grey levels² a px²], and where gradients
point this much in both directions: determinant over squared half trace of their matrix, 0 on an
edge, 1 where none is preferred (Shi & Tomasi 1994)."""
STRIPS, STRIP_ROWS = 3, 96
"""Some strips of rows tell as much as all."""
_FEWEST = 60
"""Windows needed for a fit."""
_ROUNDS, OUTLIER, _ALIKE = 8, 2.0, 10
"""Rounds of reweighting; a residual of so many standard deviations counts a quarter; so many
windows, which overlap or lie on one edge, err alike."""

STRETCHES, FEWEST_PART = 12, 24
"""Stretches of a strip that are parts of the image, and windows that are needed to judge one."""

_FAR_PX = 1.0
"""Row differences from which on the matcher is misled, so that patches are looked for in other rows
as well."""
PATCHES, _PATCH_PX, ROWS_PX, WIDTH_PX = 12, 15, 8, 672
"""So many patches a strip, of this side, are looked for so far up and down, in images of about this
width."""
FEWEST_PATCHES, _SMOOTH_PX, PEAK_PX, _CLEARER = 6, 1.0, 2, 0.7
"""Patches needed for a median, and by how much neighbours may differ: what a calibration does is
smooth; rows that are found by chance, as on a chessboard, jump. A patch counts where its unlikeness
[1 − correlation] is so much less than any farther from its row than this: along a bar all rows look
alike."""


@dataclass(frozen=True)
class Windows:
    """Windows with structure in both directions: row shift [px], its certainty, centre (u, v) [px],
    each (N,).
    """

    shift: F64
    energy: F64
    u: F64
    v: F64


@dataclass(frozen=True)
class RowShift:
    """Row difference between the eyes [px]; 0: unknown.

    `systematic` is the root mean square over the image of its smooth part, which a calibration
    makes; `local` what is left in the part of the image where it is largest.
    """

    systematic: float = 0.0
    local: float = 0.0


def row_shift(left: U8, right: U8, disparity: Disparity, offset_px: float) -> RowShift:
    """The row difference between the eyes where they were matched.

    What a wrong calibration does to rows is smooth: a small rotation or scale of an eye adds a
    constant and parts that grow with x, y and x·y (`calibration.residual`). This field is fitted to
    the shifts of many windows, so that their noise averages out; the finest texture makes it up to
    1.4 times too large. Two pixels and more mislead the matcher: then it is the median of what some
    patches show that are looked for in other rows. What a drop on a lens does is left over: the
    median size of what remains in each part of the image.

    Parameters
    ----------
    left, right : (H, W) uint8
        Rectified grey eyes.
    disparity : Disparity
        Matched pixels of the left eye.
    offset_px : float
        The calibration's correction, which is in the disparity but not in the images.
    """
    strips = [_strip_windows(left, right, disparity, offset_px, index) for index in range(STRIPS)]
    if sum(len(windows.u) for windows in strips) < _FEWEST:
        return RowShift()
    patches = np.concatenate([_strongest(windows, disparity.region) for windows in strips])
    far = _far_shift(left, right, patches, disparity.region)
    return RowShift(far) if far > _FAR_PX else _fitted(strips, disparity.region)


def strip(disparity: Disparity, middle: int, height: int) -> tuple[slice, Disparity]:
    """Rows about a middle one, as far as they lie in the region, and the disparity in them."""
    region = disparity.region
    top = max(middle - height // 2, region.y0)
    rows = slice(top, min(top + height, region.y1))
    part = replace(region, y0=0, y1=rows.stop - rows.start)
    return rows, Disparity(disparity.values[rows], part, disparity.confidence[rows])


def smooth_rows(image: U8, sigma_px: float) -> F32:
    """A grey image, smoothed."""
    return np.asarray(cv2.GaussianBlur(image.astype(np.float32), (0, 0), sigma_px), np.float32)


def laid_over(right: F32, disparity: F32, first_column: int) -> F32:
    """The right image as the left eye would see it under a disparity (h, w) [px] that begins at a
    column.
    """
    height, width = disparity.shape
    u = np.arange(first_column, first_column + width, dtype=np.float32) - disparity
    v = np.repeat(np.arange(height, dtype=np.float32)[:, None], width, 1)
    return np.asarray(
        cv2.remap(right, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32
    )


def _strip_windows(
    left: U8, right: U8, disparity: Disparity, offset_px: float, index: int
) -> Windows:
    """The windows of a strip of rows."""
    region = disparity.region
    step = (region.y1 - region.y0) / STRIPS
    rows, part = strip(
        disparity, round(region.y0 + (index + 0.5) * step), min(round(step), STRIP_ROWS)
    )
    columns = region.slices[1]
    if min(region.x1 - region.x0, rows.stop - rows.start) < WINDOW_STEPS * _STEP_PX:
        none = np.empty(0)
        return Windows(none, none, none, none)
    matched = part.values[:, columns] - np.float32(offset_px)
    in_right = matched <= np.arange(region.x0, region.x1, dtype=np.float32)
    flat, seen = _one_surface(np.where(in_right, matched, np.float32(np.nan)))
    one, other = (smooth_rows(image[rows], SMOOTHING_PX) for image in (left, right))
    shift, energy, sure = _window_shifts(one[:, columns], laid_over(other, flat, region.x0), seen)
    v, u = (_STEP_PX * (place + WINDOW_STEPS / 2) for place in sure.nonzero())
    return Windows(shift[sure], energy[sure], np.asarray(u + region.x0), np.asarray(v + rows.start))


def _one_surface(disparity: F32) -> tuple[F32, F32]:
    """Disparity averaged over windows, and the weight of each pixel: 1 where it is of the window's
    surface, else 0.

    The matcher's own disparities give way to a row shift wherever an edge slants, each to its own;
    their mean over a window can't, and what that is wrong by is found together with the shift.
    """
    valid = np.isfinite(disparity)
    filled = np.where(valid, disparity, np.float32(0))
    count = _box(valid.astype(np.float32))
    mean = _box(filled) / np.maximum(count, np.float32(1e-6))
    same = valid & (np.abs(filled - mean) < SURFACE_PX)
    return np.where(same, mean, np.float32(0)), same.astype(np.float32)


def _box(image: F32) -> F32:
    side = WINDOW_STEPS * _STEP_PX - 1
    return np.asarray(cv2.boxFilter(image, -1, (side, side)), np.float32)


def _window_shifts(left: F32, laid: F32, seen: F32) -> tuple[F64, F64, Mask]:
    """Row shift [px] of each window, the energy that tells it, and where it is known.

    Lucas & Kanade 1981 with a shift along the columns and one of brightness as further unknowns,
    both eliminated.
    """
    both, d = (left + laid) * np.float32(0.5), (left - laid) * seen
    gx, gy = (
        np.asarray(cv2.Sobel(both, -1, *axes, scale=1 / 8), np.float32) * seen
        for axes in ((1, 0), (0, 1))
    )
    share = _sums(seen)
    n = np.maximum(share, np.float32(1e-6))
    x, y, z = _sums(gx) / n, _sums(gy) / n, _sums(d) / n
    xx, xy, yy = _sums(gx * gx) / n - x * x, _sums(gx * gy) / n - x * y, _sums(gy * gy) / n - y * y
    xz, yz = _sums(gx * d) / n - x * z, _sums(gy * d) / n - y * z
    along = xy / np.maximum(xx, np.float32(1e-3))
    energy = yy - along * xy
    shift = (yz - along * xz) / np.maximum(energy, np.float32(1e-3))
    corner = xx * energy > LEAST_BOTH * ((xx + yy) / 2) ** 2
    sure = (share > _LEAST_SHARE) & (energy > LEAST_ENERGY) & corner
    return shift.astype(np.float64), energy.astype(np.float64), np.asarray(sure)


def _sums(image: F32) -> F32:
    """Means over the windows: of blocks of a step, and of these."""
    height, width = (side // _STEP_PX for side in image.shape)
    whole = image[: height * _STEP_PX, : width * _STEP_PX]
    blocks = np.asarray(
        cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), np.float32
    )
    return np.asarray(cv2.boxFilter(blocks, -1, (WINDOW_STEPS,) * 2, anchor=(0, 0)), np.float32)[
        :-1, :-1
    ]


def _fitted(strips: list[Windows], region: Region) -> RowShift:
    """The smooth part of the shifts, less what their scatter alone makes of it, and what it
    leaves.
    """
    shift, u, v = (
        np.concatenate([getattr(w, name) for w in strips]) for name in ("shift", "u", "v")
    )
    x, y = (u - u.mean()) / WIDTH_PX, (v - v.mean()) / WIDTH_PX
    basis = np.column_stack([np.ones_like(x), x, y, x * y])
    field, scatter = np.full_like(shift, np.median(shift)), 0.0
    for _ in range(_ROUNDS):
        residual = shift - field
        scatter = 1.4826 * float(np.median(np.abs(residual)))
        weight = 1 / (1 + (residual / (OUTLIER * scatter + 1e-6)) ** 2) ** 2
        # Sums without BLAS, whose order depends on the number of threads.
        normal = np.einsum("ni,nj->ij", basis * weight[:, None], basis)
        field = np.einsum(
            "ni,i->n",
            basis,
            np.linalg.lstsq(normal, np.einsum("ni,n->i", basis, weight * shift), rcond=None)[0],
        )
    noise = basis.shape[1] * scatter**2 * _ALIKE / len(shift)
    systematic = float(np.sqrt(max(np.mean(field**2) - noise, 0.0)))
    return RowShift(systematic, _largest_part(np.abs(shift - field), u, strips, region))


def _largest_part(residual: F64, u: F64, strips: list[Windows], region: Region) -> float:
    """Largest median of the residuals in stretches of the strips that have windows enough."""
    place = ((u - region.x0) * STRETCHES / (region.x1 - region.x0)).astype(int)
    place += STRETCHES * np.repeat(np.arange(len(strips)), [len(windows.u) for windows in strips])
    count = np.bincount(place)
    return max(
        (float(np.median(residual[place == k])) for k in np.flatnonzero(count >= FEWEST_PART)),
        default=0.0,
    )


def _strongest(windows: Windows, region: Region) -> F64:
    """Centres (n, 2) [px] of the clearest window in each of some stretches of a strip."""
    place = ((windows.u - region.x0) * PATCHES / (region.x1 - region.x0)).astype(int)
    chosen = [
        np.flatnonzero(place == k)[np.argmax(windows.energy[place == k])] for k in np.unique(place)
    ]
    return np.column_stack([windows.u[chosen], windows.v[chosen]])


def _far_shift(left: U8, right: U8, patches: F64, region: Region) -> float:
    """Median size of the row difference [px] of patches that are looked for in other rows as well;
    0: unknown.
    """
    scale = max(1, round(left.shape[1] / WIDTH_PX))
    size = (left.shape[1] // scale, left.shape[0] // scale)
    one, other = (cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (left, right))
    nearest, farthest = (
        (region.min_disparity + region.num_disparities) // scale + 1,
        region.min_disparity // scale - 1,
    )
    half, rows = _PATCH_PX // 2, _PATCH_PX // 2 + ROWS_PX
    found: list[float] = []
    for u, v in (patches / scale).astype(int):
        patch = one[v - half : v + half + 1, max(u - half, 0) : u + half + 1]
        area = other[
            max(v - rows, 0) : v + rows + 1,
            max(u - half - nearest, 0) : max(u + half + 1 - farthest, 0),
        ]
        if (
            v < rows
            or len(area) < 2 * rows + 1
            or patch.shape[1] > area.shape[1]
            or patch.shape[1] < _PATCH_PX
        ):
            continue
        likeness = np.asarray(
            cv2.matchTemplate(area, patch, cv2.TM_CCOEFF_NORMED).max(1), np.float64
        )
        if (row := _clear_peak(likeness)) is not None:
            found.append(row - ROWS_PX)
    if len(found) < FEWEST_PATCHES or np.median(np.abs(np.diff(found))) > _SMOOTH_PX:
        return 0.0
    return float(scale * np.median(np.abs(found)))


def _clear_peak(likeness: F64) -> float | None:
    """Place of the greatest value, to a fraction by a parabola; None where others are almost as
    great: on a bar.
    """
    top = int(np.argmax(likeness))
    away = np.abs(np.arange(len(likeness)) - top) > PEAK_PX
    if 1 - likeness[top] > _CLEARER * (1 - likeness[away].max()):
        return None
    if not 0 < top < len(likeness) - 1:
        return float(top)
    above, peak, below = likeness[top - 1 : top + 2]
    return float(top + 0.5 * (above - below) / min(above - 2 * peak + below, -1e-9))
