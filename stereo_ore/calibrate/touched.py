"""Hand-eye calibration from touched points: the tool's tip in arm coordinates and the same point in
both images.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereo_ore.calibrate.points import rectify_points, triangulate
from stereo_ore.calibrate.pose import fit_rigid, image_error, refine_pose
from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration.geometry import UNITS_M
from stereo_ore.stages.rectify import make_rectifier
from stereo_ore.transforms import inverse, transform_points
from stereo_ore.types import F64, Mask, StereoCalibration

_FEWEST_POINTS = 3
LEAST_LIMIT_MM, GREATEST_LIMIT_MM = 5.0, 50.0
MOST_DROPPED = 1 / 3
LEAST_SPREAD_M = 0.02
"""Distance of the points from their common line, root mean square."""

_OUTLIER_PX = 3.0
_OUTLIER_FACTOR = 4.0
_MOST_TRIPLES = 400

SAME_SCALE = 0.25
"""Share by which distances of touched points may differ from those seen, before the unit is in
doubt."""

MIRRORED_SHARE, MIRRORED_FLOOR_MM = 0.3, 10.0
TOUCH_PX, LIMIT_SIGMAS = 0.5, 3.0
"""Touched points are clicked to half a pixel; a good fit leaves three times the depth noise of that
at most."""

_UNIT_WORDS = {
    "m": "metres",
    "dm": "decimetres",
    "cm": "centimetres",
    "mm": "millimetres",
    "inch": "inches",
    "ft": "feet",
}


@dataclass(frozen=True)
class Touched:
    """A point touched by the tool: name, arm coordinates (3,) [m], recorded pixels of both eyes
    (2,).
    """

    name: str
    arm_m: tuple[float, float, float]
    left_px: tuple[float, float]
    right_px: tuple[float, float]


@dataclass(frozen=True)
class HandEyeResult:
    """``T_arm_camera`` and its witnesses: a name, a residual [mm] and whether it was used for each
    point or pose.

    `own_mm` is the residual [mm] that the images alone allow.
    """

    T_arm_camera: F64
    method: str
    names: tuple[str, ...]
    residual_mm: F64
    used: Mask
    own_mm: float = 0.0

    @property
    def limit_mm(self) -> float:
        """The root mean square residual beyond which the fit explains nothing, from what the images
        allow.
        """
        return limit_from(self.own_mm)

    @property
    def explains(self) -> bool:
        """Whether most points or poses agree."""
        return int((~self.used).sum()) <= MOST_DROPPED * len(self.used)

    @property
    def rms_mm(self) -> float:
        """Root mean square residual of what was used."""
        return float(np.sqrt(np.mean(self.residual_mm[self.used] ** 2)))

    @property
    def max_mm(self) -> float:
        """Greatest residual of what was used."""
        return float(self.residual_mm[self.used].max())

    @property
    def dropped(self) -> tuple[str, ...]:
        """Names of the outliers."""
        return tuple(name for name, used in zip(self.names, self.used, strict=True) if not used)


def limit_from(own_mm: float) -> float:
    """The greatest residual [mm] of a fit that explains its data, from what the images allow
    [mm].
    """
    return float(np.clip(own_mm, LEAST_LIMIT_MM, GREATEST_LIMIT_MM))


def fit_touched(points: Sequence[Touched], calibration: StereoCalibration) -> HandEyeResult:
    """The camera's pose in the arm frame from at least three touched points.

    Closed form on the triple of points that most others agree with, then the least error in both
    images over all that agree: a pixel weighs the same everywhere, while a triangulated depth is
    ten times less certain than its sides.

    Raises
    ------
    CalibrationError
        When there are fewer than three points, they lie on one line, or no three agree.
    """
    arm = np.array([point.arm_m for point in points], np.float64).reshape(-1, 3)
    _check_spread(arm, "arm coordinates of the points")
    pixels = np.array([(*point.left_px, *point.right_px) for point in points], np.float64)
    seen = triangulate(calibration, pixels[:, :2], pixels[:, 2:])
    if behind := [
        point.name for point, xyz in zip(points, seen, strict=True) if not np.isfinite(xyz).all()
    ]:
        problem = (
            f"{', '.join(behind)}: the pixels meet behind the camera; are left and right exchanged?"
        )
        raise CalibrationError(problem, key="points")
    _check_unit(arm, seen)
    left, right = rectify_points(calibration, pixels[:, :2], pixels[:, 2:])
    rig = make_rectifier(calibration).rig

    def error(T_camera_arm: F64) -> F64:
        return np.asarray(np.abs(image_error(T_camera_arm, arm, left, right, rig)).max(1))

    T = min(_hypotheses(arm, seen), key=lambda T_camera_arm: float(np.median(error(T_camera_arm))))
    used = np.ones(len(points), bool)
    for _ in range(3):
        used = error(T) <= max(_OUTLIER_PX, _OUTLIER_FACTOR * float(np.median(error(T))))
        _check_spread(arm[used], "points that agree")
        T = refine_pose(fit_rigid(seen[used], arm[used]), arm[used], left[used], right[used], rig)
    residual = 1000 * np.linalg.norm(transform_points(inverse(T), seen) - arm, axis=1)
    _check_hand(arm, seen, residual)
    names = tuple(point.name for point in points)
    own = LIMIT_SIGMAS * 1000 * float(np.median(rig.depth_sigma(seen[:, 2], TOUCH_PX)))
    return HandEyeResult(
        inverse(T), "touched points, least error in both images", names, residual, used, own
    )


def _check_unit(arm: F64, seen: F64) -> None:
    """Refuse arm coordinates in another unit than metres: the distances between the points tell.

    Raises
    ------
    CalibrationError
        Naming the unit.
    """
    i, j = np.triu_indices(len(arm), 1)
    apart = [np.linalg.norm(points[i] - points[j], axis=1) for points in (arm, seen)]
    scale = float(np.median(apart[0] / np.maximum(apart[1], 1e-9)))
    if abs(np.log(scale)) < np.log1p(SAME_SCALE):
        return
    unit = min(UNITS_M, key=lambda name: abs(np.log(scale * UNITS_M[name])))
    remedy = "Write them in metres"
    if abs(np.log(scale * UNITS_M[unit])) < np.log1p(SAME_SCALE):
        raise CalibrationError(
            f"distances are {scale:.4g} times those seen: the arm coordinates look like"
            f" {_UNIT_WORDS[unit]}",
            key="points",
            remedy=remedy,
        )
    raise CalibrationError(
        f"distances between the points are {scale:.4g} times those seen: neither metres nor another"
        " unit",
        key="points",
        remedy=(
            "Are names and pixels of the points in the right rows, and is the calibration that of"
            " this camera?"
        ),
    )


def _check_hand(arm: F64, seen: F64, residual_mm: F64) -> None:
    """Refuse an arm whose axes are left-handed: a reflection fits where no rotation does.

    Raises
    ------
    CalibrationError
        Saying so.
    """
    if len(arm) <= _FEWEST_POINTS:
        return
    # A mirrored fit is a rigid one to the points with one axis turned.
    mirrored = arm * [1.0, -1.0, 1.0]
    T = fit_rigid(mirrored, seen)
    left = 1000 * np.linalg.norm(transform_points(T, seen) - mirrored, axis=1)
    rms, mirrored_rms = (
        float(np.sqrt(np.mean(np.square(values)))) for values in (residual_mm, left)
    )
    if mirrored_rms < MIRRORED_SHARE * rms and rms > MIRRORED_FLOOR_MM:
        raise CalibrationError(
            f"no rotation fits (RMS {rms:.0f} mm), a reflection does ({mirrored_rms:.1f} mm): "
            "the arm's axes are mirrored (left-handed)",
            key="points",
            remedy=(
                "Turn the sign of one axis, for example of arm_y_m, here and where the arm takes"
                " its targets"
            ),
        )


def _check_spread(points: F64, what: str) -> None:
    if len(points) < _FEWEST_POINTS:
        remedy = "Touch at least three points, better six, spread over the screen and in height"
        raise CalibrationError(
            f"{len(points)} {what}, {_FEWEST_POINTS} are needed", key="points", remedy=remedy
        )
    if not np.isfinite(points).all():
        raise CalibrationError(f"{what}: have numbers that are not finite", key="points")
    spread = np.linalg.svd(points - points.mean(0), compute_uv=False)[1] / np.sqrt(len(points))
    if spread < LEAST_SPREAD_M:
        problem = f"the {what} lie on one line, within {1000 * spread:.1f} mm"
        raise CalibrationError(
            problem, key="points", remedy="Touch points that span a triangle, as wide as the screen"
        )


def _hypotheses(arm: F64, seen: F64) -> list[F64]:
    """``T_camera_arm`` of triples that span a triangle, or of all points when none does so."""
    triples = np.array(list(itertools.combinations(range(len(arm)), 3)))
    if len(triples) > _MOST_TRIPLES:
        triples = triples[
            np.random.default_rng(0).choice(len(triples), _MOST_TRIPLES, replace=False)
        ]
    sides = arm[triples[:, 1:]] - arm[triples[:, :1]]
    wide = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) > LEAST_SPREAD_M**2
    return [fit_rigid(seen[triple], arm[triple]) for triple in triples[wide]] + [
        fit_rigid(seen, arm)
    ]
