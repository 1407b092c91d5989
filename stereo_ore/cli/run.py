"""``stereo-ore run``: recorded pairs in, a folder of results out."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stereo_ore.cli.options import (
    Clouds,
    LeftTopic,
    MaxSkew,
    ModelsFolder,
    Overlays,
    Overwrite,
    ParameterFile,
    RightTopic,
    Settings,
    SiteFile,
    parameters_of,
)

if TYPE_CHECKING:
    from stereo_ore.chain import Chain
    from stereo_ore.runs.run import Progress
    from stereo_ore.types import Json

_log = logging.getLogger(__name__)


TABLE_WIDTH = 130
"""Columns of the table of ores where the output is no terminal."""


def register(app: typer.Typer) -> None:
    """Add the verb to the command line."""
    app.command()(run)


def run(
    source: Annotated[
        Path | None, typer.Argument(help="Recording: folder or file in any known layout.")
    ] = None,
    calib: Annotated[
        Path | None,
        typer.Option("--calib", help="Calibration of the camera; a bag may carry its own."),
    ] = None,
    out: Annotated[Path, typer.Option("--out", help="Folder for the results.")] = ...,  # type: ignore[assignment]
    site: SiteFile = None,
    config: ParameterFile = None,
    settings: Settings = None,
    models: ModelsFolder = None,
    left: Annotated[
        Path | None, typer.Option(help="Left image, video or folder, instead of SOURCE.")
    ] = None,
    right: Annotated[
        Path | None, typer.Option(help="Right image, video or folder, instead of SOURCE.")
    ] = None,
    left_topic: LeftTopic = None,
    right_topic: RightTopic = None,
    max_skew_ms: MaxSkew = 5.0,
    start_time: Annotated[
        str | None,
        typer.Option(
            "--start-time", metavar="TIME", help="When the first frame was taken: ISO 8601."
        ),
    ] = None,
    fps: Annotated[
        float | None,
        typer.Option(min=0.001, help="Frames a second, instead of the recorded times."),
    ] = None,
    report: Annotated[
        bool, typer.Option("--report/--no-report", help="Check the calibration, write report.html.")
    ] = True,
    save_stages: Annotated[
        bool, typer.Option("--save-stages", help="Also write stages/FRAME.npz.")
    ] = False,
    pictures: Annotated[
        bool, typer.Option("--pictures", help="Also write pictures/FRAME.png: ores in space.")
    ] = False,
    clouds: Clouds = True,
    arm_clouds: Annotated[
        bool,
        typer.Option(
            "--arm-clouds", help="Write arm_clouds/FRAME.ply too: the same in the arm's frame."
        ),
    ] = False,
    overlays: Overlays = True,
    start: Annotated[int, typer.Option(min=0, help="First frame, counted from 0.")] = 0,
    stop: Annotated[int | None, typer.Option(min=0, help="Frame to stop before.")] = None,
    every: Annotated[
        int | None,
        typer.Option(
            min=1, help="Take each n-th frame; 1, or as many as are fused.", show_default=False
        ),
    ] = None,
    fuse: Annotated[
        int | None, typer.Option(min=1, help="Measure so many frames of a still scene as one.")
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue a run that was stopped.")
    ] = False,
    overwrite: Overwrite = False,
    strict: Annotated[
        bool, typer.Option("--strict", help="Stop at the first frame that fails.")
    ] = False,
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS", help="Dask scheduler whose workers do the frames: tcp://host:8786."
        ),
    ] = None,
) -> None:
    """Recorded pairs → ore point sets, centres of gravity, targets.

    Example: `stereo-ore run recording --calib calib/zed2_hd720.yaml --site site.yaml --out out`
    """
    from stereo_ore.chain import Chain
    from stereo_ore.cli.recording import calibration_for, open_for_command
    from stereo_ore.draw.figures import require_matplotlib
    from stereo_ore.io.posture import recorded_postures
    from stereo_ore.io.recordings import describe_recording, expect_eyes, limit_pixels
    from stereo_ore.io.recordings.retimed import parse_time, retime
    from stereo_ore.io.site import load_site
    from stereo_ore.runs.identity import InputFiles
    from stereo_ore.runs.run import RunOptions, select
    from stereo_ore.runs.run import run_recording as run_frames

    if scheduler and workers > 1:
        raise typer.BadParameter("give one of --workers and --scheduler")
    if pictures:
        require_matplotlib()
    options = RunOptions(
        start, stop, every, clouds, overlays, pictures, save_stages, report, resume, overwrite,
        strict, workers, scheduler, arm_clouds,
    )  # fmt: skip
    more = [f"matching.fuse={fuse}"] if fuse else []
    parameters = parameters_of(config, settings, models, *more)
    opened = open_for_command(source, left, right, (left_topic, right_topic), max_skew_ms)
    opened = limit_pixels(opened, parameters.source.max_pixels)
    calibration = calibration_for(opened, calib)
    _log.info("%s", describe_recording(opened))
    opened = expect_eyes(opened, calibration.image_size)
    recording = retime(opened, None if start_time is None else parse_time(start_time), fps)
    place = load_site(site) if site else None
    chain = Chain(calibration, place, parameters, recorded_postures(place))
    _log.info("%s", _frames(len(select(recording, chain, options))))
    announce(chain)
    with _progress() as progress:
        page = run_frames(recording, chain, out, options, InputFiles(calib, site, config), progress)
    if page:
        typer.echo(f"report: {page}")
    _summarise(out)


def announce(chain: Chain) -> None:
    """Say before the first frame what the site lacks."""
    for reason in chain.withheld:
        _log.warning("%s", reason.detail)
    if chain.site.opening_m is None:
        _log.warning(
            "no grizzly opening in a site file: oversize stays unknown where it can't be measured"
        )


@contextmanager
def _progress() -> Iterator[Progress]:
    """A bar on a terminal, silence in a pipe or with -q."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    shown = sys.stderr.isatty() and _log.isEnabledFor(logging.INFO)
    columns = (
        TextColumn("frames"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), disable=not shown) as bar:
        task = bar.add_task("frames", total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def _summarise(out: Path) -> None:
    """What was found on standard output, and what went wrong on standard error."""
    from stereo_ore.cli.closing import Closing
    from stereo_ore.io.results import Results

    closing = Closing(Results(out).each_record())
    closing.complain()
    totals = closing.totals
    if totals["frames"] == 1:
        _show(closing.last, out)
    statuses = ("ok", "degraded", "empty", "failed")
    summary = ", ".join(f"{totals[status]} {status}" for status in statuses if totals[status])
    found = f"{totals['ores']} ores, {totals['targets']} targets{closing.withheld}"
    typer.echo(f"{_frames(totals['frames'])} ({summary}), {found}: {out}")
    closing.check_usable()


def _show(frame: Json, out: Path) -> None:
    """The ores of a run's only frame."""
    from rich.console import Console

    if frame["ores"]:
        console = Console()
        console.width = max(console.width, TABLE_WIDTH)
        console.print(_ore_table(frame))
    if (overlay := out / "overlays" / f"{frame['frame']}.png").is_file():
        typer.echo(f"overlay: {overlay}")


def _frames(count: int) -> str:
    return f"{count} frame{'s' * (count != 1)}"


def _ore_table(frame: dict[str, Any]) -> Any:
    """The ores of one frame as a table for people, targets first."""
    from rich.table import Table

    base = "arm" if frame["arm_frame"] else "camera"
    table = Table(title=f"frame {frame['frame']}: {frame['status']}")
    for heading in (
        "target",
        "ore",
        "size [mm]",
        "volume [l]",
        f"centre of gravity, {base} [m]",
        "± [mm]",
        "oversize",
    ):
        table.add_column(heading)
    table.add_column(f"strike, {base} [m]")
    rank = {ore: place for place, ore in enumerate(frame["targets"], 1)}
    for ore in sorted(
        frame["ores"], key=lambda ore: (rank.get(ore["id"], len(rank) + 1), ore["id"])
    ):
        table.add_row(str(rank.get(ore["id"], "")), *_ore_cells(ore, base))
    return table


def _ore_cells(ore: dict[str, Any], base: str) -> tuple[str, ...]:
    centre, strike = ore["centre_of_gravity"], ore["strike"]
    size = " × ".join(f"{1000 * length:.0f}" for length in ore["size_m"]) if ore["size_m"] else ""
    volume = f"{1000 * ore['volume_m3']:.2f}" if ore["volume_m3"] is not None else ""
    sigma = f"{1000 * max(centre['sigma_m']):.0f}" if centre else ""
    oversize = {True: "yes", False: "no", None: "?"}[ore["oversize"]]
    where = (
        _vector(strike["point"][base])
        if strike
        else ", ".join(sorted({r["code"] for r in ore["reasons"]}))
    )
    return (
        str(ore["id"]),
        size,
        volume,
        _vector(centre[base]) if centre else "",
        sigma,
        oversize,
        where,
    )


def _vector(values: list[float]) -> str:
    return " ".join(f"{value:+.3f}" for value in values)
