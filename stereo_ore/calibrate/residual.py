"""The row difference of features that both eyes see: the witness of every calibration.

In rectified images corresponding features share a row. What is left of a difference tells what is
wrong: a small rotation ω of the right eye moves its features by f·(ωz·x − ωx·(1 + y²) + ωy·x·y)
rows, where (x, y) are image coordinates over the focal length; a vertical shift of the eye by the
disparity times t_y/B; a focal length that is off by the share s, by f·s·y. (Longuet-Higgins &
Prazdny 1980, for a static scene.)
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from stereo_ore.types import F64, U8, Mask, Rig

LIMIT_PX = 0.5
"""Rows may differ by this much in the mean; more means that the calibration is wrong."""

FEWEST_MATCHES = 40
_FEATURES = 4000
_RATIO = 0.8
_HYPOTHESES = 400
_CELLS = (6, 8)
_CELL_MATCHES = 4


@dataclass(frozen=True)
class RowResidual:
    """Row differences (right − left) of matched features, and what they say.

    Attributes
    ----------
    matched, used
        Mutual matches, and those that agree with a smooth field of row differences.
    median_px
        Of the used matches, signed.
    systematic_px
        Root mean square of the smooth field: what calibration explains; noise is left out.
    noise_px
        Robust standard deviation of the matches about the field.
    rotation_rad, rotation_sigma_rad
        (3,) rotation of the right eye that the field implies, and its standard deviation.
    map_px
        (6, 8) medians in cells of the image, NaN where there are few.
    negative_share
        Share of used matches that lie behind the camera (disparity + `Rig.shift_px` < −1 px).
    disparity_px
        (3,) 5th, 50th and 95th percentile of the disparity, the calibration's correction added.
    """

    matched: int
    used: int
    median_px: float
    systematic_px: float
    noise_px: float
    rotation_rad: F64
    rotation_sigma_rad: F64
    map_px: F64
    negative_share: float
    disparity_px: F64

    @property
    def enough(self) -> bool:
        """Whether there are matches enough for a verdict."""
        return self.used >= FEWEST_MATCHES

    @property
    def aligned(self) -> bool:
        """Whether rows are aligned within `LIMIT_PX`."""
        return self.enough and max(abs(self.median_px), self.systematic_px) < LIMIT_PX


def vertical_residual(left: U8, right: U8, rig: Rig) -> RowResidual:
    """Row differences of features matched between two rectified grey images (H, W)."""
    return residual_of_matches(*match_features(left, right), rig)


def match_features(left: U8, right: U8) -> tuple[F64, F64]:
    """Pixels (N, 2) of SIFT features that are each other's best match by a clear margin."""
    sift = cv2.SIFT.create(nfeatures=_FEATURES)
    keys_left, words_left = sift.detectAndCompute(left, None)
    keys_right, words_right = sift.detectAndCompute(right, None)
    if len(keys_left) < 2 or len(keys_right) < 2:
        return np.zeros((0, 2)), np.zeros((0, 2))
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    there, back = (
        matcher.knnMatch(words_left, words_right, 2),
        matcher.match(words_right, words_left),
    )
    returns = {match.queryIdx: match.trainIdx for match in back}
    pairs = [
        (best.queryIdx, best.trainIdx)
        for best, second in there
        if best.distance < _RATIO * second.distance and returns.get(best.trainIdx) == best.queryIdx
    ]
    px_left = np.array([keys_left[i].pt for i, _ in pairs], np.float64).reshape(-1, 2)
    px_right = np.array([keys_right[j].pt for _, j in pairs], np.float64).reshape(-1, 2)
    return px_left, px_right


def residual_of_matches(left: F64, right: F64, rig: Rig) -> RowResidual:
    """Row differences of given matches (N, 2) in rectified images; wrong matches among them are
    found out.
    """
    sound = np.isfinite(left).all(1) & np.isfinite(right).all(1)
    left, right = left[sound], right[sound]
    rows, basis = right[:, 1] - left[:, 1], _basis(left, right, rig)
    if len(left) < FEWEST_MATCHES:
        return _too_few(len(left))
    used = _consensus(rows, basis)
    weights, used = _reweight(rows, basis, used)
    if used.sum() < FEWEST_MATCHES:
        return _too_few(len(left))
    field, values, covariance, noise = _solve(rows, basis, weights, used)
    disparity = left[used, 0] - right[used, 0] + rig.shift_px
    # The constant of the field is −ωx, the columns of x·y and x are ωy and ωz.
    rotation = np.array([-values[0], values[1], values[2]])
    return RowResidual(
        matched=len(left),
        used=int(used.sum()),
        median_px=float(np.median(rows[used])),
        systematic_px=float(np.sqrt(np.mean(field[used] ** 2))),
        noise_px=noise,
        rotation_rad=rotation,
        rotation_sigma_rad=np.sqrt(np.diag(covariance)[:3]),
        map_px=_cells(left[used], rows[used], rig),
        negative_share=float((disparity < -1).mean()),
        disparity_px=np.percentile(disparity - rig.doffs_px, (5, 50, 95)),
    )


