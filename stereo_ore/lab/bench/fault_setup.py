"""Set-up errors: calibrations, sites and eyes that are not those of the images."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np

from stereo_ore.lab.bench.fault_scenes import Case
from stereo_ore.types import F64, U8, CameraModel, Plane, Site, StereoCalibration

OTHER_ZED_BASELINE = 0.063 / 0.12
"""A ZED Mini's file for a ZED 2."""
WIDTH_RATIO = 2208 / 1920
"""What scaling a focal length by the width makes of 2K for 1080p, which is a crop."""

_Fault = Callable[[Case], Case]


def _images(change: Callable[[U8, U8], tuple[U8, U8]]) -> _Fault:
    def plant(case: Case) -> Case:
        left, right = change(case.frames[-1].left, case.frames[-1].right)
        pair = replace(
            case.frames[-1], left=np.ascontiguousarray(left), right=np.ascontiguousarray(right)
        )
        return replace(case, frames=(pair,))

    return plant


def _calibration(change: Callable[[StereoCalibration], StereoCalibration]) -> _Fault:
    return lambda case: replace(case, calibration=change(case.calibration))


def _scaled_focal(factor: float) -> _Fault:
    def scaled(eye: CameraModel) -> CameraModel:
        return replace(eye, focal_px=(factor * eye.focal_px[0], factor * eye.focal_px[1]))

    return _calibration(lambda c: replace(c, left=scaled(c.left), right=scaled(c.right)))


def _offset(shift_px: float) -> _Fault:
    return _calibration(lambda c: replace(c, disparity_offset_px=c.disparity_offset_px + shift_px))


def _right_column(shift_px: float) -> _Fault:
    """The principal column of one eye is off: all disparities are."""

    def shifted(c: StereoCalibration) -> StereoCalibration:
        u, v = c.right.principal_point_px
        return replace(c, right=replace(c.right, principal_point_px=(u + shift_px, v)))

    return _calibration(shifted)


def _rotation(change: Callable[[F64], F64]) -> _Fault:
    def changed(c: StereoCalibration) -> StereoCalibration:
        vector = np.asarray(cv2.Rodrigues(c.R_right_left)[0], np.float64).ravel()
        return replace(c, R_right_left=np.asarray(cv2.Rodrigues(change(vector))[0], np.float64))

    return _calibration(changed)


def _baseline(factor: float) -> _Fault:
    return _calibration(lambda c: replace(c, t_right_left=factor * c.t_right_left))


def _columns(shift_px: float) -> _Fault:
    """The principal columns of both eyes are off."""

    def shifted(eye: CameraModel) -> CameraModel:
        u, v = eye.principal_point_px
        return replace(eye, principal_point_px=(u + shift_px, v))

    return _calibration(lambda c: replace(c, left=shifted(c.left), right=shifted(c.right)))


def _bumped(turn_deg: tuple[float, float, float], raised: float = 0.0) -> _Fault:
    """The camera was turned about its axes, and raised by a share of its height; the site is that
    of the old pose.
    """

    def bump(case: Case) -> Case:
        plane = case.site.plane
        assert plane is not None, "made-up sites know the plane"
        T_old_new = np.eye(4)
        T_old_new[:3, :3] = cv2.Rodrigues(np.radians(turn_deg))[0]
        T_old_new[:3, 3] = -plane.offset * raised * plane.normal
        return replace(case, site=_moved(case.site, T_old_new))

    return bump


def _moved(site: Site, T_old_new: F64) -> Site:
    """The site as it is taken to be in the frame of a camera that has moved since: X_old =
    T_old_new · X_new.
    """
    plane, volume, T, bar = site.plane, site.volume, site.T_arm_camera, site.bar
    if plane is not None:
        offset = plane.offset - float(plane.normal @ T_old_new[:3, 3])
        plane = Plane(T_old_new[:3, :3].T @ plane.normal, offset)
    if volume is not None:
        volume = replace(volume, T_box_camera=volume.T_box_camera @ T_old_new)
    return replace(
        site,
        plane=plane,
        volume=volume,
        T_arm_camera=None if T is None else T @ T_old_new,
        bar=None if bar is None else bar.seen_from(T_old_new),
    )


def _yawed(angle_deg: float) -> _Fault:
    """The right eye turned about its vertical axis: its image is warped by the homography of this
    rotation.
    """

    def yawed(case: Case) -> Case:
        c, pair = case.calibration, case.frames[-1]
        R = np.asarray(cv2.Rodrigues(np.radians([0, angle_deg, 0]))[0], np.float64)
        H = c.right.K @ R @ np.linalg.inv(c.right.K)
        right = cv2.warpPerspective(pair.right, H, c.image_size, borderMode=cv2.BORDER_REPLICATE)
        return replace(case, frames=(replace(pair, right=np.asarray(right, np.uint8)),))

    return yawed


