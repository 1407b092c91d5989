"""The two eyes: a ZED 2 with perfect lenses, or one with distortion and misalignment."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from stereo_ore.lab.synth.eye import Eye
from stereo_ore.lab.synth.spec import BASELINE_M, SIZES, SceneSpec
from stereo_ore.transforms import inverse
from stereo_ore.types import F64, CameraModel, StereoCalibration

DISTORTION_LEFT = (-0.0441, 0.0108, -0.0004, 0.0003, -0.0021)
DISTORTION_RIGHT = (-0.0413, 0.0098, 0.0004, -0.0003, -0.0019)
"""k1 k2 p1 p2 k3 as strong as a ZED 2's; k3 is mild enough that the model does not fold in the
corners."""


@dataclass(frozen=True)
class Rectification:
    """Camera matrix (3, 3), fx·B [px m], rotations of the eyes and projection matrices (3, 4) of a
    rectified pair.
    """

    K: F64
    focal_baseline: float
    R1: F64
    R2: F64
    P1: F64
    P2: F64

    @property
    def T_left_rectified(self) -> F64:  # noqa: N802 - frames are named as everywhere
        """Pose of the rectified in the recorded left camera."""
        T = np.eye(4)
        T[:3, :3] = self.R1.T
        return T


def ideal_rig(spec: SceneSpec) -> StereoCalibration:
    """Two equal, aligned eyes with the small offsets of a real unit's focal length and principal
    point.
    """
    width, height, f = SIZES[spec.size]
    eye = CameraModel((f * 0.99925, f * 0.99868), (width / 2 + 2.3, height / 2 + 1.7))
    t = np.array([-BASELINE_M, 0.0, 0.0])
    return StereoCalibration(
        (width, height), eye, eye, np.eye(3), t, "rectified", camera=f"synthetic ZED2 {spec.size}"
    )


def raw_rig(spec: SceneSpec) -> StereoCalibration:
    """Two distorted eyes turned by up to half a degree against each other."""
    rng = np.random.default_rng([spec.seed, 30])
    width, height, f = SIZES[spec.size]

    def eye(distortion: tuple[float, ...]) -> CameraModel:
        centre = np.array([width, height]) / 2 + rng.normal(0, 0.005 * width, 2)
        focal = f * (1 + rng.normal(0, 0.002)) * np.array([1.0, 0.9995])
        scaled = np.array(distortion) * rng.uniform(0.7, 1.0)
        return CameraModel(_pair(focal), _pair(centre), tuple(float(k) for k in scaled))

    left, right = eye(DISTORTION_LEFT), eye(DISTORTION_RIGHT)
    R = np.asarray(cv2.Rodrigues(rng.normal(0, 0.005, 3))[0], np.float64)
    t = np.array([-BASELINE_M * (1 + rng.normal(0, 0.001)), *rng.normal(0, 0.0006, 2)])
    return StereoCalibration(
        (width, height), left, right, R, t, "raw", camera=f"synthetic raw ZED2 {spec.size}"
    )


def _pair(values: F64) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def reference_rectification(calibration: StereoCalibration) -> Rectification:
    """cv2.stereoRectify (CALIB_ZERO_DISPARITY, alpha 0) of raw eyes; the identity for rectified
    ones.
    """
    K, t = calibration.left.K, calibration.t_right_left.reshape(3, 1)
    if calibration.images == "rectified":
        P1, P2 = np.hstack([K, np.zeros((3, 1))]), np.hstack([K, K @ t])
        return Rectification(K, -float(P2[0, 3]), np.eye(3), np.eye(3), P1, P2)
    lenses = (
        K,
        np.array(calibration.left.distortion),
        calibration.right.K,
        np.array(calibration.right.distortion),
    )
    found = cv2.stereoRectify(
        *lenses,
        calibration.image_size,
        calibration.R_right_left,
        t,
        flags=cv2.CALIB_ZERO_DISPARITY,
        alpha=0,
    )
    R1, R2, P1, P2 = (np.asarray(matrix, np.float64) for matrix in found[:4])
    return Rectification(P1[:, :3], -float(P2[0, 3]), R1, R2, P1, P2)


def eyes(
    calibration: StereoCalibration, rectified: Rectification, T_screen_left: F64
) -> tuple[Eye, Eye, Eye]:
    """The recorded left and right eye and the rectified left view, in the screen frame."""
    T_right_left = np.eye(4)
    T_right_left[:3, :3], T_right_left[:3, 3] = calibration.R_right_left, calibration.t_right_left
    size = calibration.image_size
    left = Eye(calibration.left, size, T_screen_left)
    right = Eye(calibration.right, size, T_screen_left @ inverse(T_right_left))
    K = rectified.K
    straight = CameraModel((float(K[0, 0]), float(K[1, 1])), (float(K[0, 2]), float(K[1, 2])))
    return left, right, Eye(straight, size, T_screen_left @ rectified.T_left_rectified)
