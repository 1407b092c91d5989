"""When frames were taken, and where that is known from."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

from stereo_ore.io.recordings.names import name_stamp, split_name
from stereo_ore.types import StampSource

TABLE = "data.csv"
"""EuRoC's and TUM-VI's table of stamps, beside the folder of the images."""


class Stamp(NamedTuple):
    """A time [ns since 1970, UTC] and where it is from."""

    ns: int
    source: StampSource


def file_stamp(name: str, files: Iterable[Path]) -> Stamp | None:
    """The stamp of a frame of image files: its name's, that of the first one's name but for the
    eye, or else when that was last changed.
    """
    files = list(files)
    for each in (name, *(split_name(file.stem)[1] for file in files[:1])):
        if (named := name_stamp(each)) is not None:
            return Stamp(named, "file name")
    for file in files:
        try:
            return Stamp(file.stat().st_mtime_ns, "modification time")
        except OSError:
            continue
    return None


def stamp_table(folder: Path) -> Mapping[str, int]:
    """Stamps [ns] by name of file, from the table that belongs to a folder of images; empty where
    there is none.

    A row is a stamp in nanoseconds and a name; lines that begin with ``#`` are comments.
    """
    stamps: dict[str, int] = {}
    for path in (folder / TABLE, folder.parent / TABLE):
        try:
            with path.open(encoding="utf-8", errors="replace", newline="") as lines:
                for row in csv.reader(lines):
                    stamp = row[0].strip() if len(row) == 2 else ""
                    if stamp.isdecimal() and stamp.isascii() and len(stamp) <= 19:
                        stamps[row[1].strip()] = int(stamp)
        except (OSError, csv.Error):
            continue
        if stamps:
            break
    return {name: stamp for name, stamp in stamps.items() if stamp < 2**63}
