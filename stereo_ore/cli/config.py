"""``stereo-ore config``: every parameter with default, unit and range; check a file; the JSON Schema."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer


def register(app: typer.Typer) -> None:
    """Add the verb to the command line."""
    group = typer.Typer(help="Parameters: dump the defaults, validate a file, print the schema.", no_args_is_help=True)
    for verb in (dump, validate, schema):
        group.command()(verb)
    app.add_typer(group, name="config")


def dump(
    config: Annotated[Path | None, typer.Argument(help="File whose values replace the defaults.")] = None,
    settings: Annotated[list[str] | None, typer.Option("--set", help="One parameter: key.sub=value.")] = None,
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


def schema() -> None:
    """Print the JSON Schema of the configuration, for editors that complete and check YAML.

    Example: `stereo-ore config schema > schema.json`
    """
    from stereo_ore.config import Config

    typer.echo(json.dumps(Config.model_json_schema(), indent=1))
