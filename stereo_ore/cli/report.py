"""``stereo-ore report``: one HTML page that shows a run and opens without a network."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def register(app: typer.Typer) -> None:
    """Add the verb to the command line."""
    app.command()(report)


def report(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder that `run` has written.")],
) -> None:
    """Write report.html into the folder of a run, finished or not: pictures, 3-D view, counts,
    reasons, timings.

    Example: `stereo-ore report out`
    """
    from stereo_ore.report import write_report

    typer.echo(write_report(folder))
