"""``stereo-ore bench faults``: planted faults must leave no target."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Annotated

import typer

log = logging.getLogger(__name__)


def register(app: typer.Typer) -> None:
    """Add the sub-verb."""
    app.command("faults")(faults)


def faults(
    family: Annotated[list[str] | None, typer.Option(help="Families of scenes, in turn; see `synth`.")] = None,
    count: Annotated[int, typer.Option(min=1, help="How many scenes.")] = 10,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the first scene; each next one counts up.")] = 0,
    size: Annotated[str, typer.Option(help="VGA, HD720, HD1080 or 2K.")] = "VGA",
    settings: Annotated[list[str] | None, typer.Option("--set", help="One parameter: key.sub=value.")] = None,
) -> None:
    """Plant swapped, covered and frozen eyes, wrong calibrations and a bumped camera in scenes of many seeds.

    Ends with code 3 when a fault left a target, or a sound frame lost all of its own.

    Example: `stereo-ore bench faults --family paper --family large --count 100`
    """
    from stereo_ore.io.parameters import load_config
    from stereo_ore.lab import synth
    from stereo_ore.lab.bench import faults as bench

    config, families = load_config(None, settings or []), family or ["paper", "large"]
    rows: dict[str, bench.Row] = {}
    for place in range(count):
        spec = replace(synth.sample_spec(seed + place, families[place % len(families)], size), supersampling=1)
        for name, record in bench.plant(synth.scene(spec), config):
            row = rows.setdefault(name, bench.Row(name))
            if fault := row.add(record):
                log.warning("%s, %s: %s", spec.name, name, fault)
    typer.echo(bench.markdown(list(rows.values())))
    if any(row.wrong for row in rows.values()):
        raise typer.Exit(3)
