"""Is this calibration right for this pair? Numbers, findings and a verdict from the user's own
images.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np

from stereo_ore.calibrate.points import rectify_points
from stereo_ore.calibrate.residual import LIMIT_PX, RowResidual, match_features, residual_of_matches
from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration.geometry import check_image_size
from stereo_ore.stages.rectify import make_rectifier, rectify
from stereo_ore.types import F64, U8, RectifiedPair, Rig, StereoCalibration, StereoPair

Matches = tuple[F64, F64]
"""Recorded pixels (N, 2) of the left and the right eye."""

_Verdict = Literal["good", "suspect", "wrong", "unclear"]

CONVERGENCE_LIMIT_PX = 1.5
CONVERGENCE_SIGMAS = 10.0
"""A turn about the vertical axis counts when it moves disparities by this much and is this
certain."""

NEGATIVE_SHARE = 0.02
_LEAST_PX = 0.5
"""A scene whose median disparity is smaller shows no depth."""
OFFSET_SHARE = 0.01
"""Known distances are trusted to this share."""

_PATCH = 15
_LEAST_SCORE = 0.7
_LEAST_LEAD = 0.05
"""How much better than any other place of the row the match of a patch must be; bars repeat."""


@dataclass(frozen=True)
class KnownPoint:
    """A point whose straight distance [m] from the left eye was measured: its pixel in the recorded
    left image.
    """

    u: float
    v: float
    distance_m: float


@dataclass(frozen=True)
class Measured:
    """What the images say about a `KnownPoint`: disparities [px] and distances [m], measured and as
    it should be.
    """

    known: KnownPoint
    disparity_px: float
    expected_px: float
    distance_m: float

    @property
    def offset_px(self) -> float:
        """What would have to be added to the measured disparity."""
        return self.expected_px - self.disparity_px


@dataclass(frozen=True)
class _Finding:
    """Something that is wrong or may be, with its code, and what to do."""

    code: str
    severity: Literal["wrong", "suspect", "unclear"]
    text: str


@dataclass(frozen=True)
class CheckResult:
    """The residual of the rows, what was found, and the known distances as measured."""

    residual: RowResidual
    findings: tuple[_Finding, ...]
    measured: tuple[Measured, ...]
    rig: Rig

    @property
    def verdict(self) -> _Verdict:
        """The gravest finding."""
        severities = [finding.severity for finding in self.findings]
        return min(severities, key=("unclear", "wrong", "suspect").index, default="good")


def check_pair(
    pair: StereoPair, calibration: StereoCalibration, known: Sequence[KnownPoint] = ()
) -> CheckResult:
    """Judge a calibration by a recorded pair.

    Parameters
    ----------
    pair
        As recorded; a still scene with texture over the whole image.
    calibration
        To be judged.
    known
        Points at measured distances, for a constant offset of the disparity.

    Raises
    ------
    CalibrationError
        When the images have another size, or a known point is on no texture.
    """
    height, width = pair.left.shape[:2]
    check_image_size(calibration, width, height)
    result = check_matches(match_features(_grey(pair.left), _grey(pair.right)), calibration)
    rectified = rectify(pair, make_rectifier(calibration))
    measured = tuple(_measure(point, rectified, calibration) for point in known)
    return replace(
        result, findings=(*result.findings, *offset_findings(measured)), measured=measured
    )


def check_matches(matches: Matches, calibration: StereoCalibration) -> CheckResult:
    """Judge a calibration by matched features of the recorded images."""
    residual, rig = _residual(matches, calibration), make_rectifier(calibration).rig
    return CheckResult(residual, tuple(_row_findings(residual, matches, calibration, rig)), (), rig)


def _grey(image: U8) -> U8:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)


def _residual(matches: Matches, calibration: StereoCalibration) -> RowResidual:
    """Row differences of recorded matches, were `calibration` right; cheap enough to try many."""
    return residual_of_matches(
        *rectify_points(calibration, *matches), make_rectifier(calibration).rig
    )


def _row_findings(
    residual: RowResidual, matches: Matches, calibration: StereoCalibration, rig: Rig
) -> Iterator[_Finding]:
    if not residual.enough:
        text = (
            f"only {residual.matched} features match; take a pair of a still scene with light and"
            " texture"
        )
        yield _Finding("FEW_MATCHES", "unclear", text)
        return
    swapped = residual.negative_share > 0.5
    if swapped and residual.aligned:
        yield _Finding(
            "SWAPPED_EYES", "wrong", "the scene lies behind the camera: left and right are swapped"
        )
    if not residual.aligned:
        text = f"rows differ by {residual.systematic_px:.2f} px, allowed are {LIMIT_PX} px"
        yield _Finding("ROWS", "wrong", text)
        yield from _diagnose(matches, calibration)
    if abs(residual.disparity_px[1] + rig.doffs_px) < _LEAST_PX:
        yield _Finding(
            "NO_DEPTH",
            "wrong",
            "most of the scene lies at infinity: are both pictures those of one eye?",
        )
    if not swapped and residual.negative_share > NEGATIVE_SHARE:
        text = (
            f"{residual.negative_share:.0%} of the matches lie behind the camera; is there a"
            " disparity offset?"
        )
        yield _Finding("NEGATIVE_DISPARITIES", "suspect", text)
    turn, sigma = (
        float(array[1]) * rig.fx for array in (residual.rotation_rad, residual.rotation_sigma_rad)
    )
    if abs(turn) > max(CONVERGENCE_LIMIT_PX, CONVERGENCE_SIGMAS * sigma):
        text = (
            f"the eyes converge differently: disparities are off by {-turn:+.1f} ± {sigma:.1f} px,"
            " more at the sides"
        )
        yield _Finding("CONVERGENCE", "wrong", text)


def _diagnose(matches: Matches, calibration: StereoCalibration) -> Iterator[_Finding]:
    """Which simple mistake, undone, makes the rows agree."""
    if calibration.images == "rectified":
        text = (
            "the images are not rectified as this file says: use the raw calibration with"
            " images: raw"
        )
        yield _Finding("MISSING_RECTIFICATION", "suspect", text)
        return
    exchanged = matches[1], matches[0]
    inverted = replace(calibration, R_right_left=calibration.R_right_left.T)
    trials = (
        (
            "DOUBLE_RECTIFICATION",
            matches,
            _as_rectified(calibration),
            "the images are rectified already",
        ),
        ("SWAPPED_EYES", exchanged, calibration, "the rows agree with left and right exchanged"),
        ("INVERTED_ROTATION", matches, inverted, "the rows agree with the inverse of the rotation"),
    )
    for code, pixels, trial, text in trials:
        if (residual := _residual(pixels, trial)).aligned and residual.negative_share < 0.5:
            yield _Finding(code, "wrong", text)


def _as_rectified(calibration: StereoCalibration) -> StereoCalibration:
    """The same rig, were its images rectified already."""
    rig = make_rectifier(calibration).rig
    eye = replace(
        calibration.left,
        focal_px=(rig.fx, rig.fy),
        principal_point_px=(rig.cx, rig.cy),
        distortion=(),
        projection="pinhole",
    )
    shift = np.array([-rig.baseline_m, 0.0, 0.0])
    return replace(
        calibration,
        left=eye,
        right=eye,
        R_right_left=np.eye(3),
        t_right_left=shift,
        images="rectified",
    )


def _measure(known: KnownPoint, pair: RectifiedPair, calibration: StereoCalibration) -> Measured:
    rig = pair.rig
    at = rectify_points(calibration, [[known.u, known.v]], [[known.u, known.v]])[0][0]
    ray = np.array([(at[0] - rig.cx) / rig.fx, (at[1] - rig.cy) / rig.fy, 1.0])
    expected = float(rig.disparity(known.distance_m / np.linalg.norm(ray)))
    found = patch_disparity(_grey(pair.left), _grey(pair.right), at)
    if found is None:
        problem = (
            f"the surroundings of pixel {known.u:g}, {known.v:g} match nothing, or several places,"
            " in the right image"
        )
        raise CalibrationError(
            problem, key="--known", remedy="Take a point on a textured surface that both eyes see"
        )
    disparity = found + rig.disparity_offset_px
    return Measured(known, disparity, expected, float(rig.depth(disparity) * np.linalg.norm(ray)))


def patch_disparity(left: U8, right: U8, at: F64, rows: int = 2) -> float | None:
    """Disparity [px] of the patch around pixel (u, v) of the left image, found along the row; None
    where nothing fits.

    Normalised cross-correlation, a parabola through the best column.
    """
    u, v = (round(float(c)) for c in at)
    height, width = left.shape
    if not (_PATCH <= u < width - _PATCH and _PATCH + rows <= v < height - _PATCH - rows):
        return None
    patch = left[v - _PATCH : v + _PATCH + 1, u - _PATCH : u + _PATCH + 1]
    if float(patch.std()) < 2:
        return None
    band = right[v - _PATCH - rows : v + _PATCH + rows + 1]
    scores = np.asarray(cv2.matchTemplate(band, patch, cv2.TM_CCOEFF_NORMED), np.float64).max(0)
    best = int(np.argmax(scores))
    others = np.delete(scores, range(max(best - 4, 0), min(best + 5, len(scores))))
    if (
        scores[best] < max(_LEAST_SCORE, others.max() + _LEAST_LEAD)
        or not 0 < best < len(scores) - 1
    ):
        return None
    below, peak, above = scores[best - 1 : best + 2]
    curvature = below - 2 * peak + above
    step = 0.5 * (below - above) / curvature if curvature < 0 else 0.0
    return u - _PATCH - (best + step)


def offset_findings(measured: Sequence[Measured]) -> Iterator[_Finding]:
    """A constant offset of the disparities or, where the distances differ enough, a wrong scale."""
    if not measured:
        return
    offset = float(np.median([point.offset_px for point in measured]))
    limit = max(LIMIT_PX, OFFSET_SHARE * max(point.expected_px for point in measured))
    if abs(offset) <= limit:
        return
    text = f"disparities are off by {-offset:+.2f} px at the known distances"
    if len(measured) == 1:
        remedy = (
            f"add {offset:+.2f} to disparity_offset_px, or, if other distances disagree, mend"
            " baseline or focal length"
        )
        yield _Finding("DISPARITY_OFFSET", "wrong", f"{text}; {remedy}")
        return
    scale, constant = _line(measured)
    if np.isfinite(scale) and abs(scale - 1) > 2 * OFFSET_SHARE:
        text += f"; they are {scale:.3f} times the right ones and {constant:+.2f} px"
        yield _Finding("DISPARITY_SCALE", "wrong", f"{text}: mend focal length or baseline first")
    else:
        yield _Finding(
            "DISPARITY_OFFSET", "wrong", f"{text}; add {offset:+.2f} to disparity_offset_px"
        )


def _line(measured: Sequence[Measured]) -> tuple[float, float]:
    """Scale and constant of measured over expected disparities; NaN when the distances are too
    alike.
    """
    expected = np.array([point.expected_px for point in measured])
    if np.ptp(expected) < 0.2 * expected.max():
        return float("nan"), float("nan")
    scale, constant = np.polyfit(expected, [point.disparity_px for point in measured], 1)
    return float(scale), float(constant)