def _slid(along_m: tuple[float, float, float]) -> _Fault:
    """The camera was moved along its axes [m]; the site is that of the old pose."""
    T_old_new = np.eye(4)
    T_old_new[:3, 3] = along_m
    return lambda case: replace(case, site=_moved(case.site, T_old_new))


FAULTS: dict[str, _Fault] = {
    "eyes swapped": _images(lambda left, right: (right, left)),
    "left eye black": _images(lambda left, right: (np.zeros_like(left), right)),
    "right eye black": _images(lambda left, right: (left, np.zeros_like(right))),
    "the same eye twice": _images(lambda left, right: (left, left)),
    "right eye upside down": _images(lambda left, right: (left, right[::-1, ::-1])),
    "right eye 2 rows lower": _images(lambda left, right: (left, np.roll(right, 2, 0))),
    "right eye 6 rows lower": _images(lambda left, right: (left, np.roll(right, 6, 0))),
    "frozen": lambda case: replace(case, frames=(case.frames[-1],) * 2),
    "right column + 1 px": _right_column(1.0),
    "right column − 1 px": _right_column(-1.0),
    "disparity offset + 16 px": _offset(16.0),
    "disparity offset − 16 px": _offset(-16.0),
    "baseline of a ZED Mini": _baseline(OTHER_ZED_BASELINE),
    "baseline + 10 %": _baseline(1.1),
    "baseline − 10 %": _baseline(0.9),
    "baseline in millimetres": _baseline(1000.0),
    "focal length by the width": _scaled_focal(WIDTH_RATIO),
    "focal length by the width, inverse": _scaled_focal(1 / WIDTH_RATIO),
    "camera pitched by 5°": _bumped((5, 0, 0)),
    "camera yawed by 5°": _bumped((0, 5, 0)),
    "camera raised by 10 %": _bumped((0, 0, 0), 0.1),
    "camera lowered by 10 %": _bumped((0, 0, 0), -0.1),
}  # fmt: skip
"""Faults of a scene with rectified images."""

SMALL_FAULTS: dict[str, _Fault] = {
    **{
        f"baseline {100 * b:+.1f} %": _baseline(1 + b)
        for b in (-0.02, -0.01, -0.005, 0.005, 0.01, 0.02)
    },
    **{f"focal length {100 * f:+.0f} %": _scaled_focal(1 + f) for f in (-0.02, 0.02)},
    **{f"disparity offset {d:+.1f} px": _offset(d) for d in (-0.4, 0.2, 0.4)},
    **{f"right column {d:+.1f} px": _right_column(d) for d in (-0.3, 0.3)},
    "both columns +10 px": _columns(10.0),
    **{f"right eye yawed {a:+.2f}°": _yawed(a) for a in (-0.05, -0.02, 0.02, 0.05)},
    **{f"camera {1000 * d:+.0f} mm along z": _slid((0, 0, d)) for d in (-0.02, -0.01, 0.01, 0.02)},
    **{f"camera {1000 * d:+.0f} mm along x": _slid((d, 0, 0)) for d in (0.01, 0.02, 0.05)},
    **{f"camera {a:+.1f}° about x": _bumped((a, 0, 0)) for a in (0.3, 0.5, 1.0)},
    **{f"camera {a:+.1f}° about y": _bumped((0, a, 0)) for a in (-1.0, 0.3, 0.5)},
    **{f"camera {a:+.1f}° about z": _bumped((0, 0, a)) for a in (0.5, 2.0)},
}
"""Errors of set-up of about the size at which a strike begins to be wrong."""

RAW_FAULTS: dict[str, _Fault] = {
    "rotation ignored": _rotation(lambda v: 0 * v),
    "rotation transposed": _rotation(lambda v: -v),
    "convergence (CV) off by 0.4°": _rotation(lambda v: v + np.radians([0, 0.4, 0])),
    "lenses exchanged": _calibration(lambda c: replace(c, left=c.right, right=c.left)),
    "taken for rectified": _calibration(
        lambda c: replace(
            c,
            images="rectified",
            R_right_left=np.eye(3),
            left=replace(c.left, distortion=()),
            right=replace(c.left, distortion=()),
        )
    ),
}
"""Misreadings of the calibration of raw images."""
