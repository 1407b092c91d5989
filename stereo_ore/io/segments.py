"""The parts of a run that went on for days: what is closed lies below ``segments``, each like a
run's folder; the newest part lies in the run's folder itself.
"""

from __future__ import annotations

import re
from pathlib import Path

FOLDER = "segments"
NAME = re.compile(r"\.?(\d{6,})_(\d{4}-\d\d-\d\d)", re.ASCII)
"""Number and day (UTC) of a segment; hidden while its files are being moved there."""


def name(number: int, day: str) -> str:
    """The folder's name of segment `number`, begun on `day` (``2026-11-30``)."""
    return f"{number:06d}_{day}"


def closed(folder: Path) -> list[Path]:
    """Folders of the segments of a run that are closed, or being closed, in order."""
    try:
        found = [(NAME.fullmatch(file.name), file) for file in (folder / FOLDER).iterdir()]
    except OSError:
        return []
    return sorted(
        (file for match, file in found if match and not file.is_symlink()), key=segment_number
    )


def segment_number(part: Path) -> int:
    """The number of a segment."""
    return int(part.name.lstrip(".").partition("_")[0])


def all_parts(folder: Path) -> list[Path]:
    """Folders of all parts of a run, in order."""
    return [*closed(folder), folder]


def line_files(folder: Path, kind: str) -> list[Path]:
    """Files of one kind of lines (``frames``, ``timings``, ``inputs``) of all parts, in order."""
    names = (f"{kind}.jsonl", f"{kind}.jsonl.part")
    return [
        next(file for file in files if file.is_file())
        for files in ([part / name for name in names] for part in all_parts(folder))
        if any(file.is_file() for file in files)
    ]
