"""``calibrate import`` and ``show``: calibration files in and out."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Annotated

import typer

from stereo_ore.cli.calibrate.options import (
    CalibFile,
    EyesOption,
    ImagesOption,
    Lens,
    Size,
    Unit,
    load_any,
    parse_size,
    writing,
)

_log = logging.getLogger(__name__)


def import_(
    file: CalibFile,
    out: Annotated[Path, typer.Option("--out", help="Native YAML to write.")],
    images: ImagesOption = None,
    size: Size = None,
    unit: Unit = None,
    eyes: EyesOption = None,
    projection: Lens = None,
    to: Annotated[
        str | None, typer.Option("--to", help="Convert a ZED to this resolution.")
    ] = None,
    name: Annotated[str | None, typer.Option("--name", help="Free text for `camera`.")] = None,
) -> None:
    """Write any known calibration format as native YAML.

    Example: `stereo-ore calibrate import SN12345678.conf --size HD720 --out calib/ours.yaml`
    """
    from dataclasses import replace

    from stereo_ore.calibrate.convert import convert_zed
    from stereo_ore.io.calibration import save
    from stereo_ore.stages.rectify import make_rectifier

    calibration = load_any(file, images, size, unit, eyes, projection)
    if to is not None:
        calibration = convert_zed(calibration, parse_size(to))
    make_rectifier(calibration)  # refuses cameras that would see nothing
    if name is not None:
        calibration = replace(calibration, camera=name)
    with writing(out):
        save(calibration, out)
    typer.echo(out)


def show(
    file: CalibFile,
    images: ImagesOption = None,
    size: Size = None,
    unit: Unit = None,
    eyes: EyesOption = None,
    projection: Lens = None,
    picture: Annotated[Path | None, typer.Option(help="PNG to write.")] = None,
) -> None:
    """Print geometry, field of view and depth noise.

    Example: `stereo-ore calibrate show calib/zed2_hd720.yaml --picture camera.png`
    """
    from stereo_ore.calibrate.show import describe_calibration, draw_calibration

    calibration = load_any(file, images, size, unit, eyes, projection)
    typer.echo(describe_calibration(calibration))
    if picture is not None:
        with writing(picture):
            draw_calibration(calibration, picture)
        _log.info("wrote %s", picture)
