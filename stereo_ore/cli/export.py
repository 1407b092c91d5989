"""``stereo-ore export``: a run in the formats of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer


def register(app: typer.Typer) -> None:
    """Add the verb to the command line."""
    app.command()(export)


def export(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder that `run` has written.")],
    out: Annotated[
        Path,
        typer.Argument(help="Bag: folder to make. Parquet: folder to make, or to add the run to."),
    ],
    format: Annotated[
        Literal["bag", "parquet"],
        typer.Option(help="ROS 2 bag with an .mcap file, or tables of ores and frames."),
    ] = "bag",
    camera: Annotated[
        str | None,
        typer.Option(help="Parquet: what to call the camera; else the calibration's name of it."),
    ] = None,
) -> None:
    """Write a run as a ROS 2 bag in MCAP for Foxglove and `ros2 bag`, or add it to Parquet tables
    for queries.

    Example: `stereo-ore export out results`; `stereo-ore export out tables --format parquet
    --camera north`
    """
    from stereo_ore.export.mcap import write_mcap
    from stereo_ore.export.parquet import write_parquet
    from stereo_ore.io.results import Results

    if format == "parquet":
        typer.echo(write_parquet(Results(folder), out, camera))
    else:
        typer.echo(write_mcap(Results(folder), out))
