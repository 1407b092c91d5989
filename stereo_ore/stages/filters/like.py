"""The statistical and the radius filter as other programs mean them: the same parameters give
exactly their sets.

Copies of a point count as points here, coordinates are in the program's own precision, and sums run
in its order.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from stereo_ore.config.filters import RadiusParams, StatisticalParams
from stereo_ore.errors import ConfigError
from stereo_ore.threads import map_rows
from stereo_ore.types import F64, FilterResult, Mask

Real = npt.NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Program:
    """What a program makes of the common names.

    Does k count the point itself; degrees of freedom that its deviation takes off; does it keep
    only 0 < mean < limit, or mean ≤ limit; its precision; does a point at exactly the radius lie
    within it, None where it has no such filter.
    """

    name: str
    counts_itself: bool
    freedom: int
    strict: bool
    precision: type[np.floating[Any]]
    radius_included: bool | None = None


PROGRAMS: Mapping[str, Program] = {
    "open3d": Program("Open3D", True, 1, True, np.float64, False),
    "pcl": Program("PCL", False, 1, False, np.float32, True),
    "cloudcompare": Program("CloudCompare", True, 0, False, np.float32),
    "cars": Program("cars-filter", False, 0, False, np.float64),
}
"""As of Open3D 0.20, PCL 1.13, CloudCompare 2.11 and cars-filter 0.3."""


def apply_like(program: str, xyz: F64, params: Any, metres: float = 1.0) -> FilterResult:
    """Decide as another program would.

    Parameters
    ----------
    program : str
        A key of `PROGRAMS`.
    xyz : (M, 3) array
        Points in the file's unit; those that are not finite are removed.
    params : StatisticalParams or RadiusParams
        In that program's meaning: k and ratio, or n and radius_m.
    metres : float
        A unit of the coordinates [m], for `radius_m`.

    Raises
    ------
    ConfigError
        For an unknown program, or a filter that it does not have.
    """
    if program not in PROGRAMS:
        raise ConfigError(
            f"no program is called {program!r} here",
            key="--like",
            remedy=f"Use {', '.join(PROGRAMS)}",
        )
    of = PROGRAMS[program]
    finite = np.isfinite(xyz).all(1)
    points = xyz[finite].astype(of.precision)
    if isinstance(params, StatisticalParams):
        kept, score, said = _statistical(points, of, params)
    elif isinstance(params, RadiusParams):
        kept, score, said = _radius(points, of, params, metres)
    else:
        remedy = "Use --method statistical or radius"
        raise ConfigError(f"{of.name} is followed only by two methods", key="--like", remedy=remedy)
    keep, scores = np.zeros(len(xyz), bool), np.full(len(xyz), np.inf, np.float32)
    keep[finite], scores[finite] = kept, score
    counts = {
        "points": len(xyz),
        "not_finite": int((~finite).sum()),
        "duplicates": 0,
        "kept": int(keep.sum()),
    }
    return FilterResult(
        keep, scores, counts | {"params": params.model_dump(mode="json"), "like": program} | said
    )


def _statistical(
    points: Real, of: Program, params: StatisticalParams
) -> tuple[Mask, Real, dict[str, Any]]:
    """Keep by mean distance to k neighbours, against its mean and deviation over the cloud (Rusu et
    al. 2008).
    """
    others = min(params.k - of.counts_itself, len(points) - 1)
    if others < 1:
        mean = np.zeros(len(points), of.precision)
    else:
        distance = np.sqrt(_squares(points, others)).astype(np.float64)
        # Open3D divides by all that it found, the point itself among them: of no effect but on the
        # last digit.
        divisor = others + (of.strict and of.counts_itself)
        mean = (np.add.accumulate(distance, axis=1)[:, -1] / divisor).astype(of.precision)
    limit = _limit(mean.astype(np.float64), of, params.ratio)
    keep = (mean > 0) & (mean < limit) if of.strict else mean <= limit
    return (
        keep,
        mean / np.float64(max(limit, np.finfo(float).tiny)),
        {"method": "statistical", "limit": limit},
    )


def _limit(mean: F64, of: Program, ratio: float) -> float:
    if len(mean) <= of.freedom:
        return float(mean.sum())
    middle = np.add.accumulate(mean)[-1] / len(mean)
    # A point under as many copies as there are neighbours adds nothing to Open3D's deviation.
    away = np.where(mean > 0, mean - middle, 0) if of.strict else mean - middle
    deviation = np.sqrt(np.add.accumulate(away**2)[-1] / (len(mean) - of.freedom))
    return float(middle + ratio * deviation)


def _radius(
    points: Real, of: Program, params: RadiusParams, metres: float
) -> tuple[Mask, Real, dict[str, Any]]:
    """Keep points with at least n others within the radius: the n-th nearest tells."""
    if of.radius_included is None:
        raise ConfigError(
            f"{of.name} has no radius filter", key="--like", remedy="Use open3d or pcl"
        )
    if params.radius_m is None:
        raise ConfigError(
            f"{of.name} needs a radius", key="radius_m", remedy="Say --set radius_m=…"
        )
    said = {"method": "radius", "radius_m": params.radius_m}
    if len(points) <= params.n:
        return np.zeros(len(points), bool), np.full(len(points), np.inf), said
    square, limit = (
        _squares(points, params.n)[:, -1].astype(np.float64),
        (params.radius_m / metres) ** 2,
    )
    keep = square <= limit if of.radius_included else square < limit
    return keep, np.sqrt(square / limit), said


def _squares(points: Real, k: int) -> Real:
    """Squared distances (M, k) to the k nearest others, ascending, summed x, y, z in the points'
    precision.
    """
    tree = cKDTree(points, balanced_tree=False)

    def rows_of(rows: slice) -> Real:
        index = np.asarray(tree.query(points[rows], range(1, k + 2))[1])
        away = points[index] - points[rows, None]
        away *= away
        # The nearest is the point itself, or a copy of it.
        return np.sort(away[..., 0] + away[..., 1] + away[..., 2], axis=1)[:, 1:]

    return map_rows(rows_of, len(points))
