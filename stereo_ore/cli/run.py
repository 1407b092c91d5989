"""``stereo-ore run``: recorded pairs in, a folder of results out."""

from __future__ import annotations

import typer


def register(app: typer.Typer) -> None:
    """Add the verb to the command line."""
    app.command()(run)


def run() -> None:
    """Recorded pairs → ore point sets, centres of gravity, targets."""
