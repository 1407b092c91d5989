"""``stereo-ore run``: recorded pairs in, a folder of results out."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stereo_ore.errors import FrameError, MissingExtraError, SourceError

if TYPE_CHECKING:
    from stereo_ore.io.recordings import Source
    from stereo_ore.pipeline import Context
    from stereo_ore.runs.batch import Job
    from stereo_ore.runs.folder import RunFolder
    from stereo_ore.types import Site, StereoCalibration

log = logging.getLogger(__name__)

Json = dict[str, Any]

TABLE_WIDTH = 130
"""Columns of the table of ores where the output is no terminal."""


def register(app: typer.Typer) -> None:
    """Add the verb to the command line."""
    app.command()(run)


def run(
    source: Annotated[Path | None, typer.Argument(help="Recording: folder or file in any known layout.")] = None,
    calib: Annotated[
        Path | None, typer.Option("--calib", help="Calibration of the camera; a bag may carry its own.")
    ] = None,
    out: Annotated[Path, typer.Option("--out", help="Folder for the results.")] = ...,  # type: ignore[assignment]
    site: Annotated[Path | None, typer.Option(help="Site: arm, working volume, grizzly.")] = None,
    config: Annotated[Path | None, typer.Option(help="Parameters that differ from the defaults.")] = None,
    settings: Annotated[list[str] | None, typer.Option("--set", help="One parameter: key.sub=value.")] = None,
    left: Annotated[Path | None, typer.Option(help="Left image, video or folder, instead of SOURCE.")] = None,
    right: Annotated[Path | None, typer.Option(help="Right image, video or folder, instead of SOURCE.")] = None,
    left_topic: Annotated[str | None, typer.Option(help="Left image topic of a bag.")] = None,
    right_topic: Annotated[str | None, typer.Option(help="Right image topic of a bag.")] = None,
    max_skew_ms: Annotated[float, typer.Option(min=0, help="Largest difference of the stamps of a pair.")] = 5.0,
    start_time: Annotated[
        str | None, typer.Option("--start-time", metavar="TIME", help="When the first frame was taken: ISO 8601.")
    ] = None,
    fps: Annotated[
        float | None, typer.Option(min=0.001, help="Frames a second, instead of the recorded times.")
    ] = None,
    report: Annotated[
        bool, typer.Option("--report/--no-report", help="Check the calibration, write report.html.")
    ] = True,
    save_stages: Annotated[bool, typer.Option("--save-stages", help="Also write stages/FRAME.npz.")] = False,
    pictures: Annotated[bool, typer.Option("--pictures", help="Also write pictures/FRAME.png: ores in space.")] = False,
    clouds: Annotated[bool, typer.Option("--clouds/--no-clouds", help="Write clouds/FRAME.ply.")] = True,
    overlays: Annotated[bool, typer.Option("--overlays/--no-overlays", help="Write overlays/FRAME.png.")] = True,
    start: Annotated[int, typer.Option(min=0, help="First frame, counted from 0.")] = 0,
    stop: Annotated[int | None, typer.Option(min=0, help="Frame to stop before.")] = None,
    every: Annotated[
        int | None, typer.Option(min=1, help="Take each n-th frame; 1, or as many as are fused.", show_default=False)
    ] = None,
    fuse: Annotated[int | None, typer.Option(min=1, help="Measure so many frames of a still scene as one.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue a run that was stopped.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a different run in --out.")] = False,
    strict: Annotated[bool, typer.Option("--strict", help="Stop at the first frame that fails.")] = False,
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Dask scheduler whose workers do the frames: tcp://host:8786.")
    ] = None,
) -> None:
    """Recorded pairs → ore point sets, centres of gravity, targets.

    Example: `stereo-ore run recording --calib calib/zed2_hd720.yaml --site site.yaml --out out`
    """
    from stereo_ore import pipeline
    from stereo_ore.draw import figures
    from stereo_ore.io.parameters import load_config
    from stereo_ore.io.recordings import describe, expect_eyes, limit_pixels
    from stereo_ore.io.recordings.retimed import parse_time, retime
    from stereo_ore.io.site import load_site
    from stereo_ore.runs import batch
    from stereo_ore.runs.folder import RunFolder
    from stereo_ore.runs.frame_files import FrameFiles
    from stereo_ore.types import Site

    if scheduler and workers > 1:
        raise typer.BadParameter("give one of --workers and --scheduler")
    if pictures:
        figures.require_matplotlib()
    settings = [*(settings or ()), *([f"matching.fuse={fuse}"] if fuse else [])]
    parameters = load_config(config, settings)
    recording = _open(source, left, right, (left_topic, right_topic), max_skew_ms)
    recording = limit_pixels(recording, parameters.source.max_pixels)
    calibration = _calibration(recording, calib)
    log.info("%s", describe(recording))
    recording = expect_eyes(recording, calibration.image_size)
    recording = retime(recording, None if start_time is None else parse_time(start_time), fps)
    place = load_site(site) if site else Site()
    context = pipeline.make_context(calibration, place, parameters)
    indices = range(len(recording.names))[start : stop : every or context.config.matching.fuse]
    if not indices:
        raise SourceError(f"has {_frames(len(recording.names))}, none of them selected", file=recording.path)
    _announce(place, len(indices))
    job = batch.Job(recording, context, FrameFiles(out, save_stages, pictures, clouds, overlays), strict)
    description = _description(
        recording, indices, context, {"calib": calib, "site": site, "config": config, "background": place.background}
    )
    with RunFolder(out, description, resume=resume, overwrite=overwrite) as folder:
        _write_inputs(out, context, site)
        _do_frames(job, indices, folder, workers, scheduler)
        folder.finish()
    if report:
        _report(out, recording, indices, calibration)
    _summarise(out)


def _do_frames(job: Job, indices: range, folder: RunFolder, workers: int, scheduler: str | None) -> None:
    """What is left of the frames, into the folder, by processes of this machine or the workers of a cluster."""
    from stereo_ore.runs import batch, cluster
    from stereo_ore.runs.history import Watch

    todo = indices[folder.done :]
    watch = Watch(job.context.config.health, folder.earlier())
    with _progress(len(indices), folder.done) as advance, _stoppable():
        for lines in cluster.run(job, todo, scheduler) if scheduler else batch.run(job, todo, workers):
            folder.add(watch.judge(lines))
            advance()


def _open(
    source: Path | None,
    left: Path | None,
    right: Path | None,
    topics: tuple[str | None, str | None],
    max_skew_ms: float,
) -> Source:
    from stereo_ore.io.recordings import BagOptions, open_source, open_two_files

    if left and right and source is None:
        return open_two_files(left, right, max_skew_ms)
    if source is None or left or right:
        raise typer.BadParameter("give either SOURCE or both --left and --right")
    match topics:
        case (None, None):
            return open_source(source, BagOptions(None, max_skew_ms))
        case (str(left_topic), str(right_topic)):
            return open_source(source, BagOptions((left_topic, right_topic), max_skew_ms))
    raise typer.BadParameter("give both --left-topic and --right-topic, or neither")


def _calibration(recording: Source, calib: Path | None) -> StereoCalibration:
    """The calibration given or, without one, that of the recording."""
    from stereo_ore.io.calibration import load

    if calib:
        return load(calib, image_size=_frame_size(recording))
    if recording.calibration is None:
        raise SourceError("carries no calibration", file=recording.path, remedy="Give one with --calib")
    log.info("calibration: camera_info of the recording")
    return recording.calibration


def _frame_size(recording: Source) -> tuple[int, int] | None:
    """Width and height of the first frame that can be read: some calibration files hold several resolutions."""
    for index in range(len(recording.names)):
        try:
            left = recording.read(index).left
        except FrameError:
            continue
        return left.shape[1], left.shape[0]
    return None


def _announce(site: Site, frames: int) -> None:
    log.info("%s", _frames(frames))
    if site.T_arm_camera is None:
        log.warning("no arm_from_camera in a site file: positions are in the camera frame only, not for an arm")
    if site.opening_m is None:
        log.warning("no grizzly opening in a site file: oversize stays unknown where it can't be measured")


def _description(recording: Source, indices: range, context: Context, files: dict[str, Path | None]) -> dict[str, Any]:
    from stereo_ore.runs.batch import sha256
    from stereo_ore.runs.folder import versions
    from stereo_ore.stages import matching

    region = context.region
    return {
        "schema": "stereo_ore/run/1",
        "versions": versions(),
        "source": str(recording.path),
        "recording": dict(recording.description),
        "frames": [indices.start, indices.stop, indices.step],
        "parameters": context.config.model_dump(mode="json"),
        "files": {key: {"path": str(path), "sha256": sha256(path)} for key, path in files.items() if path},
        "search": {
            "rectangle_px": [region.x0, region.y0, region.x1, region.y1],
            "min_disparity_px": region.min_disparity,
            "num_disparities": region.num_disparities,
            "saved_share": matching.search_saved(context.rectifier.rig, region)["saved_share"],
        },
    }


def _write_inputs(out: Path, context: Context, site: Path | None) -> None:
    from stereo_ore.io.atomic import write_bytes, write_text
    from stereo_ore.io.calibration import dump
    from stereo_ore.io.parameters import dump_config

    write_text(out / "config.yaml", dump_config(context.config))
    write_text(out / "calibration.yaml", dump(context.calibration))
    if site:
        write_bytes(out / "site.yaml", site.read_bytes())


def _report(out: Path, recording: Source, indices: range, calibration: StereoCalibration) -> None:
    from stereo_ore.report import write_report
    from stereo_ore.report.calibration import write_check

    check = write_check(out, recording, indices, calibration)
    for finding in check["findings"] if check else ():
        log.warning("calibration %s: %s", finding["severity"], finding["text"])
    try:
        typer.echo(f"report: {write_report(out)}")
    except MissingExtraError as error:
        log.warning("no report.html: %s", error)


@contextmanager
def _stoppable() -> Iterator[None]:
    """Say after Ctrl-C how to go on."""
    try:
        yield
    except KeyboardInterrupt:
        log.warning("stopped; the same command with --resume continues")
        raise


@contextmanager
def _progress(total: int, done: int) -> Iterator[Any]:
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

    shown = sys.stderr.isatty() and log.isEnabledFor(logging.INFO)
    columns = (TextColumn("frames"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), disable=not shown) as bar:
        task = bar.add_task("frames", total=total, completed=done)
        yield lambda: bar.advance(task)


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
    found = f"{totals['ores']} ores, {totals['targets']} targets"
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
    for heading in ("target", "ore", "size [mm]", "volume [l]", f"centre of gravity, {base} [m]", "± [mm]", "oversize"):
        table.add_column(heading)
    table.add_column(f"strike, {base} [m]")
    rank = {ore: place for place, ore in enumerate(frame["targets"], 1)}
    for ore in sorted(frame["ores"], key=lambda ore: (rank.get(ore["id"], len(rank) + 1), ore["id"])):
        table.add_row(str(rank.get(ore["id"], "")), *_ore_cells(ore, base))
    return table


def _ore_cells(ore: dict[str, Any], base: str) -> tuple[str, ...]:
    centre, strike = ore["centre_of_gravity"], ore["strike"]
    size = " × ".join(f"{1000 * length:.0f}" for length in ore["size_m"]) if ore["size_m"] else ""
    volume = f"{1000 * ore['volume_m3']:.2f}" if ore["volume_m3"] is not None else ""
    sigma = f"{1000 * max(centre['sigma_m']):.0f}" if centre else ""
    oversize = {True: "yes", False: "no", None: "?"}[ore["oversize"]]
    where = _vector(strike["point"][base]) if strike else ", ".join(sorted({r["code"] for r in ore["reasons"]}))
    return str(ore["id"]), size, volume, _vector(centre[base]) if centre else "", sigma, oversize, where


def _vector(values: list[float]) -> str:
    return " ".join(f"{value:+.3f}" for value in values)
