"""``stereo-ore bench speed``: what a frame costs, and how the filter grows."""

from __future__ import annotations

import json
import logging
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from stereo_ore.errors import ConfigError

_log = logging.getLogger(__name__)

_SMALLEST = 10_000
"""Points of the smallest cloud of the filters' growth; each next one has ten times as many."""


def register(app: typer.Typer) -> None:
    """Add the sub-verb."""
    app.command("speed")(speed)


def speed(
    out: Annotated[
        Path,
        typer.Option(help="Folder for bench-speed.json, .md, .png and the scenes, which are kept."),
    ],
    size: Annotated[
        list[str] | None, typer.Option(help="Image sizes: VGA, HD720, HD1080, 2K; default all.")
    ] = None,
    rounds: Annotated[
        int, typer.Option(min=1, max=100, help="Timed rounds of each frame; medians count.")
    ] = 7,
    points: Annotated[
        int,
        typer.Option(
            min=0, help="Points of the largest cloud: up to 10000000; 0 leaves clouds out."
        ),
    ] = 1_000_000,
    limit: Annotated[
        float, typer.Option(min=0, help="Seconds above which a filter is left out.")
    ] = 120.0,
    readme: Annotated[
        Path | None, typer.Option(help="Put the tables between its `bench speed` markers.")
    ] = None,
) -> None:
    """Time and memory of each stage beside OpenCV's plain SGBM; the filter on growing clouds beside
    the usual ones.

    Example: `stereo-ore bench speed --out bench --readme docs/benchmarks.md`
    """
    from stereo_ore.draw import figures
    from stereo_ore.io.atomic import make_folder
    from stereo_ore.lab import synth
    from stereo_ore.lab.bench import growth, speed_tables, tables
    from stereo_ore.lab.bench import speed as bench

    sizes = size or list(synth.SIZES)
    if unknown := set(sizes) - set(synth.SIZES):
        raise ConfigError(
            f"{unknown.pop()!r} is no image size",
            key="--size",
            remedy=f"Known: {', '.join(synth.SIZES)}",
        )
    make_folder(out)
    frames = []
    for name in sizes:
        scene = bench.make_scene(out / "scenes" / name, name)
        for site in (True, False):
            _log.info("%s %s", name, "with site" if site else "without site")
            frames.append(bench.measure_speed(name, scene, site, rounds))
    clouds = [n for power in range(4) if (n := _SMALLEST * 10**power) <= points]
    _log.info("filters on clouds of %s points", ", ".join(f"{n:,}" for n in clouds) or "no")
    grown = growth.measure_growth(clouds, limit)
    machine = _machine()
    document = {
        "machine": machine,
        "frames": [asdict(f) for f in frames],
        "growth": [asdict(g) for g in grown],
    }
    text = speed_tables.speed_markdown(frames, grown, machine)
    (out / "bench-speed.json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    (out / "bench-speed.md").write_text(text, encoding="utf-8")
    figures.if_possible(lambda: speed_tables.draw_speed(frames, grown, out / "bench-speed.png"))
    if readme:
        tables.insert(readme, "bench speed", text)
    typer.echo(text)


def _machine() -> dict[str, Any]:
    """What the figures depend on; the load tells whether others were at work."""
    import os
    import platform

    import cv2

    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    return {
        "cores": os.cpu_count(), "processor": platform.processor() or platform.machine(),
        "load": round(load, 1),
        "opencv": cv2.__version__, "python": platform.python_version(),
    }  # fmt: skip
