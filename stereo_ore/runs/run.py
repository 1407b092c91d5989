"""A whole run: the selected frames of a recording into a folder of results."""

from __future__ import annotations

import itertools
import logging
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stereo_ore.chain import Chain
from stereo_ore.errors import ConfigError, MissingExtraError, SourceError, StereoOreError
from stereo_ore.io.recordings import Source
from stereo_ore.runs import batch, cluster
from stereo_ore.runs.driver import Driver
from stereo_ore.runs.folder import FrameLines, RunFolder
from stereo_ore.runs.frame_files import FrameFiles
from stereo_ore.runs.history import Watch
from stereo_ore.runs.identity import InputFiles, description, write_inputs
from stereo_ore.stages import matching
from stereo_ore.types import Rig

_log = logging.getLogger(__name__)

Progress = Callable[[int, int], None]
"""Told after each frame how many of how many are done."""


@dataclass(frozen=True)
class RunOptions:
    """How a run is made: which frames, what is written, and by whom.

    `every` None takes each frame, or with `matching.fuse` one of as many as are measured together.
    `scheduler` is the address of a Dask scheduler whose workers take the place of `workers`.
    """

    start: int = 0
    stop: int | None = None
    every: int | None = None
    clouds: bool = True
    overlays: bool = True
    pictures: bool = False
    save_stages: bool = False
    report: bool = True
    resume: bool = False
    overwrite: bool = False
    strict: bool = False
    workers: int = 1
    scheduler: str | None = None
    arm_clouds: bool = False


def select(recording: Source, chain: Chain, options: RunOptions) -> range:
    """Indices of the frames of a run.

    Raises
    ------
    SourceError
        When none is selected.
    """
    step = options.every or chain.config.matching.fuse
    indices = range(len(recording.names))[options.start : options.stop : step]
    if not indices:
        count = len(recording.names)
        problem = f"has {count} frame{'s' * (count != 1)}, none of them selected"
        raise SourceError(problem, file=recording.path)
    return indices


def run_recording(
    recording: Source,
    chain: Chain,
    out: Path,
    options: RunOptions = RunOptions(),
    inputs: InputFiles = InputFiles(),  # noqa: B008 - immutable
    progress: Progress = lambda done, total: None,
) -> Path | None:
    """Process the selected frames into the folder `out`; the report, where one could be written.

    Raises
    ------
    StereoOreError
        As the command line tells them: an unknown layout, a folder of another run, a full disk …
    """
    indices = select(recording, chain, options)
    files = _frame_files(out, chain, options)
    job = batch.Job(recording, Driver(chain, files), options.strict)
    about = _description(recording, indices, chain, inputs)
    with RunFolder(out, about, resume=options.resume, overwrite=options.overwrite) as folder:
        write_inputs(out, chain, inputs)
        _do_frames(job, indices, folder, options, progress)
        folder.finish()
    return _report(out, recording, indices, chain) if options.report else None


def _frame_files(out: Path, chain: Chain, options: RunOptions) -> FrameFiles:
    arm = chain.site.T_arm_camera if options.arm_clouds else None
    if options.arm_clouds and arm is None:
        raise ConfigError(
            "is not known, so there are no clouds in the arm's frame",
            key="arm_from_camera",
            remedy="Give --site with it, or leave --arm-clouds out",
        )
    return FrameFiles(
        out, options.save_stages, options.pictures, options.clouds, options.overlays, arm
    )


def _do_frames(
    job: batch.Job, indices: range, folder: RunFolder, options: RunOptions, progress: Progress
) -> None:
    """Process what is left of the frames, on this machine or by the workers of a cluster."""
    done, total = folder.done, len(indices)
    todo = indices[done:]
    chain = job.driver.chain
    watch = Watch(chain.config, chain.site, folder.earlier())
    progress(done, total)
    with _stoppable():
        scheduler = options.scheduler
        each = (
            cluster.run_on_cluster(job, todo, scheduler)
            if scheduler
            else batch.run_in_batches(job, todo, options.workers)
        )
        judged = map(watch.judge, each)
        for count, lines in enumerate(_drawn(judged, job.driver.files, chain.rig), done + 1):
            folder.add(lines)
            progress(count, total)


def _drawn(judged: Iterator[FrameLines], files: FrameFiles, rig: Rig) -> Iterator[FrameLines]:
    """The lines of frames whose overlays are drawn, while a thread draws those of the next."""
    with ThreadPoolExecutor(1, "draw") as painter:
        waiting: deque[tuple[FrameLines, Future[None]]] = deque()
        fault: StereoOreError | None = None
        try:
            for lines in judged:
                waiting.append((lines, painter.submit(files.draw, lines, rig)))
                if len(waiting) > batch.WRITES_AHEAD:
                    yield _when_drawn(*waiting.popleft())
        except StereoOreError as error:
            fault = error
        yield from itertools.starmap(_when_drawn, waiting)
        if fault:
            raise fault


def _when_drawn(lines: FrameLines, drawing: Future[None]) -> FrameLines:
    drawing.result()
    return lines


@contextmanager
def _stoppable() -> Iterator[None]:
    """Say after Ctrl-C how to go on."""
    try:
        yield
    except KeyboardInterrupt:
        _log.warning("stopped; the same command with --resume continues")
        raise


def _description(
    recording: Source, indices: range, chain: Chain, inputs: InputFiles
) -> dict[str, Any]:
    region = chain.region
    search = {
        "rectangle_px": [region.x0, region.y0, region.x1, region.y1],
        "min_disparity_px": region.min_disparity,
        "num_disparities": region.num_disparities,
        "saved_share": matching.search_saved(chain.rig, region)["saved_share"],
    }
    return description(
        str(recording.path),
        chain,
        inputs,
        recording=dict(recording.description),
        frames=[indices.start, indices.stop, indices.step],
        search=search,
    )


def _report(out: Path, recording: Source, indices: range, chain: Chain) -> Path | None:
    from stereo_ore.report import write_report
    from stereo_ore.report.calibration import write_check

    check = write_check(out, recording, indices, chain.calibration)
    for finding in check["findings"] if check else ():
        _log.warning("calibration %s: %s", finding["severity"], finding["text"])
    try:
        return write_report(out)
    except MissingExtraError as error:
        _log.warning("no report.html: %s", error)
        return None
