"""Rigid poses from points: closed form in space, then the least error in both images."""

from __future__ import annotations

import numpy as np

from stereo_ore.io.calibration.geometry import from_vector
from stereo_ore.transforms import nearest_rotation, transform_points
from stereo_ore.types import F64, Rig


def fit_rigid(target: F64, source: F64) -> F64:
    """``T_target_source`` of least squared distance between corresponding points (N, 3); Umeyama
    1991, no scale.
    """
    middle_target, middle_source = target.mean(0), source.mean(0)
    T = np.eye(4)
    T[:3, :3] = nearest_rotation((target - middle_target).T @ (source - middle_source))
    T[:3, 3] = middle_target - T[:3, :3] @ middle_source
    return T


def image_error(T_camera_source: F64, points: F64, left: F64, right: F64, rig: Rig) -> F64:
    """Differences (N, 4) [px] between points as projected into both rectified images and as seen
    there (N, 2).
    """
    seen = transform_points(T_camera_source, points)
    in_left = rig.project(seen)
    shift = rig.fx * rig.baseline_m / seen[:, 2:] - rig.doffs_px - rig.disparity_offset_px
    in_right = in_left - shift * [1.0, 0.0]
    return np.nan_to_num(np.hstack([in_left - left, in_right - right]), nan=1e4)


def refine_pose(T_camera_source: F64, points: F64, left: F64, right: F64, rig: Rig) -> F64:
    """The pose near a first one with the least squared `image_error`."""
    from scipy.optimize import least_squares

    def error(vector: F64) -> F64:
        return image_error(T_camera_source @ from_vector(vector), points, left, right, rig).ravel()

    return T_camera_source @ from_vector(least_squares(error, np.zeros(6), method="lm").x)
