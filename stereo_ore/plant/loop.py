"""The loop of `serve`: a frame is recorded first and published then, so that no consumer can cost a
record.
"""

from __future__ import annotations

import json
import logging
import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path

from stereo_ore.io.results import Json, parse_record
from stereo_ore.plant.frames import LiveFrame, LiveSource, Position
from stereo_ore.plant.publisher import Publisher
from stereo_ore.plant.status import Status
from stereo_ore.runs.driver import Driver
from stereo_ore.runs.folder import FrameLines, RunFolder
from stereo_ore.runs.history import Watch

log = logging.getLogger(__name__)

Process = Callable[[LiveFrame], FrameLines]


def serve(
    source: LiveSource,
    process: Process,
    folder: RunFolder,
    publisher: Publisher,
    status: Status,
    stop: threading.Event,
) -> int:
    """Process frames until `stop` is set or the source ends; the number of frames done.

    Parameters
    ----------
    source : LiveSource
        Where frames come from.
    process : callable
        Turns a frame into its lines; a frame that can't be processed gives a record that says so.
    folder : RunFolder
        Open folder of results; its last whole record is where the run goes on.
    publisher : Publisher
        Open publisher of targets.
    status : Status
        Told of each frame, for the live page.
    stop : threading.Event
        Ends the loop after the frame in work.
    """
    done = 0
    for frame in source.frames(position(folder.folder), stop):
        lines = process(frame)
        folder.add(lines)
        record = json.loads(lines.record)
        if not frame.superseded:
            publisher.publish(record, frame.age_s)
        status.add(record, frame.age_s)
        _tell(record, frame)
        done += 1
    return done


def _tell(record: Json, frame: LiveFrame) -> None:
    """One line a frame; its fields are in `extra`, for a log that a program reads."""
    codes = [reason["code"] for reason in record["reasons"]]
    fields = {
        "frame": frame.name,
        "status": record["status"],
        "reasons": codes,
        "targets": len(record["targets"]),
    }
    fields["latency_ms"] = round(1000 * frame.age_s)
    reasons = f" ({', '.join(codes)})" if codes else ""
    text = "frame %s: %s%s, %d targets, %d ms after it arrived"
    log.info(
        text,
        frame.name,
        record["status"],
        reasons,
        fields["targets"],
        fields["latency_ms"],
        extra=fields,
    )


def processing(driver: Driver, watch: Watch) -> Process:
    """Processing of live frames by an unattended driver, each judged by those before it."""

    def process(frame: LiveFrame) -> FrameLines:
        result = driver.detect(frame.name, frame.index, lambda: [frame.read()], frame.stamp)
        return watch.judge(driver.finish(result, frame.files))

    return process


def position(folder: Path) -> Position:
    """Where the unfinished run in `folder` stands, from its last whole record."""
    part = folder / "frames.jsonl.part"
    if not part.is_file() or part.stat().st_size == 0:
        return Position()
    with part.open(encoding="utf-8", errors="replace", newline="\n") as lines:
        ((number, line),) = deque(enumerate(lines, 1), maxlen=1)
    record = parse_record(line, part, number)
    return Position(record["frame"], record["index"] + 1)
