"""A raw ZED calibration of one resolution brought to another by the sensor's exact cropping and
binning.
"""

from __future__ import annotations

from dataclasses import replace

from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration.zed import ZED_SIZES
from stereo_ore.types import CameraModel, StereoCalibration

BINNING = {
    "2K": (1, 0.0, 0.0),
    "FHD": (1, -144.0, -81.0),
    "HD": (2, 173.0, 96.0),
    "VGA": (4, 235.0, 126.0),
}
"""n, dx, dy of each mode: f = f_2K / n, cx = (cx_2K + dx) / n, cy = (cy_2K + dy) / n; read off
factory files."""


def convert_zed(calibration: StereoCalibration, image_size: tuple[int, int]) -> StereoCalibration:
    """The same ZED at another resolution.

    Parameters
    ----------
    calibration
        Of raw images in one of the modes of `BINNING`.
    image_size
        Width and height [px] of one eye in the wanted mode.

    Raises
    ------
    CalibrationError
        When either size is none of these modes, or the images are rectified: the ZED SDK rectifies
        each mode with a camera of its own, which no rule gives.
    """
    source, target = _mode(calibration.image_size), _mode(image_size)
    if calibration.images == "rectified":
        raise CalibrationError(
            "the calibration of rectified images can't be converted to another resolution",
            key="images",
            remedy=(
                "Convert the factory file (SN*.conf) of the raw images, or ask the SDK for this"
                " resolution"
            ),
        )
    scale = BINNING[source][0] / BINNING[target][0]
    return replace(
        calibration,
        image_size=ZED_SIZES[target],
        left=_convert(calibration.left, source, target),
        right=_convert(calibration.right, source, target),
        disparity_offset_px=calibration.disparity_offset_px * scale,
        camera=f"{calibration.camera} as {target}",
    )


def _mode(image_size: tuple[int, int]) -> str:
    for mode in BINNING:
        if ZED_SIZES[mode] == tuple(image_size):
            return mode
    sizes = ", ".join(f"{w}×{h}" for w, h in (ZED_SIZES[mode] for mode in BINNING))
    problem = (
        f"{image_size[0]}×{image_size[1]} is not a resolution of the ZED with a known rule"
        f" ({sizes})"
    )
    raise CalibrationError(problem, key="image_size")


def _convert(eye: CameraModel, source: str, target: str) -> CameraModel:
    (n, *shift), (m, *new_shift) = BINNING[source], BINNING[target]
    fx, fy = (f * n / m for f in eye.focal_px)
    centre = zip(eye.principal_point_px, shift, new_shift, strict=True)
    cx, cy = ((c * n - d + e) / m for c, d, e in centre)
    return replace(eye, focal_px=(fx, fy), principal_point_px=(cx, cy))
