"""``stereo-ore calibrate``: make and judge calibrations and sites."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from stereo_ore.errors import CalibrationError, OutputError, SourceError

if TYPE_CHECKING:
    from stereo_ore.calibration.board import BoardView
    from stereo_ore.calibration.check import Known
    from stereo_ore.calibration.detect import Board
    from stereo_ore.types import StereoCalibration

log = logging.getLogger(__name__)

group = typer.Typer(no_args_is_help=True, help="Make and judge the YAML files of camera and site.")

UNITS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001}
SIZES = {"HD2K": (2208, 1242), "HD1080": (1920, 1080), "HD720": (1280, 720), "VGA": (672, 376)}

CalibFile = Annotated[Path, typer.Argument(help="Calibration in any known format.")]
Images = Annotated[Literal["rectified", "raw"] | None, typer.Option(help="What the images are, if the file is silent.")]
Size = Annotated[str | None, typer.Option(help="Size of one eye: WxH, HD2K, HD1080, HD720 or VGA.")]
Unit = Annotated[Literal["m", "cm", "mm"], typer.Option(help="Unit of a translation (OpenCV, ROS).")]
Eyes = Annotated[str | None, typer.Option(help="Left and right camera of a longer chain: L,R.")]


def register(app: typer.Typer) -> None:
    """Add the verbs to the command line."""
    app.add_typer(group, name="calibrate")


@group.command("import")
def import_(
    file: CalibFile,
    out: Annotated[Path, typer.Option("--out", help="Native YAML to write.")],
    images: Images = None,
    size: Size = None,
    unit: Unit = "m",
    eyes: Eyes = None,
    to: Annotated[str | None, typer.Option("--to", help="Convert a ZED to this resolution.")] = None,
    name: Annotated[str | None, typer.Option("--name", help="Free text for `camera`.")] = None,
) -> None:
    """Write any known calibration format as native YAML.

    Example: `stereo-ore calibrate import SN12345678.conf --size HD720 --out calib/ours.yaml`
    """
    from dataclasses import replace

    from stereo_ore.calibration.convert import convert_zed

    calibration = _load(file, images, size, unit, eyes)
    if to is not None:
        calibration = convert_zed(calibration, parse_size(to))
    if name is not None:
        calibration = replace(calibration, camera=name)
    write(calibration, out)
    typer.echo(out)


@group.command()
def show(
    file: CalibFile,
    images: Images = None,
    size: Size = None,
    unit: Unit = "m",
    eyes: Eyes = None,
    picture: Annotated[Path | None, typer.Option(help="PNG to write.")] = None,
) -> None:
    """Print geometry, field of view and depth noise.

    Example: `stereo-ore calibrate show calib/zed2_hd720.yaml --picture camera.png`
    """
    from stereo_ore.calibration.show import describe, draw

    calibration = _load(file, images, size, unit, eyes)
    typer.echo(describe(calibration))
    if picture is not None:
        draw(calibration, picture)
        log.info("wrote %s", picture)


@group.command()
def stereo(
    source: Annotated[Path, typer.Argument(help="Recorded pairs of a board, in any known layout.")],
    board: Annotated[str, typer.Option(help="Inner corners along the two sides: CxR.")],
    square_mm: Annotated[float, typer.Option(help="Side of a square, measured.")],
    out: Annotated[Path, typer.Option("--out", help="Native YAML to write.")],
    marker_mm: Annotated[float | None, typer.Option(help="ChArUco: side of a marker.")] = None,
    dictionary: Annotated[str, typer.Option(help="ChArUco: dictionary of cv2.aruco.")] = "DICT_5X5_100",
    coefficients: Annotated[Literal["4", "5", "8"], typer.Option(help="Distortion coefficients.")] = "5",
    picture: Annotated[Path | None, typer.Option(help="PNG of the coverage to write.")] = None,
    name: Annotated[str, typer.Option("--name", help="Free text for `camera`.")] = "",
) -> None:
    """Calibrate a camera from recorded pairs of a chessboard or ChArUco board.

    Example: `stereo-ore calibrate stereo recordings/board --board 9x6 --square-mm 25 --out calib/ours.yaml`
    """
    from dataclasses import replace

    from stereo_ore.calibration.board import calibrate_stereo, draw_coverage, report
    from stereo_ore.calibration.detect import Board

    columns, rows = _pair(board.lower(), "x", "--board")
    marker_m = None if marker_mm is None else marker_mm / 1000
    target = Board(columns, rows, square_mm / 1000, marker_m, dictionary)
    views, size = _views(source, target)
    result = calibrate_stereo(views, target, size, int(coefficients))
    typer.echo(report(result))
    write(replace(result.calibration, camera=name or source.name), out)
    if picture is not None:
        draw_coverage(result, picture)


@group.command()
def check(
    source: Annotated[Path, typer.Argument(help="Recorded pairs of a still scene, in any known layout.")],
    calib: Annotated[Path, typer.Option("--calib", help="Calibration to judge, in any known format.")],
    frame: Annotated[int, typer.Option(min=0, help="Which pair, counted from 0.")] = 0,
    known: Annotated[
        list[str] | None, typer.Option(help="Pixel in the left image and its distance: U,V,METRES.")
    ] = None,
    images: Images = None,
    unit: Unit = "m",
    eyes: Eyes = None,
    picture: Annotated[Path | None, typer.Option(help="PNG of the row differences to write.")] = None,
) -> None:
    """Judge a calibration by your own pair; ends with exit code 3 when it is wrong or can't be judged.

    Example: `stereo-ore calibrate check recordings/today --calib calib/ours.yaml --known 640,360,2.41`
    """
    from stereo_ore.calibration import load
    from stereo_ore.calibration.check import check_pair
    from stereo_ore.calibration.check_report import draw, report
    from stereo_ore.cli import EXIT_QUALITY
    from stereo_ore.sources import open_source

    points = [_known(text) for text in known or ()]
    recording = open_source(source)
    if frame >= len(recording.names):
        raise SourceError(f"has {len(recording.names)} frames, no frame {frame}", file=source, key="--frame")
    pair = recording.read(frame)
    size = (pair.left.shape[1], pair.left.shape[0])
    pair_of_eyes = None if eyes is None else _pair(eyes, ",", "--eyes")
    result = check_pair(pair, load(calib, images, size, UNITS_M[unit], pair_of_eyes), points)
    typer.echo(report(result))
    if picture is not None:
        draw(result, pair.left, picture)
    if result.verdict in ("wrong", "unclear"):
        raise typer.Exit(EXIT_QUALITY)


def _known(text: str) -> Known:
    from stereo_ore.calibration.check import Known

    try:
        u, v, distance = (float(part) for part in text.split(","))
    except ValueError:
        raise CalibrationError(f"{text!r} is not U,V,METRES", key="--known") from None
    if not distance > 0:
        raise CalibrationError(f"the distance must be positive, not {distance:g}", key="--known")
    return Known(u, v, distance)


def _views(source: Path, board: Board) -> tuple[list[BoardView], tuple[int, int]]:
    """The board in each pair of a recording, and the size of its images."""
    import cv2
    import numpy as np

    from stereo_ore.calibration.board import BoardView, find_view
    from stereo_ore.errors import FrameError
    from stereo_ore.sources import open_source

    recording = open_source(source)
    views: list[BoardView] = []
    size: tuple[int, int] | None = None
    for index, name in enumerate(recording.names):
        log.info("looking for the board in %s", name)
        try:
            pair = recording.read(index)
        except FrameError as fault:
            views.append(BoardView(name, reason=str(fault)))
            continue
        height, width = pair.left.shape[:2]
        if size not in (None, (width, height)):
            views.append(BoardView(name, reason=f"images of {width}×{height} px, the others have {size}"))
            continue
        size = width, height
        left, right = (
            np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8) for image in (pair.left, pair.right)
        )
        views.append(find_view(name, left, right, board))
    if size is None:
        raise CalibrationError("holds no pair that can be read", file=source)
    return views, size


def _load(file: Path, images: Images, size: str | None, unit: str, eyes: str | None) -> StereoCalibration:
    from stereo_ore.calibration import load

    return load(
        file,
        images=images,
        image_size=None if size is None else parse_size(size),
        unit_m=UNITS_M[unit],
        eyes=None if eyes is None else _pair(eyes, ",", "--eyes"),
    )


def parse_size(text: str) -> tuple[int, int]:
    """``1280x720`` or the name of a ZED mode as (width, height)."""
    return SIZES.get(text.upper()) or _pair(text.lower().replace("×", "x"), "x", "--size")


def _pair(text: str, separator: str, option: str) -> tuple[int, int]:
    try:
        first, second = (int(part) for part in text.split(separator))
    except ValueError:
        raise CalibrationError(f"{text!r} is not two whole numbers with {separator!r} between", key=option) from None
    return first, second


def write(calibration: StereoCalibration, out: Path) -> None:
    """Write a native YAML; a folder that is not there or not writable is an error in one line."""
    from stereo_ore.calibration import save

    try:
        save(calibration, out)
    except OSError as fault:
        raise OutputError(f"can't be written: {fault.strerror}", file=out) from None
