"""``stereo-ore bench filter``: all filters on clouds whose noise is known."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stereo_ore.errors import SourceError

if TYPE_CHECKING:
    from stereo_ore.lab.bench.labelled import LabelledCloud

_log = logging.getLogger(__name__)


def register(app: typer.Typer) -> None:
    """Add the sub-verb."""
    app.command("filter")(filter_)


def filter_(
    out: Annotated[Path, typer.Option(help="Folder for bench-filter.json, .md and the pictures.")],
    seeds: Annotated[
        int, typer.Option(min=1, max=100, help="Seeds of each cell of the paper's protocol.")
    ] = 5,
    stereo_seeds: Annotated[
        int, typer.Option(min=0, max=100, help="Synthetic stereo scenes of each family.")
    ] = 2,
    family: Annotated[list[str] | None, typer.Option(help="Families of synthetic scenes.")] = None,
    scenes: Annotated[
        Path | None, typer.Option(help="Folder of scene folders with truth, judged too.")
    ] = None,
    scans: Annotated[
        Path | None, typer.Option(help="Folder of clean scans: kept? and with planted outliers?")
    ] = None,
    sets: Annotated[
        Path | None, typer.Option(help="Folder of real pairs with true disparities.")
    ] = None,
    readme: Annotated[
        Path | None, typer.Option(help="Put the tables between its `bench filter` markers.")
    ] = None,
) -> None:
    """Compare filters: quality (equation 7) and time. Baselines get the best of a grid on each
    cloud; ours do not.

    Example: `stereo-ore bench filter --out bench --scenes scenes --readme docs/benchmarks.md`
    """
    from stereo_ore.io.atomic import make_folder
    from stereo_ore.lab.bench import clean, labelled, tables
    from stereo_ore.lab.bench import filters as bench

    make_folder(out)
    scanned = clean.read_scans(scans) if scans else []
    stereo_total, stereo_clouds = _stereo(
        stereo_seeds, family or ["paper", "large", "hard"], scenes
    )
    paper = _judge(labelled.paper_clouds(range(seeds)), 9 * seeds, "paper's protocol")
    stereo = _judge(stereo_clouds, stereo_total, "stereo clouds")
    first = next(labelled.paper_clouds(range(1)))
    planted = _judge(clean.planted_clouds(range(1), scanned), 14 * len(scanned), "planted outliers")
    real = _judge(*_real(sets), "real stereo clouds")
    kept = bench.judge_clean(clean.clean_clouds(range(1), scanned))
    document = {"paper": paper, "planted": planted, "stereo": stereo, "real": real, "clean": kept}
    document["speed"] = [bench.speed(first.voxels), bench.speed(bench.large_cloud(), repeats=2)]
    text = tables.filter_markdown(document)
    (out / "bench-filter.json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    (out / "bench-filter.md").write_text(text, encoding="utf-8")
    _draw(first, out)
    if readme:
        tables.insert(readme, "bench filter", text)
    typer.echo(text)


def _judge(clouds: Iterator[LabelledCloud], total: int, title: str) -> dict[str, Any]:
    from rich.console import Console
    from rich.progress import track

    from stereo_ore.lab.bench import filters as bench

    shown = sys.stderr.isatty() and _log.isEnabledFor(logging.INFO)
    progress = track(clouds, title, total=total, console=Console(stderr=True), disable=not shown)
    rows = bench.judge_filters(progress)
    cells = bench.means(rows)
    return {
        "cells": cells,
        "summary": bench.summary(cells) if cells else {},
        "rows": [asdict(row) for row in rows],
    }


def _stereo(
    seeds: int, families: list[str], scenes: Path | None
) -> tuple[int, Iterator[LabelledCloud]]:
    """How many stereo clouds there will be, and the clouds, made one at a time."""
    from stereo_ore.lab.bench import labelled

    folders = sorted(path.parent for path in scenes.glob("*/gt.json")) if scenes else []
    if scenes and not folders:
        raise SourceError("holds no scene folder with gt.json", file=scenes)

    def clouds() -> Iterator[LabelledCloud]:
        for family in families:
            yield from (labelled.made_stereo(seed, family) for seed in range(seeds))
        yield from (labelled.scene_stereo(folder) for folder in folders)

    return seeds * len(families) + len(folders), clouds()


def _real(sets: Path | None) -> tuple[Iterator[LabelledCloud], int]:
    from stereo_ore.lab.bench.real_stereo import real_cloud
    from stereo_ore.lab.bench.stereo_sets import find_sets

    found = list(find_sets(sets)) if sets else []
    return map(real_cloud, found), len(found)


def _draw(labelled: LabelledCloud, out: Path) -> None:
    """The paper's Figures 4 and 5 on the first cloud."""
    from stereo_ore.config import FilterConfig
    from stereo_ore.draw import filter_pictures
    from stereo_ore.stages import filters

    cloud = labelled.voxels
    methods = ("none", "radius", "statistical", "paper", "paper-tuned", "adaptive")
    results = {method: filters.apply(cloud, FilterConfig(method=method)) for method in methods}
    filter_pictures.outlier_factors(cloud.xyz, results["paper"].score, out / "outlier-factors.png")
    filter_pictures.side_by_side(
        cloud.xyz, {name: r.keep for name, r in results.items()}, out / "side-by-side.png"
    )