def _too_few(matched: int) -> RowResidual:
    nan, three = float("nan"), np.full(3, np.nan)
    return RowResidual(matched, 0, nan, nan, nan, three, three, np.full(_CELLS, np.nan), nan, three)


def _basis(left: F64, right: F64, rig: Rig) -> F64:
    """Columns of the row difference [px] for −ωx, ωy, ωz, t_y/B and s."""
    x = (right[:, 0] - rig.cx - rig.doffs_px) / rig.fx
    y = (right[:, 1] - rig.cy) / rig.fy
    disparity = left[:, 0] - right[:, 0] + rig.shift_px
    return np.column_stack([rig.fy * (1 + y**2), rig.fy * x * y, rig.fy * x, disparity, rig.fy * y])


def _consensus(rows: F64, basis: F64) -> Mask:
    """Matches that agree with the rotation (ωx, ωz, scale) of least median residual; seeded
    sampling.
    """
    rng = np.random.default_rng(0)
    affine = basis[:, [0, 2, 4]]
    picks = rng.integers(0, len(rows), (_HYPOTHESES, 3))
    sample, target = affine[picks], rows[picks][..., None]
    solvable = np.abs(np.linalg.det(sample)) > 1e-9 * float(np.abs(affine).max()) ** 3
    models = np.linalg.solve(sample[solvable], target[solvable])[..., 0]
    if not len(models):
        return np.ones(len(rows), bool)
    error = np.abs(rows - models @ affine.T)
    best = error[np.argmin(np.median(error, axis=1))]
    return np.asarray(best <= max(3.0, 5 * float(np.median(best))))


def _reweight(rows: F64, basis: F64, used: Mask) -> tuple[F64, Mask]:
    """Tukey's weights after iterated fits of the whole basis, and where they are not zero."""
    weights = used.astype(np.float64)
    for _ in range(15):
        values = _fit(rows, basis, weights)
        residual = rows - basis @ values
        scale = max(1.4826 * float(np.median(np.abs(residual[weights > 0]))), 0.05)
        weights = np.clip(1 - (residual / (4.685 * scale)) ** 2, 0, None) ** 2
    return weights, weights > 0


def _ridge(basis: F64) -> F64:
    """A prior of 0.1 rad or share on each value, with 1 px of noise: keeps a flat or far scene
    solvable.
    """
    return np.eye(basis.shape[1]) / 0.1**2


def _fit(rows: F64, basis: F64, weights: F64) -> F64:
    weighted = basis * weights[:, None]
    return np.asarray(
        np.linalg.solve(weighted.T @ basis + _ridge(basis), weighted.T @ rows), np.float64
    )


def _solve(rows: F64, basis: F64, weights: F64, used: Mask) -> tuple[F64, F64, F64, float]:
    """Field (N,) [px], values, their covariance, noise [px]."""
    values = _fit(rows, basis, weights)
    field = basis @ values
    noise = 1.4826 * float(np.median(np.abs(rows - field)[used]))
    normal = (basis * weights[:, None]).T @ basis + _ridge(basis)
    return (
        field,
        values,
        np.asarray(np.linalg.inv(normal) * max(noise, 0.05) ** 2, np.float64),
        noise,
    )


def _cells(px: F64, rows: F64, rig: Rig) -> F64:
    """Medians of the row differences in cells of the image."""
    index = (
        (px[:, ::-1] / (rig.height, rig.width) * _CELLS).astype(int).clip(0, np.array(_CELLS) - 1)
    )
    medians = np.full(_CELLS, np.nan)
    for cell in np.unique(index, axis=0):
        here = rows[(index == cell).all(1)]
        if len(here) >= _CELL_MATCHES:
            medians[tuple(cell)] = np.median(here)
    return medians
