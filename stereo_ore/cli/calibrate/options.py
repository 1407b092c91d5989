"""Options that several verbs share, and what they mean."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from stereo_ore.errors import CalibrationError, OutputError

if TYPE_CHECKING:
    from stereo_ore.types import StereoCalibration

UNITS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001}
SIZES = {"HD2K": (2208, 1242), "HD1080": (1920, 1080), "HD720": (1280, 720), "VGA": (672, 376)}

CalibFile = Annotated[Path, typer.Argument(help="Calibration in any known format.")]
Images = Annotated[Literal["rectified", "raw"] | None, typer.Option(help="What the images are, if the file is silent.")]
Size = Annotated[str | None, typer.Option(help="Size of one eye: WxH, HD2K, HD1080, HD720 or VGA.")]
Unit = Annotated[Literal["m", "cm", "mm"], typer.Option(help="Unit of a translation (OpenCV, ROS).")]
Eyes = Annotated[str | None, typer.Option(help="Left and right camera of a longer chain: L,R.")]


def load_any(file: Path, images: Images, size: str | None, unit: str, eyes: str | None) -> StereoCalibration:
    """The calibration in a file of any format, with the options that say what the file does not."""
    from stereo_ore.io.calibration import load

    return load(
        file,
        images=images,
        image_size=None if size is None else parse_size(size),
        unit_m=UNITS_M[unit],
        eyes=None if eyes is None else two_numbers(eyes, ",", "--eyes"),
    )


def parse_size(text: str) -> tuple[int, int]:
    """``1280x720`` or the name of a ZED mode as (width, height)."""
    return SIZES.get(text.upper()) or two_numbers(text.lower().replace("×", "x"), "x", "--size")


def two_numbers(text: str, separator: str, option: str) -> tuple[int, int]:
    """Two whole numbers with a separator between, the value of an option."""
    try:
        first, second = (int(part) for part in text.split(separator))
    except ValueError:
        raise CalibrationError(f"{text!r} is not two whole numbers with {separator!r} between", key=option) from None
    return first, second


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Name the file when it can't be written: its folder is not there, or not ours."""
    try:
        yield
    except OSError as fault:
        raise OutputError(f"can't be written: {fault.strerror or fault}", file=path) from None
