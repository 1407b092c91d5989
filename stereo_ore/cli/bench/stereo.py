"""``stereo-ore bench stereo``: matching against truth, beside OpenCV's own."""

from __future__ import annotations

import json
import logging
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

_log = logging.getLogger(__name__)


def register(app: typer.Typer) -> None:
    """Add the sub-verb."""
    app.command("stereo")(stereo)


def stereo(
    folders: Annotated[
        list[Path], typer.Argument(help="Folders that hold Middlebury sets or scenes with truth.")
    ],
    out: Annotated[Path | None, typer.Option(help="Folder for bench-stereo.json and .md.")] = None,
    repeats: Annotated[
        int, typer.Option(min=1, max=50, help="Timed runs of each matcher; the median counts.")
    ] = 3,
    grid: Annotated[
        bool,
        typer.Option(
            help=(
                "Beside 3WAY, HH and WLS at the best of a grid too, at equal density; takes"
                " minutes."
            )
        ),
    ] = False,
    readme: Annotated[
        Path | None, typer.Option(help="Put the tables between its `bench stereo` markers.")
    ] = None,
) -> None:
    """Compare matchers: errors over all, seen and ore pixels, density, time. OpenCV's run with
    their sample settings.

    What our confidence says is held against what is true. Missing pixels count as bad everywhere.

    Example: `stereo-ore bench stereo data --out bench`
    """
    from stereo_ore.io.atomic import make_folder
    from stereo_ore.lab.bench import equal_density, stereo_sets, tables
    from stereo_ore.lab.bench import stereo as bench

    if out:
        make_folder(out)
    rows: list[bench.StereoRow] = []
    sure: list[bench.Sureness] = []
    compared: list[equal_density.Compared] = []
    for data in (data for folder in folders for data in stereo_sets.find_sets(folder)):
        _log.info("%s", data.name)
        rows += bench.judge_matchers([data], repeats)
        sure.append(bench.sureness(data))
        compared += bench.beside_peers(data) if grid and data.volume is None else []
    text = bench.stereo_markdown(rows) + "\n" + bench.sureness_markdown(sure)
    text += f"\n{equal_density.density_markdown(compared)}" if compared else ""
    if out:
        document = {
            "matchers": [asdict(row) for row in rows],
            "confidence": [asdict(row) for row in sure],
            "equal_density": [asdict(row) for row in compared],
        }
        (out / "bench-stereo.json").write_text(json.dumps(document, indent=1) + "\n", "utf-8")
        (out / "bench-stereo.md").write_text(text, "utf-8")
    if readme:
        tables.insert(readme, "bench stereo", text)
    typer.echo(text)
