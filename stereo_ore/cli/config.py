"""``stereo-ore config``: every parameter with default, unit and range; check a file; what other
programs import.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Literal

import typer

from stereo_ore.cli.options import Settings


def register(app: typer.Typer) -> None:
    """Add the verb to the command line."""
    group = typer.Typer(
        help="Parameters: dump, validate, schema. Interfaces: opcua, modbus.", no_args_is_help=True
    )
    for verb in (dump, validate, schema, opcua, modbus):
        group.command()(verb)
    app.add_typer(group, name="config")


def dump(
    config: Annotated[
        Path | None, typer.Argument(help="File whose values replace the defaults.")
    ] = None,
    settings: Settings = None,
) -> None:
    """Print all parameters as commented YAML, ready to edit.

    Example: `stereo-ore config dump > parameters.yaml`
    """
    from stereo_ore.io.parameters import dump_config, load_config

    typer.echo(dump_config(load_config(config, settings or ()), comments=True), nl=False)


def validate(config: Annotated[Path, typer.Argument(help="File to check.")]) -> None:
    """Check a file; all faults are listed at once.

    Example: `stereo-ore config validate parameters.yaml`
    """
    from stereo_ore.io.parameters import load_config
    from stereo_ore.stages.filters import parameters

    parameters(load_config(config).filter)
    typer.echo(f"{config}: valid")


def schema(
    part: Annotated[
        Literal["parameters", "sinks", "posture", "targets", "frame"],
        typer.Argument(
            help="Parameters, the sinks file, a line of the arm's posture, a message to the arm,"
            " or a frame's record."
        ),
    ] = "parameters",
) -> None:
    """Print a JSON Schema, for editors that complete and check YAML, and for those who read
    messages.

    Example: `stereo-ore config schema sinks > sinks.schema.json`
    """
    from importlib.resources import files

    from pydantic import BaseModel

    from stereo_ore.config import Config
    from stereo_ore.io.posture import PostureLine
    from stereo_ore.io.record_check import NEWEST
    from stereo_ore.plant.sinks.settings import SinksSettings

    if part in ("targets", "frame"):
        name = {"targets": "targets-1.json", "frame": NEWEST}[part]
        text = files("stereo_ore").joinpath("schema", name).read_text(encoding="utf-8")
    else:
        models: dict[str, type[BaseModel]] = {
            "parameters": Config,
            "sinks": SinksSettings,
            "posture": PostureLine,
        }
        text = json.dumps(models[part].model_json_schema(), indent=1)
    typer.echo(text.rstrip())


def opcua() -> None:
    """Print the OPC UA model as a NodeSet2 file, for engineering tools that import one.

    Example: `stereo-ore config opcua > stereo_ore.NodeSet2.xml`
    """
    from stereo_ore.plant.sinks.opcua_nodeset import nodeset

    typer.echo(nodeset(), nl=False)


def modbus() -> None:
    """Print the Modbus table as CSV: address from 0, type, name, unit, meaning.

    Example: `stereo-ore config modbus > registers.csv`
    """
    import csv
    import sys

    from stereo_ore.plant.sinks.modbus_table import rows

    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerow(("address", "type", "name", "unit", "meaning"))
    writer.writerows(rows())
