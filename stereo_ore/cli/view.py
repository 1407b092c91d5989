"""``stereo-ore view``: a run on a time line in 3-D, live in a window or into a file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def register(app: typer.Typer) -> None:
    """Add the verb to the command line."""
    app.command()(view)


def view(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder that `run` has written.")],
    save: Annotated[
        Path | None,
        typer.Option("--save", help="Write a rerun recording (.rrd) instead of opening a window."),
    ] = None,
) -> None:
    """Show the frames of a run on a time line: overlay, disparity, clouds, lumps, targets, counts.

    Disparity and removed voxels are there when the run was made with --save-stages.

    Example: `stereo-ore view out --save out.rrd`
    """
    from stereo_ore.draw.view import open_view, save_view
    from stereo_ore.io.results import Results

    if save:
        typer.echo(save_view(Results(folder), save))
    else:
        open_view(Results(folder))
