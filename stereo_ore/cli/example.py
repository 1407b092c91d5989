"""``stereo-ore example``: files to try the program with."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def register(app: typer.Typer) -> None:
    """Add the verb to the command line."""
    app.command()(example)


def example(
    folder: Annotated[Path, typer.Argument(help="Where to write; made if needed.")],
) -> None:
    """Write a stereo pair, its calibration and its site; files that are there stay as they are.

    Example: `stereo-ore example demo`
    """
    from importlib.resources import files

    from stereo_ore.errors import OutputError
    from stereo_ore.io.atomic import write_bytes

    inside = [file for file in (files("stereo_ore") / "example").iterdir() if file.is_file()]
    for file in inside:
        if (folder / file.name).exists():
            remedy = "Name another folder"
            raise OutputError("is there already", file=folder / file.name, remedy=remedy)
    for file in inside:
        write_bytes(folder / file.name, file.read_bytes())
    typer.echo(f"stereo-ore run {folder} --calib {folder}/calibration.yaml --site"
               f" {folder}/site.yaml --out {folder}/out")  # fmt: skip
