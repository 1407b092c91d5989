"""Single pixels of recorded images: rectified, and triangulated."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from stereo_ore.stages.rectify import make_rectifier, rectification
from stereo_ore.types import F64, CameraModel, StereoCalibration

POLISH = 20
"""Steps of the fixed-point iteration that takes the distortion out."""


def rectify_points(
    calibration: StereoCalibration, left: npt.ArrayLike, right: npt.ArrayLike
) -> tuple[F64, F64]:
    """Recorded pixels (N, 2) of both eyes where rectification puts them."""
    left, right = (np.array(px, np.float64).reshape(-1, 2) for px in (left, right))
    if calibration.images == "rectified":
        return left, right
    R1, R2, P1, P2 = rectification(calibration)
    return _undistort(left, calibration.left, R1, P1), _undistort(right, calibration.right, R2, P2)


def _undistort(px: F64, eye: CameraModel, R: F64, P: F64) -> F64:
    D = np.array(eye.distortion or (0.0,) * 4)
    focal, zero = np.array(eye.focal_px), np.zeros(3)
    fisheye = eye.projection == "equidistant"
    start = (
        cv2.fisheye.undistortPoints(px[:, None], eye.K, D)
        if fisheye
        else cv2.undistortPoints(px[:, None], eye.K, D)
    )
    rays = np.asarray(start, np.float64).reshape(-1, 2)
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    for _ in range(POLISH):  # OpenCV 4 stops after five steps, whatever is left
        flat = np.column_stack([rays, np.ones(len(rays))])[:, None]
        rays = rays + (px - project(flat, zero, zero, eye.K, D)[0].reshape(-1, 2)) / focal
    turned = np.column_stack([rays, np.ones(len(rays))]) @ R.T @ P[:, :3].T
    return np.asarray(turned[:, :2] / turned[:, 2:], np.float64)


def triangulate(calibration: StereoCalibration, left: npt.ArrayLike, right: npt.ArrayLike) -> F64:
    """Points (N, 3) [m] in the rectified left frame from corresponding recorded pixels (N, 2).

    Depth from the disparity with the calibration's own correction; the row is the mean of both
    eyes. NaN where the disparity stands for no depth.
    """
    rig = make_rectifier(calibration).rig
    px_left, px_right = rectify_points(calibration, left, right)
    disparity = px_left[:, 0] - px_right[:, 0] + rig.disparity_offset_px
    rows = (px_left[:, 1] + px_right[:, 1]) / 2
    return rig.back_project(px_left[:, 0], rows, rig.depth(disparity))
