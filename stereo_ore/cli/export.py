"""``stereo-ore export``: a run in the formats of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def register(app: typer.Typer) -> None:
    """Add the verb to the command line."""
    app.command()(export)


def export(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder that `run` has written.")],
    bag: Annotated[Path, typer.Argument(help="Folder to make: a ROS 2 bag with an .mcap file.")],
) -> None:
    """Write clouds, lumps, targets and overlays as a ROS 2 bag in MCAP, for Foxglove and `ros2 bag`.

    Example: `stereo-ore export out results`
    """
    from stereo_ore.results import Results
    from stereo_ore.sinks.mcap import write_mcap

    typer.echo(write_mcap(Results(folder), bag))
