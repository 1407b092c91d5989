"""Options that several verbs share, and what they mean."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from stereo_ore.errors import CalibrationError, OutputError

if TYPE_CHECKING:
    from stereo_ore.types import StereoCalibration

_SIZES = {"HD2K": (2208, 1242), "HD1080": (1920, 1080), "HD720": (1280, 720), "VGA": (672, 376)}

CalibFile = Annotated[Path, typer.Argument(help="Calibration in any known format.")]
ImagesOption = Annotated[
    Literal["rectified", "raw"] | None,
    typer.Option(help="What the images are, if the file is silent."),
]
Size = Annotated[str | None, typer.Option(help="Size of one eye: WxH, HD2K, HD1080, HD720 or VGA.")]
Unit = Annotated[
    str | None,
    typer.Option(
        help=(
            "Unit of a translation that the file does not say: m, dm, cm, mm, inch, or a square:"
            " 25mm."
        )
    ),
]
Lens = Annotated[
    Literal["pinhole", "equidistant"] | None,
    typer.Option(
        "--projection", help="Of lenses whose file does not say it; equidistant: cv2.fisheye."
    ),
]
EyesOption = Annotated[
    str | None, typer.Option(help="Left and right camera of a longer chain: L,R.")
]


def load_any(
    file: Path,
    images: ImagesOption,
    size: str | None,
    unit: str | None,
    eyes: str | None,
    projection: Lens = None,
    recorded_size: tuple[int, int] | None = None,
) -> StereoCalibration:
    """The calibration in a file of any format, with the options that say what the file does not."""
    from stereo_ore.io.calibration import load

    return load(
        file,
        images=images,
        image_size=None if size is None else parse_size(size),
        unit_m=None if unit is None else parse_unit(unit),
        eyes=None if eyes is None else two_numbers(eyes, ",", "--eyes"),
        projection=projection,
        recorded_size=recorded_size,
    )


def parse_unit(text: str) -> float:
    """Metres of ``mm`` or, where the unit is the square of a board, of ``25mm``."""
    from stereo_ore.io.calibration.geometry import UNITS_M

    match = re.fullmatch(r"(\d*\.?\d+|\d+\.)?\s*([a-z]+)", text.strip().lower())
    length = float(match[1] or 1) * UNITS_M.get(match[2], 0.0) if match else 0.0
    if not length:
        remedy = f"Use one of {', '.join(UNITS_M)}, or a length with one of them, as 25mm"
        raise CalibrationError(f"{text!r:.40} is no unit of length", key="--unit", remedy=remedy)
    return length


def parse_size(text: str) -> tuple[int, int]:
    """``1280x720`` or the name of a ZED mode as (width, height)."""
    return _SIZES.get(text.upper()) or two_numbers(text.lower().replace("×", "x"), "x", "--size")


def two_numbers(text: str, separator: str, option: str) -> tuple[int, int]:
    """Two whole numbers with a separator between, the value of an option."""
    try:
        first, second = (int(part) for part in text.split(separator))
    except ValueError:
        raise CalibrationError(
            f"{text!r} is not two whole numbers with {separator!r} between", key=option
        ) from None
    return first, second


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Name the file when it can't be written: its folder is not there, or not ours."""
    try:
        yield
    except OSError as fault:
        raise OutputError(f"can't be written: {fault.strerror or fault}", file=path) from None
