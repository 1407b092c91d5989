"""Recorded frames at the times at which they were taken."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from stereo_ore.errors import SourceError
from stereo_ore.record import SCHEMA
from stereo_ore.site import load_site
from stereo_ore.types import F64

DEFAULT_PERIOD_S = 1.0
"""For a recording that knows neither stamps nor timings."""

Json = dict[str, Any]


def frames(folder: Path) -> Iterator[Json]:
    """Records of a finished or unfinished run, in order.

    Raises
    ------
    SourceError
        When there are none, or a line is no record.
    """
    file = _lines_file(folder, "frames")
    if file is None:
        raise SourceError("holds no frames.jsonl", file=folder, remedy="Name the --out folder of a run")
    for number, record in enumerate(_objects(file), 1):
        if record.get("schema") != SCHEMA:
            raise SourceError(f"line {number} is no record of {SCHEMA}", file=file, remedy="Repeat the run")
        yield record


def schedule(folder: Path, rate_hz: float | None, speed: float) -> Iterator[tuple[float, Json]]:
    """Each record with the time at which it is due, in seconds since the first.

    Parameters
    ----------
    folder : Path
        Folder of a run.
    rate_hz : float or None
        Frames a second; None: as the frames' stamps say or, without stamps, as long as each took to process.
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
    site = folder / "site.yaml"
    return load_site(site).T_arm_camera if site.is_file() else None


def _timings(folder: Path) -> dict[str, float]:
    """Seconds that each frame took."""
    file = _lines_file(folder, "timings")
    return {entry["frame"]: entry["total_ms"] / 1000 for entry in _objects(file)} if file else {}


def _lines_file(folder: Path, name: str) -> Path | None:
    candidates = (folder / f"{name}.jsonl", folder / f"{name}.jsonl.part")
    return next((file for file in candidates if file.is_file()), None)


def _objects(file: Path) -> Iterator[Json]:
    with file.open(encoding="utf-8") as lines:
        for number, line in enumerate(lines, 1):
            if not line.endswith("\n"):
                return  # cut off: the run is still being written, or was killed
            try:
                value = json.loads(line)
            except ValueError:
                value = None
            if not isinstance(value, dict):
                raise SourceError(f"line {number} is no JSON object", file=file, remedy="Repeat the run")
            yield value
