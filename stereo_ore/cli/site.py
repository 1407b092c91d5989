"""``stereo-ore site``: find the screen in a recording, and check a site file against one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stereo_ore.cli.calibrate.options import writing
from stereo_ore.cli.options import ParameterFile

if TYPE_CHECKING:
    from stereo_ore.types import RectifiedPair, StereoCalibration

Recorded = Annotated[
    Path, typer.Argument(help="Recorded pairs of the still screen, the emptier the better.")
]
Calib = Annotated[
    Path | None, typer.Option("--calib", help="Calibration of the recording; a bag has its own.")
]
Frames = Annotated[int, typer.Option(min=1, max=100, help="How many frames, from the first.")]


def register(app: typer.Typer) -> None:
    """Add the verb to the command line."""
    group = typer.Typer(no_args_is_help=True, help="Make and check the site file.")
    group.command()(make)
    group.command()(check)
    app.add_typer(group, name="site")


def make(
    source: Recorded,
    out: Annotated[Path, typer.Option("--out", help="Site file to write, a picture beside it.")],
    calib: Calib = None,
    base: Annotated[
        Path | None,
        typer.Option("--site", help="Site file whose arm, reach and keep_out are taken over."),
    ] = None,
    config: ParameterFile = None,
    opening_m: Annotated[
        float | None, typer.Option(min=0.005, max=3, help="Clear distance of two bars, measured.")
    ] = None,
    cross_opening_m: Annotated[
        float | None,
        typer.Option(
            min=0.005, max=3, help="That of the bars across, in a grid; with --opening-m."
        ),
    ] = None,
    bar_width_m: Annotated[
        float | None, typer.Option(min=0.001, max=1, help="Width of a bar, measured.")
    ] = None,
    height_m: Annotated[
        float | None,
        typer.Option(min=0.01, max=20, help="Height of the working volume; else four openings."),
    ] = None,
    frames: Frames = 8,
) -> None:
    """Find screen, bars and working volume; a person looks at the picture and confirms.

    No target is given until `survey.confirmed` is true in the file.

    Example: `stereo-ore site make recordings/empty --calib calib/ours.yaml --site hand_eye.yaml
    --out site.yaml`
    """
    import cv2

    from stereo_ore.calibrate.survey import survey
    from stereo_ore.cli.recording import calibration_for
    from stereo_ore.draw import site_picture
    from stereo_ore.io.parameters import load_config
    from stereo_ore.io.recordings import open_source
    from stereo_ore.io.site import load_site, save_site
    from stereo_ore.io.site_sections import SurveyRecord
    from stereo_ore.types import Site

    calibration = calibration_for(open_source(source), calib)
    if cross_opening_m is not None and opening_m is None:
        raise typer.BadParameter("give --opening-m with --cross-opening-m")
    known = load_site(base) if base else Site()
    known = replace(
        known,
        opening_m=known.opening_m if opening_m is None else opening_m,
        cross_opening_m=known.cross_opening_m if cross_opening_m is None else cross_opening_m,
        bar_width_m=known.bar_width_m if bar_width_m is None else bar_width_m,
    )
    found = survey(_pairs(source, calibration, frames), known, load_config(config, ()), height_m)
    record = SurveyRecord(
        confirmed=False,
        calibration=calibration.fingerprint,
        camera=calibration.camera,
        image_size=calibration.image_size,
        frames=found.frames,
        bars_seen=int(found.screen.diagnostics["bars_seen"]),
        rms_m=round(found.screen.rms_m or 0.0, 6),
    )
    picture = out.with_suffix(".png")
    with writing(out):
        save_site(found.site, out, survey=record)
    with writing(picture):
        encoded = cv2.imencode(
            ".png", site_picture.draw_site(found.pair, found.site, found.screen.bars)
        )
        picture.write_bytes(encoded[1].tobytes())
    for line in site_picture.site_numbers(found.site):
        typer.echo(line)
    typer.echo(f"{out}, {picture}: look at it, correct the numbers, set survey.confirmed: true")


def check(
    site: Annotated[Path, typer.Argument(help="Site file.")],
    source: Recorded,
    calib: Calib = None,
    config: ParameterFile = None,
    frames: Frames = 8,
) -> None:
    """Find the screen anew and compare; ends with 3 where the site file says something else.

    Example: `stereo-ore site check site.yaml recordings/today --calib calib/ours.yaml`
    """
    from stereo_ore.calibrate.survey import differences, survey
    from stereo_ore.cli import EXIT_QUALITY
    from stereo_ore.cli.recording import calibration_for
    from stereo_ore.io.parameters import load_config
    from stereo_ore.io.recordings import open_source
    from stereo_ore.io.site import load_site
    from stereo_ore.stages.health import missing_in_site, other_scene

    given = load_site(site)
    calibration = calibration_for(open_source(source), calib)
    reasons = (*missing_in_site(given), *other_scene(given, calibration))
    doubts = [reason.detail for reason in reasons]
    found = survey(_pairs(source, calibration, frames), given, load_config(config, ()))
    rows = list(differences(given, found.site))
    for row in rows:
        verdict = "ok" if row.ok else "DIFFERS"
        typer.echo(f"{row.what}: {row.given} in the file, {row.found} found: {verdict}")
    for doubt in doubts:
        typer.echo(doubt)
    if doubts or not all(row.ok for row in rows):
        raise typer.Exit(EXIT_QUALITY)


def _pairs(source: Path, calibration: StereoCalibration, frames: int) -> Iterator[RectifiedPair]:
    from stereo_ore.io.recordings import open_source
    from stereo_ore.stages.rectify import make_rectifier, rectify

    recording, rectifier = open_source(source), make_rectifier(calibration)
    for index in range(min(frames, len(recording.names))):
        yield rectify(recording.read(index), rectifier)
