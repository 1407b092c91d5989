"""How good a result is: filter quality (equation 7), disparity errors, matched lumps, errors of
solids and strikes.

Pure functions of results and truth; `evaluate` applies them to run folders.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from stereo_ore.types import F32, F64, Mask

_NEAR_PX, NEAR_DISPARITY_PX = 2, 1.0
"""A point is noise when no true surface lies within so many pixels and so much disparity of it."""


@dataclass(frozen=True)
class FilterQuality:
    """Equation 7, positive = noise: P_r = TP/(TP+FP), Recall = TP/(TP+FN), Retain = TN/(TN+FP), all
    0…1.

    An empty denominator counts as one point, so that the figures are always numbers.
    """

    precision: float
    recall: float
    retention: float
    f1: float

    def as_dict(self) -> dict[str, float]:
        """The four figures by name."""
        return asdict(self)


def filter_quality(is_noise: Mask, removed: Mask) -> FilterQuality:
    """Equation 7 for (N,) truth and decision."""
    if is_noise.shape != removed.shape:
        raise ValueError(f"truth has shape {is_noise.shape}, decision {removed.shape}")
    tp, fp = int((is_noise & removed).sum()), int((~is_noise & removed).sum())
    fn, tn = int((is_noise & ~removed).sum()), int((~is_noise & ~removed).sum())
    precision, recall = tp / max(tp + fp, 1), tp / max(tp + fn, 1)
    f1 = 2 * precision * recall / max(precision + recall, 1e-9)
    return FilterQuality(precision, recall, tn / max(tn + fp, 1), f1)


def is_noise(
    xyz: npt.NDArray[np.floating[Any]], true_disparity: F64, K: F64, focal_baseline: float
) -> Mask:
    """True for points (N, 3) [m, rectified left camera] with no true surface near them.

    Near means: some pixel at most `_NEAR_PX` away from the point's projection, in either direction,
    whose true disparity differs from the point's by at most `NEAR_DISPARITY_PX`.

    Parameters
    ----------
    true_disparity : (H, W) array
        Of the rectified left view [px]; 0 where nothing is seen.
    K : (3, 3) array
        Its camera matrix [px].
    focal_baseline : float
        Focal length times baseline [px m].
    """
    h, w = true_disparity.shape
    u = np.rint(xyz[:, 0] / xyz[:, 2] * K[0, 0] + K[0, 2]).astype(int)
    v = np.rint(xyz[:, 1] / xyz[:, 2] * K[1, 1] + K[1, 2]).astype(int)
    disparity, best = focal_baseline / xyz[:, 2], np.full(len(xyz), np.inf)
    steps = range(-_NEAR_PX, _NEAR_PX + 1)
    for dv, du in ((dv, du) for dv in steps for du in steps):
        uu, vv = u + du, v + dv
        inside = (uu >= 0) & (uu < w) & (vv >= 0) & (vv < h)
        true = np.zeros(len(xyz))
        true[inside] = true_disparity[vv[inside], uu[inside]]
        gap = np.abs(true - disparity)
        best = np.where((true > 0) & (gap < best), gap, best)
    return np.asarray(best > NEAR_DISPARITY_PX)


@dataclass(frozen=True)
class DisparityQuality:
    """Share of pixels with a disparity, share missing or wrong by more than 1 px, median absolute
    error [px].
    """

    valid: float
    bad1: float
    median_px: float


def disparity_quality(disparity: F32, true_disparity: F64, where: Mask) -> DisparityQuality:
    """Errors of a disparity map (H, W), NaN = none, over the pixels of a mask; NaN where the mask
    is empty.
    """
    error = np.abs(disparity - true_disparity)[where]
    finite = error[np.isfinite(error)]
    if not len(error):
        return DisparityQuality(np.nan, np.nan, np.nan)
    median = float(np.median(finite)) if len(finite) else np.nan
    return DisparityQuality(len(finite) / len(error), float((~(error <= 1)).mean()), median)


def iou_matrix(
    truth: npt.NDArray[np.integer[Any]],
    found: npt.NDArray[np.integer[Any]],
    truth_ids: Sequence[int],
    found_ids: Sequence[int],
) -> F64:
    """Intersection over union of every true (rows) with every found label (columns) of two (H, W)
    maps.
    """
    rows, columns = (
        np.searchsorted(ids, labels.ravel()) if len(ids) else np.zeros(labels.size, int)
        for ids, labels in ((np.array(truth_ids), truth), (np.array(found_ids), found))
    )  # fmt: skip
    row_hit = np.isin(truth.ravel(), truth_ids)
    column_hit = np.isin(found.ravel(), found_ids)
    both = row_hit & column_hit
    shape = (len(truth_ids), len(found_ids))
    common = np.bincount(
        rows[both] * shape[1] + columns[both], minlength=shape[0] * shape[1]
    ).reshape(shape)
    areas = np.bincount(rows[row_hit], minlength=shape[0])[:, None]
    found_areas = np.bincount(columns[column_hit], minlength=shape[1])[None]
    return np.asarray(common / np.maximum(areas + found_areas - common, 1))


def best_pairs(iou: F64) -> list[tuple[int, int]]:
    """Row and column indices of the one-to-one assignment with the greatest sum."""
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(-iou)
    return list(zip(rows.tolist(), columns.tolist(), strict=True))


def split_along(vector: F64, normal: F64) -> tuple[float, float]:
    """Length of a vector in the plane of a unit normal, and its absolute length along the
    normal.
    """
    along = float(vector @ normal)
    return float(np.linalg.norm(vector - along * normal)), abs(along)


def surface_distance_and_angle(
    point: F64, direction: F64, surface: F64, neighbours: int = 200
) -> tuple[float, float]:
    """Distance [m] of a strike from the nearest true surface point, and angle [rad] to the inward
    normal.

    The normal is that of the plane fitted to the nearest `neighbours` of the surface points (N, 3),
    camera frame.
    """
    distance = np.linalg.norm(surface - point, axis=1)
    near = surface[np.argsort(distance)[:neighbours]]
    normal = np.linalg.svd(near - near.mean(0), full_matrices=False)[2][2]
    normal = normal if normal @ near.mean(0) < 0 else -normal
    return float(distance.min()), float(np.arccos(np.clip(-direction @ normal, -1, 1)))


def area_under_roc(score: npt.NDArray[np.floating[Any]], positive: Mask) -> float | None:
    """Chance that a positive one of (N,) scores above a negative one, ties counting half; None
    where one kind lacks.
    """
    values, rank, count = np.unique(score, return_inverse=True, return_counts=True)
    hits = np.bincount(rank, positive, len(values))
    misses = count - hits
    below = np.cumsum(misses) - misses / 2
    pairs = float(hits.sum() * misses.sum())
    return float((hits * below).sum()) / pairs if pairs else None


def reliability(
    said: npt.NDArray[np.floating[Any]], true: Mask
) -> tuple[list[float | None], list[float | None]]:
    """Mean probability said, and share that is true, of (N,) in each tenth of the probability; None
    in empty ones.
    """
    tenth = np.minimum((10 * said).astype(int), 9)
    count = np.bincount(tenth, minlength=10)
    means = (np.bincount(tenth, x, 10) / np.maximum(count, 1) for x in (said, true))
    first, second = (
        [float(x) if n else None for x, n in zip(mean, count, strict=True)] for mean in means
    )
    return first, second
