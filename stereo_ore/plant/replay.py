"""Recorded frames at the times at which they were taken."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from stereo_ore.io.results import Results
from stereo_ore.types import F64, Json

DEFAULT_PERIOD_S = 1.0
"""For a recording that knows neither stamps nor timings."""


def frames(folder: Path) -> Iterator[Json]:
    """Records of a finished or unfinished run, in order, without frames that were skipped.

    Raises
    ------
    SourceError
        When there are none, or a line is no record.
    """
    return (each for each in Results(folder).each_record() if each["status"] != "skipped")


def schedule(folder: Path, rate_hz: float | None, speed: float) -> Iterator[tuple[float, Json]]:
    """Each record with the time at which it is due, in seconds since the first.

    Parameters
    ----------
    folder : Path
        Folder of a run.
    rate_hz : float or None
        Frames a second; None: as the frames' stamps say or, without stamps, as long as each took to
        process.
    speed : float
        Times the recorded speed; has no meaning with a rate.
    """
    due_s, before_ns = 0.0, None
    timings = _timings(folder)
    for place, record in enumerate(frames(folder)):
        stamp_ns = record["stamp_ns"]
        if place and rate_hz:
            due_s += 1 / rate_hz
        elif place and stamp_ns is not None and before_ns is not None:
            due_s += max(0, stamp_ns - before_ns) / 1e9 / speed
        elif place:
            due_s += timings.get(record["frame"], DEFAULT_PERIOD_S) / speed
        yield due_s, record
        before_ns = stamp_ns


def saved_transform(folder: Path) -> F64 | None:
    """The arm-from-camera transform of the run's site file."""
    return Results(folder).site.T_arm_camera


def _timings(folder: Path) -> dict[str, float]:
    """Seconds that each frame took."""
    return {frame: entry["total_ms"] / 1000 for frame, entry in Results(folder).timings.items()}
