"""Rectification: raw or rectified images of a calibrated rig → a row-aligned pair and its
geometry.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from stereo_ore.errors import CalibrationError, FrameError
from stereo_ore.types import (
    F32,
    F64,
    U8,
    CameraModel,
    RectifiedPair,
    Rig,
    StereoCalibration,
    StereoPair,
)

Maps = tuple[F32, F32]

WIDEST_VIEW = np.radians(120)
"""Of a plane onto which a lens of 150° and more is rectified; its pixels near the edge are four
times the middle's."""

ROW_TOLERANCE_PX = 0.5
"""Largest row difference between the eyes of images said to be rectified."""


@dataclass(frozen=True)
class Rectifier:
    """Geometry after rectification, and the maps that lead there: (x, y) of the source for each
    pixel, each (H, W).

    `left` and `right` are None when the images are rectified already.
    """

    rig: Rig
    left: Maps | None = None
    right: Maps | None = None


def make_rectifier(calibration: StereoCalibration) -> Rectifier:
    """How to rectify the images of a rig; made once a run.

    Parameters
    ----------
    calibration : StereoCalibration
        Of raw or of rectified images.

    Returns
    -------
    Rectifier
        For raw images as ``cv2.stereoRectify(…, flags=CALIB_ZERO_DISPARITY, alpha=0)`` at the same
        size does it; for rectified images the geometry alone, where different principal points make
        ``doffs``.

    Raises
    ------
    CalibrationError
        When "rectified" contradicts the geometry, or the eyes are not side by side with the left
        one on the left.
    """
    if calibration.images == "rectified":
        return Rectifier(_rig_as_given(calibration))
    R1, R2, P1, P2 = rectification(calibration)
    left = _maps(calibration.left, R1, P1, calibration.image_size)
    right = _maps(calibration.right, R2, P2, calibration.image_size)
    return Rectifier(_rig_from_projections(calibration, P1, P2), left, right)


def rectify(pair: StereoPair, rectifier: Rectifier) -> RectifiedPair:
    """The pair with aligned rows.

    Raises
    ------
    FrameError
        When the images are not of the size that the calibration is for.
    """
    rig = rectifier.rig
    height, width = pair.left.shape[:2]
    if (height, width) != (rig.height, rig.width):
        raise FrameError(
            f"images are {width}×{height} px, the calibration is for {rig.width}×{rig.height} px",
            code="SIZE_MISMATCH",
            key="image_size",
            remedy="Use the calibration of the recorded resolution",
        )
    return RectifiedPair(
        _remap(pair.left, rectifier.left), _remap(pair.right, rectifier.right), rig
    )


def _remap(image: U8, maps: Maps | None) -> U8:
    if maps is None:
        return image
    return np.asarray(cv2.remap(image, *maps, cv2.INTER_CUBIC), np.uint8)


def _rig_as_given(calibration: StereoCalibration) -> Rig:
    """Geometry of rectified images; checks that it is one."""
    left, right, t = calibration.left, calibration.right, calibration.t_right_left
    (fx, fy), (cx, cy) = left.focal_px, left.principal_point_px
    width, height = calibration.image_size
    tilt = float(np.abs(calibration.R_right_left - np.eye(3)).max()) * fx
    row = abs(right.principal_point_px[1] - cy) + abs(right.focal_px[1] / fy - 1) * height / 2
    focal = abs(right.focal_px[0] / fx - 1) * width / 2
    shift = float(np.abs(t[1:]).max() / max(abs(t[0]), 1e-9)) * fx * 0.05
    if (
        max(tilt, row, focal, shift) > ROW_TOLERANCE_PX
        or any(left.distortion)
        or any(right.distortion)
    ):
        raise CalibrationError(
            "images said to be rectified, but the eyes are turned, shifted, distorted or of"
            " different focal length",
            key="images",
            remedy='Set "images: raw", or give the calibration of the rectified images',
        )
    _check_baseline(-float(t[0]))
    doffs = right.principal_point_px[0] - cx
    return Rig(width, height, fx, fy, cx, cy, -float(t[0]), doffs, calibration.disparity_offset_px)


def rectification(calibration: StereoCalibration) -> tuple[F64, F64, F64, F64]:
    """R1, R2, P1, P2 of ``cv2.stereoRectify``, zero disparity at infinity, only valid pixels."""
    left, right = calibration.left, calibration.right
    # OpenCV 5 refuses a translation of shape (3,).
    t = calibration.t_right_left.reshape(3, 1).astype(float)
    R = calibration.R_right_left.astype(float)
    size = calibration.image_size
    if "equidistant" in (left.projection, right.projection):
        if left.projection != right.projection:
            raise CalibrationError("the eyes have different projections", key="left.projection")
        R1, R2, P1, P2, _ = cv2.fisheye.stereoRectify(
            left.K,
            _fisheye(left),
            right.K,
            _fisheye(right),
            size,
            R,
            t,
            flags=cv2.CALIB_ZERO_DISPARITY,
            balance=0.0,
        )
        if not _sees(np.asarray(P1), calibration, 1 / 4, 1 / 4):
            P1, P2 = _widest_plane(calibration, np.asarray(R2, float) @ t)
        return _float64(R1, R2, P1, P2)
    R1, R2, P1, P2, *_ = cv2.stereoRectify(
        left.K,
        _pinhole(left),
        right.K,
        _pinhole(right),
        size,
        R,
        t,
        flags=cv2.CALIB_ZERO_DISPARITY,
        alpha=0,
    )
    if not _sees(np.asarray(P1), calibration, 1 / 2, 1 / 10):
        raise CalibrationError(
            f"the rectified camera sees nothing: f {P1[0, 0]:.4g} px, centre {P1[0, 2]:.4g},"
            f" {P1[1, 2]:.4g} px",
            key="left.distortion",
            remedy=(
                "Is the lens a fisheye (projection: equidistant), or the model fitted to the middle"
                " only?"
            ),
        )
    return _float64(R1, R2, P1, P2)


