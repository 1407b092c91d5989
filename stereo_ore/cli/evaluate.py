"""``stereo-ore evaluate``: results against truth."""

from __future__ import annotations

import json
import logging
import math
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

_log = logging.getLogger(__name__)

WIDTH = 170


def register(app: typer.Typer) -> None:
    """Add the verb to the command line."""
    app.command()(evaluate)


def evaluate(
    results: Annotated[
        Path, typer.Argument(help="A run folder, or a folder with a run folder a scene.")
    ],
    truth: Annotated[Path, typer.Argument(help="A scene folder with truth, or a folder of them.")],
    out: Annotated[
        Path | None, typer.Option(help="Folder for evaluation.json and evaluation.png.")
    ] = None,
    baselines: Annotated[
        bool, typer.Option(help="Also judge the tuned statistical and radius filter (slow).")
    ] = False,
    at_least: Annotated[
        list[str] | None, typer.Option(help="Quality gate: figure=value; exit code 3 below it.")
    ] = None,
    at_most: Annotated[
        list[str] | None, typer.Option(help="Quality gate: figure=value; exit code 3 above it.")
    ] = None,
) -> None:
    """Judge results of `run --save-stages` by scenes whose truth is known, such as `synth` makes.

    Lengths are in millimetres. Figures: share of ore pixels matched, filter quality (equation 7),
    ores found, errors of centre of gravity, volume, size and strike.

    Example: `stereo-ore evaluate out scenes --out judged --at-least recall50=0.9 --at-most
    cog_xy_mm=15`
    """
    from rich.console import Console
    from rich.progress import track

    from stereo_ore.lab import evaluate as judge

    gates = _gates(at_least, 1) + _gates(at_most, -1)
    pairs = judge.find_pairs(results, truth)
    shown = sys.stderr.isatty() and _log.isEnabledFor(logging.INFO)
    rows: list[dict[str, Any]] = []
    for pair in track(pairs, "scenes", console=Console(stderr=True), disable=not shown):
        row = judge.score(pair.record(), pair.stages(), judge.load_truth(pair.scene), baselines)
        rows.append(row | {"ms": pair.total_ms()})
    total = judge.pool_scenes(rows)
    if out:
        _write(out, rows, total)
    _print(judge.summary_table(rows), total)
    _check(gates, total)


def _gates(texts: list[str] | None, sign: int) -> list[tuple[str, float, int]]:
    gates = []
    for text in texts or ():
        name, _, value = text.partition("=")
        try:
            gates.append((name.strip(), float(value), sign))
        except ValueError:
            raise typer.BadParameter(f"{text!r} is not figure=number") from None
    return gates


def _check(gates: list[tuple[str, float, int]], total: dict[str, float]) -> None:
    """Exit with the quality code when a gate fails; a figure that could not be computed fails."""
    from stereo_ore.cli import EXIT_QUALITY

    failed = False
    for name, limit, sign in gates:
        if name not in total:
            raise typer.BadParameter(f"{name!r} is no figure; choose from {', '.join(total)}")
        if not sign * (total[name] - limit) >= 0:
            failed = True
            typer.echo(
                f"gate failed: {name} is {total[name]:.4g}, wanted {'≥' if sign > 0 else '≤'}"
                f" {limit:g}",
                err=True,
            )
    if failed:
        raise typer.Exit(EXIT_QUALITY)


def _write(out: Path, rows: list[dict[str, Any]], total: dict[str, float]) -> None:
    from stereo_ore.draw.figures import if_possible
    from stereo_ore.io.atomic import write_text
    from stereo_ore.lab.evaluate.plots import draw_plots

    write_text(
        out / "evaluation.json",
        json.dumps(_without_nan({"total": total, "rows": rows}), indent=1) + "\n",
    )
    if_possible(lambda: draw_plots(rows, out / "evaluation.png"))


def _without_nan(value: Any) -> Any:
    """The same document with null for every NaN."""
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_without_nan(item) for item in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def _print(cells: list[list[str]], total: dict[str, float]) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console()
    console.width = max(console.width, WIDTH)
    listing = Table(*cells[0])
    for line in cells[1:]:
        listing.add_row(*line)
    console.print(listing)
    pooled = Table("pooled", "value", title="all scenes")
    for name, value in total.items():
        pooled.add_row(name, "–" if math.isnan(value) else f"{value:.4g}")
    console.print(pooled)
