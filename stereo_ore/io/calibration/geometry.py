"""What every calibration must fulfil, whatever file it came from."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt

from stereo_ore.errors import CalibrationError
from stereo_ore.transforms import rotation_fault
from stereo_ore.types import F64, CameraModel, StereoCalibration

Images = Literal["rectified", "raw"]

LONGEST_BASELINE_M = 2.0
SHORTEST_BASELINE_M = 0.005
"""Eyes closer than this measure nothing on a screen: such a number is a baseline in another
unit."""

WIDEST_TURN_RAD = 1.0
OFF_CENTRE, SAME_FACTOR = 0.18, 0.04
"""A principal point off the middle by more than this share, on both axes alike, is that of another
image size."""

COEFFICIENTS = {"pinhole": (0, 4, 5, 8, 12, 14), "equidistant": (4,)}
"""Numbers of distortion coefficients that a projection can have, in OpenCV's order."""

UNITS_M = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "inch": 0.0254, "ft": 0.3048}
LARGEST_SIDE_PX = 2**15 - 1
"""OpenCV's remap counts pixels in 16 bits."""

_COMMON_SIZES = np.array([
    (320, 180), (320, 240), (640, 360), (640, 480), (672, 376), (752, 480), (848, 480), (848, 800),
    (960, 540),
    (960, 600), (1024, 768), (1280, 720), (1280, 800), (1280, 960), (1280, 1024), (1600, 1200),
    (1920, 1080),
    (1920, 1200), (2048, 1536), (2208, 1242), (2560, 1440), (3840, 2160),
], float)  # fmt: skip

ROTATION_DECIMALS = 12
"""Rotation vectors are kept to 1e-12 rad, so that a calibration written and read again is the same
to the last bit."""


def make_calibration(
    file: str | Path,
    *,
    image_size: Sequence[int],
    left: CameraModel,
    right: CameraModel,
    rotation: npt.ArrayLike = (0.0, 0.0, 0.0),
    translation_m: npt.ArrayLike,
    images: Images,
    disparity_offset_px: float = 0.0,
    camera: str = "",
) -> StereoCalibration:
    """A calibration whose geometry is possible.

    Parameters
    ----------
    file
        Named in the errors.
    rotation : (3,) or (3, 3) array
        Rotation vector [rad] or matrix that takes left coordinates to right ones.
    translation_m : (3,) array
        X_right = R·X_left + t.

    Raises
    ------
    CalibrationError
        With all faults: focal lengths, principal points, distortion, rotation, baseline.
    """
    R, t = np.asarray(rotation, float), np.asarray(translation_m, float).ravel()
    R = rotation_matrix(R) if R.size == 3 else R
    faults = [*_size_faults(image_size)]
    faults += [*_eye_faults("left", left, image_size), *_eye_faults("right", right, image_size)]
    faults = faults or [*_other_size_faults(left, right, image_size)]
    faults += [*_rotation_faults(R), *_translation_faults(t)]
    if images == "rectified" and not faults:
        faults += _rectified_faults(left, right, R, t)
    if not np.isfinite(disparity_offset_px):
        faults.append("disparity_offset_px is not finite")
    if faults:
        text = faults[0] if len(faults) == 1 else f"{len(faults)} faults:\n  " + "\n  ".join(faults)
        raise CalibrationError(text, file=file)
    size = (int(image_size[0]), int(image_size[1]))
    R = rotation_matrix(rotation_vector(R))
    return StereoCalibration(size, left, right, R, t, images, float(disparity_offset_px), camera)


def rotation_matrix(vector: F64) -> F64:
    """The (3, 3) rotation of a rotation vector [rad] (Rodrigues)."""
    return np.asarray(cv2.Rodrigues(vector.reshape(3, 1))[0], np.float64)


def rotation_vector(R: F64) -> F64:
    """Axis times angle [rad] of a rotation of less than 90°, to `ROTATION_DECIMALS`; exact near
    zero.
    """
    axis = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2
    sine = float(np.linalg.norm(axis))
    angle = np.arctan2(sine, (np.trace(R) - 1) / 2)
    vector = np.round(axis * (angle / sine if sine > 0 else 1.0), ROTATION_DECIMALS)
    return np.asarray(vector + 0.0, np.float64)


def check_image_size(calibration: StereoCalibration, width: int, height: int) -> None:
    """Refuse images of another size than the calibration's; scaling would be a guess (see
    `convert`).

    Raises
    ------
    CalibrationError
        Naming both sizes.
    """
    w, h = calibration.image_size
    if (w, h) != (width, height):
        raise CalibrationError(
            f"the calibration {calibration.camera!r} is for images of {w}×{h} px, these have"
            f" {width}×{height}",
            key="image_size",
            remedy=(
                "Use the calibration of this resolution; for a ZED, `calibrate import --to`"
                " converts one exactly"
            ),
        )


def _size_faults(size: Sequence[int]) -> Iterator[str]:
    if max(size) > LARGEST_SIDE_PX:
        yield (
            f"image_size: {size[0]}×{size[1]} px; more than {LARGEST_SIDE_PX:,} px a side can't be"
            " rectified"
        )


