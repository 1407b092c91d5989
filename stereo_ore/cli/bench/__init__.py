"""``stereo-ore bench``: quality and speed against baselines; one module a sub-verb."""

from __future__ import annotations

import importlib

import typer

SUBVERBS = ("faults", "filter", "speed", "stereo")
"""Modules of this package; each has ``register(app)``."""


def register(app: typer.Typer) -> None:
    """Add the verb and its sub-verbs to the command line."""
    bench = typer.Typer(
        no_args_is_help=True,
        help="Quality and speed against baselines.",
        rich_markup_mode="markdown",
    )
    for name in SUBVERBS:
        importlib.import_module(f"stereo_ore.cli.bench.{name}").register(bench)
    app.add_typer(bench, name="bench")
