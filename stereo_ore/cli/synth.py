"""``stereo-ore synth``: make pairs of ore on a grizzly with exact truth."""

from __future__ import annotations

import logging
import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

_log = logging.getLogger(__name__)


def register(app: typer.Typer) -> None:
    """Add the verb to the command line."""
    app.command()(synth)


def synth(
    out: Annotated[Path, typer.Argument(help="Folder that gets a folder a scene.")],
    family: Annotated[
        list[str] | None,
        typer.Option(help="large, paper, hard, raw or empty; several are taken in turn."),
    ] = None,
    count: Annotated[int, typer.Option(min=1, help="How many scenes.")] = 1,
    seed: Annotated[
        int, typer.Option(min=0, help="Seed of the first scene; each next one counts up.")
    ] = 0,
    size: Annotated[str, typer.Option(help="VGA, HD720, HD1080 or 2K.")] = "HD720",
    lumps: Annotated[
        int | None,
        typer.Option(min=0, max=40, help="Lumps to drop, instead of as many as the seed says."),
    ] = None,
) -> None:
    """Make stereo pairs of ore on a grizzly with exact depth, outlines, volumes and centres of
    mass.

    A scene folder holds left.png, right.png, calibration.yaml and site.yaml for `run`, and the
    truth for `evaluate`: gt.npz, gt.json, calib.json. The same seed gives the same bytes.

    Example: `stereo-ore synth scenes --family paper --family large --count 10 --seed 100`
    """
    from rich.console import Console
    from rich.progress import track

    from stereo_ore.lab import synth as made

    families = family or ["large"]
    specs = [made.sample_spec(seed + k, families[k % len(families)], size) for k in range(count)]
    if lumps is not None:
        specs = [replace(spec, lumps=lumps) for spec in specs]
    shown = sys.stderr.isatty() and _log.isEnabledFor(logging.INFO)
    for spec in track(specs, "scenes", console=Console(stderr=True), disable=not shown):
        typer.echo(made.write(made.scene(spec), out / spec.name))
