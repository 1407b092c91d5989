"""Calibrations: read from any known format, recognised by content; written as native YAML."""

from __future__ import annotations

from pathlib import Path

from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration import (
    basalt,
    calibrating,
    camera_array,
    colmap,
    depthai,
    euroc,
    kalibr,
    kitti,
    matlab,
    middlebury,
    mrcal,
    named,
    native,
    opencv,
    orbslam,
    pycamcalib,
    ros,
    simplestereo,
    stella,
    vins,
    zed,
)
from stereo_ore.io.calibration.formats import Format, Hints, Projection, read_file
from stereo_ore.io.calibration.geometry import Images, check_image_size
from stereo_ore.io.calibration.native import dump, save
from stereo_ore.types import StereoCalibration

__all__ = ["CALIBRATION_FORMATS", "check_image_size", "dump", "load", "save"]

CALIBRATION_FORMATS: dict[str, Format] = {
    "native": native,
    "zed": zed,
    "orbslam": orbslam,
    "vins": vins,
    "stella": stella,
    "opencv": opencv,
    "ros": ros,
    "kalibr": kalibr,
    "middlebury": middlebury,
    "simplestereo": simplestereo,
    "depthai": depthai,
    "pycamcalib": pycamcalib,
    "mrcal": mrcal,
    "calibrating": calibrating,
    "camera_array": camera_array,
    "colmap": colmap,
    "euroc": euroc,
    "basalt": basalt,
    "kitti": kitti,
    "matlab": matlab,
    "named": named,
}
"""Asked in this order; a new format is a module and a line."""


def load(
    path: str | Path,
    images: Images | None = None,
    image_size: tuple[int, int] | None = None,
    unit_m: float | None = None,
    eyes: tuple[int, int] | None = None,
    projection: Projection | None = None,
    recorded_size: tuple[int, int] | None = None,
) -> StereoCalibration:
    """The stereo calibration in a file of any known format.

    Parameters
    ----------
    path
        The file; of formats that keep a file an eye, either of the two.
    images
        What the recorded images are, where that differs from what the file says or implies.
    image_size
        Width and height [px] of one eye, for formats that hold several or none.
    unit_m
        Length of one unit of a translation, for formats that do not fix it; None: metres, where
        that is likely.
    eyes
        Numbers of the left and the right camera, for chains of more than two.
    projection
        Of the lenses, for files that do not say it.
    recorded_size
        Width and height [px] of the images at hand: picks one of several sizes in a file, never
        stands for a missing one.

    Raises
    ------
    CalibrationError
        When the file can't be read, is in no known format, or describes an impossible camera.
    """
    path = pycamcalib.text_of(Path(path))
    text = read_file(path)
    hints = Hints(images, image_size, unit_m, eyes, projection, recorded_size)
    for reader in CALIBRATION_FORMATS.values():
        if reader.recognises(text):
            return reader.read(path, text, hints)
    raise CalibrationError(
        f"is in no known calibration format ({', '.join(CALIBRATION_FORMATS)})",
        file=path,
        remedy="docs/calibration.md names the files and tools; the native YAML can be typed in",
    )
