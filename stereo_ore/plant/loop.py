"""The loop of `serve`: a frame is recorded first, so that no consumer can cost a record, published
then, and its cloud and pictures come last, so that no target waits for what people look at.
"""

from __future__ import annotations

import json
import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from stereo_ore.chain import no_counts
from stereo_ore.io.recordings.stamps import Stamp
from stereo_ore.plant.frames import LiveFrame, LiveSource
from stereo_ore.plant.live_folder import LiveFolder
from stereo_ore.plant.publisher import Publisher
from stereo_ore.plant.retention import Retention
from stereo_ore.plant.status import PlantStatus
from stereo_ore.runs.driver import Driver, frame_lines
from stereo_ore.runs.folder import FrameLines
from stereo_ore.runs.history import Watch, degraded
from stereo_ore.types import FrameResult, Json, Reason, Site, StereoPair

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Done:
    """The lines of a frame, and what writes its files once its targets are out."""

    lines: FrameLines
    write: Callable[[], None] = lambda: None


Process = Callable[[LiveFrame], Done]

GONE = Reason("RESULTS_GONE", "the folder of results is not there: nothing can be recorded")
DISK_FULL = "DISK_FULL"
"""Reason in messages while results can't be written, or not all of them."""


def serve(
    source: LiveSource,
    process: Process,
    folder: LiveFolder,
    publisher: Publisher,
    status: PlantStatus,
    stop: threading.Event,
    retention: Retention | None = None,
) -> int:
    """Process frames until `stop` is set or the source ends; the number of frames done.

    Parameters
    ----------
    source : LiveSource
        Where frames come from.
    process : callable
        Does a frame; one that can't be processed gives a record that says so.
    folder : LiveFolder
        Open folder of results; its last whole record is where the run goes on.
    publisher : Publisher
        Open publisher of targets.
    status : Status
        Told of each frame, for the live page.
    stop : threading.Event
        Ends the loop after the frame in work.
    retention : Retention
        Removes what is no longer kept; None: nothing is removed.
    """
    done = 0
    for arrived in source.frames(folder.position(), stop):
        frame = folder.named(arrived)
        made = _skipped(frame) if frame.skipped else process(frame)
        lines = _noted(made.lines, frame)
        folder.add(frame.name, lines)
        record = json.loads(lines.record)
        if folder.gone:
            record = degraded(record, [GONE])
        notes = (DISK_FULL,) if status.disk_fault and not folder.gone else ()
        if frame.told:
            publisher.publish(record, frame.age_s, notes)
        latency_s = frame.age_s
        made.write()
        if frame.told:
            publisher.show_files(record)
        status.add(record, latency_s if frame.told else None)
        _tell(record, latency_s)
        done += 1
        if retention:
            retention.sweep_when_due(at_once=bool(notes))
    return done


def _skipped(frame: LiveFrame) -> Done:
    """A frame that is not processed."""
    reason = Reason("OVERTAKEN", frame.skipped)
    stamp = frame.stamp or Stamp(frame.taken_ns or frame.arrived_ns, "arrival")
    result = FrameResult(frame.name, frame.index, stamp.ns, "skipped", (reason,), no_counts())
    return Done(frame_lines(replace(result, stamp_source=stamp.source), Site(), ()))


def _noted(lines: FrameLines, frame: LiveFrame) -> FrameLines:
    """The lines with what tells, after a restart, that the files of a frame are done."""
    entry = json.loads(lines.inputs)
    entry.setdefault("files", {})
    entry["files"] = {str(file): None for file in frame.files} | entry["files"]
    if frame.written_ns is not None:
        entry["written_ns"] = frame.written_ns
    return replace(lines, inputs=json.dumps(entry))


def _tell(record: Json, latency_s: float) -> None:
    """One line a frame; its fields are in `extra`, for a log that a program reads."""
    codes = [reason["code"] for reason in record["reasons"]]
    fields = {
        "frame": record["frame"],
        "status": record["status"],
        "reasons": codes,
        "targets": len(record["targets"]),
    }
    fields["latency_ms"] = round(1000 * latency_s)
    reasons = f" ({', '.join(codes)})" if codes else ""
    text = "frame %s: %s%s, %d targets, %d ms after it arrived"
    _log.info(
        text,
        record["frame"],
        record["status"],
        reasons,
        fields["targets"],
        fields["latency_ms"],
        extra=fields,
    )


def _write(driver: Driver, result: FrameResult, lines: FrameLines) -> None:
    driver.files.write(result)
    driver.files.draw(lines, driver.chain.rig)


def processing(driver: Driver, watch: Watch) -> Process:
    """Processing of live frames by an unattended driver, each judged by those before it."""

    def process(frame: LiveFrame) -> Done:
        def read() -> list[StereoPair]:
            return [replace(frame.read(), name=frame.name)]

        result = driver.detect(frame.name, frame.index, read, frame.stamp)
        lines = watch.judge(frame_lines(result, driver.chain.site, frame.files))
        return Done(lines, partial(_write, driver, result, lines))

    return process
