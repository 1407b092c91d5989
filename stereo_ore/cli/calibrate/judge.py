"""``calibrate check``: whether a calibration is right for a recording."""

from __future__ import annotations

from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stereo_ore.cli.calibrate.options import (
    EyesOption,
    ImagesOption,
    Lens,
    Size,
    Unit,
    load_any,
    writing,
)
from stereo_ore.errors import CalibrationError, SourceError

if TYPE_CHECKING:
    from stereo_ore.calibrate.check import KnownPoint


def check(
    source: Annotated[
        Path, typer.Argument(help="Recorded pairs of a still scene, in any known layout.")
    ],
    calib: Annotated[
        Path, typer.Option("--calib", help="Calibration to judge, in any known format.")
    ],
    frame: Annotated[int, typer.Option(min=0, help="Which pair, counted from 0.")] = 0,
    known: Annotated[
        list[str] | None, typer.Option(help="Pixel in the left image and its distance: U,V,METRES.")
    ] = None,
    images: ImagesOption = None,
    size: Size = None,
    unit: Unit = None,
    eyes: EyesOption = None,
    projection: Lens = None,
    picture: Annotated[
        Path | None, typer.Option(help="PNG of the row differences to write.")
    ] = None,
) -> None:
    """Judge a calibration by your own pair; ends with exit code 3 when it is wrong or can't be
    judged.

    Example: `stereo-ore calibrate check recordings/today --calib calib/ours.yaml --known
    640,360,2.41`
    """
    from stereo_ore.calibrate.check import check_pair
    from stereo_ore.calibrate.check_report import check_report, draw_check
    from stereo_ore.cli import EXIT_QUALITY
    from stereo_ore.io.recordings import open_source
    from stereo_ore.stages.rectify import make_rectifier, rectify

    points = [_known(text) for text in known or ()]
    recording = open_source(source)
    if frame >= len(recording.names):
        raise SourceError(
            f"has {len(recording.names)} frames, no frame {frame}", file=source, key="--frame"
        )
    pair = recording.read(frame)
    recorded = (pair.left.shape[1], pair.left.shape[0])
    calibration = load_any(calib, images, size, unit, eyes, projection, recorded)
    result = check_pair(pair, calibration, points)
    typer.echo(check_report(result))
    if picture is not None:
        with writing(picture):
            draw_check(result, rectify(pair, make_rectifier(calibration)).left, picture)
    if result.verdict in ("wrong", "unclear"):
        raise typer.Exit(EXIT_QUALITY)


def _known(text: str) -> KnownPoint:
    from stereo_ore.calibrate.check import KnownPoint

    try:
        u, v, distance = (float(part) for part in text.split(","))
    except ValueError:
        raise CalibrationError(f"{text!r} is not U,V,METRES", key="--known") from None
    if not (distance > 0 and isfinite(u + v + distance)):
        raise CalibrationError(
            f"{text!r}: the distance must be positive, all finite", key="--known"
        )
    return KnownPoint(u, v, distance)
