"""``stereo-ore bench faults``: planted faults must leave no target."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from stereo_ore.cli.options import Settings

_log = logging.getLogger(__name__)


def register(app: typer.Typer) -> None:
    """Add the sub-verb."""
    app.command("faults")(faults)


def faults(
    family: Annotated[
        list[str] | None, typer.Option(help="Families of scenes, in turn; see `synth`.")
    ] = None,
    count: Annotated[int, typer.Option(min=1, help="How many scenes.")] = 10,
    seed: Annotated[
        int, typer.Option(min=0, help="Seed of the first scene; each next one counts up.")
    ] = 0,
    size: Annotated[str, typer.Option(help="VGA, HD720, HD1080 or 2K.")] = "VGA",
    scenes: Annotated[
        list[Path] | None,
        typer.Option(help="Folders of a scene with truth, in the place of made-up ones."),
    ] = None,
    only: Annotated[
        str, typer.Option(help="Faults whose name this regular expression is found in.")
    ] = "",
    settings: Settings = None,
) -> None:
    """Plant wrong calibrations, sites, eyes and images in scenes whose truth is known.

    Ends with code 3 when a frame that is ok has a wrong target (`wrong_ok_frames`: a strike more
    than 30 mm, or 3 % of its distance, off each lump), or a sound frame was refused.

    Example: `stereo-ore bench faults --family paper --family large --count 100`
    """
    from stereo_ore.io.parameters import load_config
    from stereo_ore.lab import synth
    from stereo_ore.lab.bench import fault_scenes
    from stereo_ore.lab.bench import faults as bench

    config, families = load_config(None, settings or []), family or ["paper", "large"]

    def planted() -> Iterator[fault_scenes.Planted]:
        yield from map(fault_scenes.traced, scenes or ())
        for place in range(0 if scenes else count):
            spec = synth.sample_spec(seed + place, families[place % len(families)], size)
            yield fault_scenes.made_scenes(synth.scene(replace(spec, supersampling=1)))

    rows: dict[str, bench.FaultRow] = {}
    for scene in planted():
        for name, record in bench.plant_fault(scene, config, only, seed):
            row = rows.setdefault(name, bench.FaultRow(name))
            if fault := row.add(record, 0 if record is None else scene.wrong_targets(record)):
                _log.warning("%s, %s: %s", scene.name, name, fault)
    typer.echo(bench.faults_markdown(list(rows.values())))
    if any(row.failed for row in rows.values()):
        raise typer.Exit(3)
