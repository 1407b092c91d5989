"""Calibrations: read from any known format, recognised by content; written as native YAML."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from stereo_ore.calibration import native, zed
from stereo_ore.calibration.geometry import Images, check_image_size
from stereo_ore.calibration.native import dump, save
from stereo_ore.errors import CalibrationError
from stereo_ore.types import StereoCalibration
from stereo_ore.yaml_io import read_text

__all__ = ["FORMATS", "check_image_size", "dump", "load", "save"]


class Format(Protocol):
    """What a module of a calibration format offers."""

    def recognises(self, text: str) -> bool:
        """Whether the text of a file is in this format."""

    def read(
        self, path: Path, text: str, images: Images | None, image_size: tuple[int, int] | None
    ) -> StereoCalibration:
        """The calibration in it."""


FORMATS: dict[str, Format] = {"native": native, "zed": zed}
"""Asked in this order."""


def load(
    path: str | Path, images: Images | None = None, image_size: tuple[int, int] | None = None
) -> StereoCalibration:
    """The stereo calibration in a file of any known format.

    Parameters
    ----------
    path
        The file; of formats that keep a file an eye, either of the two.
    images
        What the recorded images are, where that differs from what the file says or implies.
    image_size
        Width and height [px] of one eye; needed for formats that hold several or none.

    Raises
    ------
    CalibrationError
        When the file can't be read, is in no known format, or describes an impossible camera.
    """
    path = Path(path)
    text = read_text(path, CalibrationError)
    for reader in FORMATS.values():
        if reader.recognises(text):
            return reader.read(path, text, images, image_size)
    raise CalibrationError(f"is in no known calibration format ({', '.join(FORMATS)})", file=path)