def _sees(P1: F64, calibration: StereoCalibration, off_centre: float, least_focal: float) -> bool:
    """Whether the rectified left camera has its centre near the image's and a useful focal length.

    `off_centre` is a share of the image's sides, `least_focal` of the lens's focal length.
    """
    size = np.array(calibration.image_size, float)
    away = np.abs(P1[:2, 2] - size / 2) / size
    focal = float(P1[0, 0]) / min(*calibration.left.focal_px, *calibration.right.focal_px)
    return bool(np.isfinite(P1).all() and away.max() < off_centre and focal > least_focal)


def _widest_plane(calibration: StereoCalibration, t_right_left: F64) -> tuple[F64, F64]:
    """Projections onto a plane of `WIDEST_VIEW` along the image's longer side, the centre in its
    middle.

    For lenses that see so much that no plane shows it: OpenCV's choice puts the centre far outside
    the image then.
    """
    width, height = calibration.image_size
    focal = max(width, height) / 2 / np.tan(WIDEST_VIEW / 2)
    corner = np.arctan(np.hypot(width, height) / 2 / focal)
    for eye in (calibration.left, calibration.right):
        if (limit := _turns_back(eye)) < corner:
            raise CalibrationError(
                f"a lens whose model holds to {np.degrees(2 * limit):.0f}° only can't be shown on a"
                f" plane of {np.degrees(2 * corner):.0f}° from corner to corner",
                key="distortion",
                remedy="Calibrate again with the board also near the edges of the image",
            )
    P1 = np.array([[focal, 0, (width - 1) / 2, 0], [0, focal, (height - 1) / 2, 0], [0, 0, 1, 0]])
    P2 = P1.copy()
    P2[0, 3] = focal * float(t_right_left.ravel()[0])
    return P1, P2


def _turns_back(eye: CameraModel) -> float:
    """The angle [rad] from which on the Kannala-Brandt radius θ + k1 θ³ + k2 θ⁵ + … falls again."""
    angle = np.linspace(0, np.pi / 2, 500)
    powers = np.arange(1, 5)
    slope = 1 + (
        np.array(eye.distortion or (0.0,) * 4) * (2 * powers + 1) * angle[:, None] ** (2 * powers)
    ).sum(1)
    falls = np.flatnonzero(slope <= 0)
    return float(angle[falls[0]]) if len(falls) else float(np.pi)


def _float64(R1: Any, R2: Any, P1: Any, P2: Any) -> tuple[F64, F64, F64, F64]:
    return (
        np.asarray(R1, float),
        np.asarray(R2, float),
        np.asarray(P1, float),
        np.asarray(P2, float),
    )


def _rig_from_projections(calibration: StereoCalibration, P1: F64, P2: F64) -> Rig:
    width, height = calibration.image_size
    if abs(P2[1, 3]) > abs(P2[0, 3]):
        raise CalibrationError(
            "the eyes are one above the other",
            key="right_from_left.translation_m",
            remedy="Turn the rig by 90°",
        )
    baseline = -float(P2[0, 3] / P2[0, 0])
    _check_baseline(baseline)
    fx, fy, cx, cy = (float(value) for value in (P1[0, 0], P1[1, 1], P1[0, 2], P1[1, 2]))
    doffs = float(P2[0, 2] - P1[0, 2])
    return Rig(width, height, fx, fy, cx, cy, baseline, doffs, calibration.disparity_offset_px)


def _check_baseline(baseline_m: float) -> None:
    if baseline_m <= 0:
        raise CalibrationError(
            f"the right eye is {-baseline_m:.4g} m to the left of the left one",
            key="right_from_left.translation_m",
            remedy="X_right = R X_left + t has t[0] < 0; check the sign, or swap the eyes",
        )


def _maps(camera: CameraModel, R: F64, P: F64, size: tuple[int, int]) -> Maps:
    if camera.projection == "equidistant":
        maps = cv2.fisheye.initUndistortRectifyMap(
            camera.K, _fisheye(camera), R, P, size, cv2.CV_32FC1
        )
    else:
        maps = cv2.initUndistortRectifyMap(camera.K, _pinhole(camera), R, P, size, cv2.CV_32FC1)
    return np.asarray(maps[0], np.float32), np.asarray(maps[1], np.float32)


def _pinhole(camera: CameraModel) -> F64:
    return np.array(camera.distortion or (0.0,) * 5, float)


def _fisheye(camera: CameraModel) -> F64:
    return np.array(camera.distortion or (0.0,) * 4, float).reshape(4, 1)