def _eye_faults(name: str, eye: CameraModel, size: Sequence[int]) -> Iterator[str]:
    values = (*eye.focal_px, *eye.principal_point_px, *eye.distortion)
    if not np.isfinite(values).all():
        yield f"{name}: has numbers that are not finite: {[float(v) for v in values]}"
        return
    if min(eye.focal_px) <= 0:
        yield f"{name}.focal_px: must be greater than 0, not {list(eye.focal_px)}"
    if not all(0 < c < n for c, n in zip(eye.principal_point_px, size, strict=True)):
        yield (
            f"{name}.principal_point_px: {list(eye.principal_point_px)} lies outside images of"
            f" {size[0]}×{size[1]} px; is image_size that of the calibration?"
        )
    allowed = COEFFICIENTS[eye.projection]
    if len(eye.distortion) not in allowed:
        yield (
            f"{name}.distortion: must have {' or '.join(map(str, allowed))} values, not"
            f" {len(eye.distortion)}"
        )


def _other_size_faults(left: CameraModel, right: CameraModel, size: Sequence[int]) -> Iterator[str]:
    """Principal points that lie off the middle of both axes by one factor: the file is for images
    of another size.
    """
    middle = np.array(size, float) / 2
    factors = np.array([eye.principal_point_px for eye in (left, right)]) / middle
    factor = float(factors.mean())
    if (
        abs(np.log(factor)) < np.log1p(OFF_CENTRE)
        or np.abs(factors / factor - 1).max() > SAME_FACTOR
    ):
        return
    likely = min(
        _COMMON_SIZES, key=lambda known: float(np.abs(np.log(known / (2 * middle * factor))).max())
    )
    if np.abs(np.log(likely / (2 * middle * factor))).max() > SAME_FACTOR:
        likely = np.round(2 * middle * factor)
    yield (
        f"principal_point_px: {list(left.principal_point_px)} lies at {50 * factor:.0f} % of width"
        f" and height of images of {size[0]}×{size[1]} px; the calibration was made at about"
        f" {likely[0]:.0f}×{likely[1]:.0f} px. Use the one of this resolution"
    )


def _rotation_faults(R: F64) -> Iterator[str]:
    if R.shape != (3, 3):
        yield f"right_from_left: the rotation must be a 3-vector or a 3×3 matrix, not {R.shape}"
    elif fault := rotation_fault(R):
        yield f"right_from_left: the rotation {fault}"
    elif (turn := float(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1)))) > WIDEST_TURN_RAD:
        yield (
            f"right_from_left: the eyes are turned by {turn:.2f} rad against each other; are these"
            " degrees?"
        )


def _translation_faults(t: F64) -> Iterator[str]:
    key = "right_from_left.translation_m"
    length = float(np.linalg.norm(t))
    if t.shape != (3,) or not np.isfinite(t).all():
        yield f"{key}: must be 3 finite numbers, not {t.tolist()}"
    elif length == 0:
        yield f"{key}: the baseline is zero"
    elif not SHORTEST_BASELINE_M <= length <= LONGEST_BASELINE_M:
        yield f"{key}: a baseline of {length:g} m; {other_units(length)}"
    elif abs(t[0]) < np.hypot(t[1], t[2]):
        yield f"{key}: {t.tolist()} is not along x; the eyes must stand side by side"
    elif t[0] > 0:
        yield (
            f"{key}: x must be negative (X_right = R·X_left + t), not {t[0]:g}; are left and right"
            " swapped?"
        )


def other_units(length: float) -> str:
    """What a length that is none in metres may be: the units in which it would be a likely
    baseline.
    """
    likely = {
        unit: length * UNITS_M[unit]
        for unit in ("dm", "cm", "mm")
        if 0.01 <= length * UNITS_M[unit] <= 1.0
    }
    if length < SHORTEST_BASELINE_M:
        return (
            f"metres given for millimetres? It would be {1000 * length:g} m; write the length in"
            " the format's unit"
        )
    said = " or ".join(f"--unit {unit} ({metres:.4g} m)" for unit, metres in likely.items())
    return (
        f"millimetres given for metres? Say {said or '--unit mm'}, or in squares of a board --unit"
        " 25mm"
    )


def _rectified_faults(left: CameraModel, right: CameraModel, R: F64, t: F64) -> Iterator[str]:
    """Rectified images have one focal length and one row for both eyes, no distortion and no
    rotation.
    """
    said = "images are said to be rectified, but"
    remedy = "; if the recorded images are not rectified, say images: raw"
    if any(left.distortion) or any(right.distortion):
        yield f"{said} the lenses have distortion{remedy}"
    if not np.allclose(R, np.eye(3), atol=1e-4) or np.abs(t[1:]).max() > 1e-3 * abs(t[0]):
        yield f"{said} right_from_left is more than a shift along x{remedy}"
    if not np.allclose(left.focal_px, right.focal_px, rtol=1e-3):
        yield f"{said} the focal lengths of the eyes differ{remedy}"
    if abs(left.principal_point_px[1] - right.principal_point_px[1]) > 0.1:
        yield f"{said} the principal points lie in different rows{remedy}"


def from_vector(vector: F64) -> F64:
    """The transform of a rotation vector [rad] and a translation, (6,)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_matrix(vector[:3]), vector[3:]
    return T


def to_vector(T: F64) -> F64:
    """Rotation vector [rad] and translation, (6,)."""
    return np.concatenate([np.asarray(cv2.Rodrigues(T[:3, :3])[0], np.float64).ravel(), T[:3, 3]])
