"""Records of runs as Parquet: a folder that grows with every run and is asked as one table, by
day.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stereo_ore.errors import MissingExtraError, OutputError
from stereo_ore.io.atomic import guarded, make_folder
from stereo_ore.io.ore_table import FIELDS, ore_row
from stereo_ore.io.results import Results
from stereo_ore.types import Json

if TYPE_CHECKING:
    import pyarrow as pa

_SCHEMA = "stereo_ore/parquet/2"
NO_DAY = "undated"
"""Folder of frames without a stamp. No folder is named key=value: readers disagree on the type of
such a date."""
EARLIER = "date=*"
"""Folders of version 1, whose date was in their names only: pandas can't read them when a date is
missing."""

_COUNTS = ("pixels", "disparities", "points", "voxels", "kept", "ores", "targets")
_UNITS = {"_m": "m", "_m3": "m³", "_deg": "degree"}
FRAMES_A_GROUP = 1000
"""Frames whose rows are held in memory, and written as one row group."""

_KEYS = {
    **dict.fromkeys(("run", "camera", "frame"), "string"),
    "index": "int64",
    "stamp_utc": "timestamp[ns]",
    "stamp_source": "string",
    "date": "date32",
}
_ORE_TYPES = {
    **dict.fromkeys(("id", "target_rank", "track"), "int32"),
    **dict.fromkeys(("points", "pixels"), "int64"),
    **dict.fromkeys(("oversize", "cut"), "bool"),
    "reasons": "list<string>",
}
TABLES = {
    "ores": {
        **_KEYS,
        **{name: _ORE_TYPES.get(name, "float64") for name in FIELDS if name not in _KEYS},
        **dict.fromkeys(
            ("volume_low_m3", "volume_high_m3", "strike_flatness_m", "strike_score"), "float64"
        ),
    },
    "frames": {
        **_KEYS,
        "status": "string",
        "reasons": "list<string>",
        "grizzly_source": "string",
        **dict.fromkeys(("grizzly_offset_m", "grizzly_rms_m", "grizzly_fines_share"), "float64"),
        **{f"grizzly_normal_{axis}": "float64" for axis in "xyz"},
        **dict.fromkeys(_COUNTS, "int64"),
    },
}
"""Columns and types of each table. Of a column that is null in all rows the type stays the same."""


def write_parquet(results: Results, folder: Path, camera: str | None = None) -> Path:
    """Add a run to `folder`: ``ores/YYYY-MM-DD/RUN.parquet`` and ``frames/…``; the path of the
    former.

    RUN is made from the run's parameters and the SHA-256 of its first frame, so a run that is added
    again, perhaps with more frames, takes its own place. `camera` tells cameras apart; without it
    the calibration's name does.

    Raises
    ------
    MissingExtraError
        Without the pyarrow package.
    OutputError
        When the folder can't be written, or holds tables of an earlier version.
    """
    try:
        import pyarrow  # noqa: F401
    except ImportError:
        raise MissingExtraError("pyarrow", "parquet") from None
    if old := next((path for table in TABLES for path in (folder / table).glob(EARLIER)), None):
        remedy = "Export every run again, into a new folder"
        raise OutputError(
            "is of an earlier version; new tables beside it can't be read as one",
            file=old,
            remedy=remedy,
        )
    run, label, records = run_id(results), camera or results.camera or "", results.each_record()
    with _files(folder, run) as files:
        while group := list(islice(records, FRAMES_A_GROUP)):
            for (table, day), rows in _rows(group, {"run": run, "camera": label}).items():
                files.write(table, day, rows)
    return folder


def run_id(results: Results) -> str:
    """Twelve characters that tell runs apart: the same for the same parameters and recording."""
    identity = [results.run.get("digest"), next(iter(results.inputs()), None)]
    return hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:12]


Place = tuple[str, str]
"""Table and day."""


def _rows(records: Iterable[Json], labels: Json) -> dict[Place, list[Json]]:
    found: dict[Place, list[Json]] = defaultdict(list)
    for record in records:
        stamp = record["stamp_ns"]
        date = None if stamp is None else datetime.fromtimestamp(stamp // 10**9, UTC).date()
        day = date.isoformat() if date else NO_DAY
        keys = labels | {
            "frame": record["frame"],
            "index": record["index"],
            "stamp_utc": stamp,
            "stamp_source": record.get("stamp_source"),
            "date": date,
        }
        found["frames", day].append(keys | _frame_row(record))
        # A day without ores has its empty table too: it was looked at.
        found["ores", day] += [_ore_row(record, ore) | keys for ore in record["ores"]]
    return found


def _frame_row(record: Json) -> Json:
    row = {"status": record["status"], "reasons": [reason["code"] for reason in record["reasons"]]}
    row |= {name: record["counts"][name] for name in _COUNTS}
    if grizzly := record["grizzly"]:
        row |= {f"grizzly_{key}": grizzly[key] for key in ("source", "offset_m", "rms_m")}
        row["grizzly_fines_share"] = grizzly.get("fines_share")
        row |= {
            f"grizzly_normal_{axis}": value
            for axis, value in zip("xyz", grizzly["normal"], strict=True)
        }
    return row


def _ore_row(record: Json, ore: Json) -> Json:
    low, high = ore["volume_bounds_m3"] or (None, None)
    row = ore_row(record, ore) | {"volume_low_m3": low, "volume_high_m3": high}
    if strike := ore["strike"]:
        row |= {"strike_flatness_m": strike["flatness_m"], "strike_score": strike["score"]}
    return row


class _Files:
    """The files of one run, written under temporary names that no reader of the folder takes for
    data.
    """

    def __init__(self, folder: Path, run: str) -> None:
        self.folder, self.run = folder, run
        self.writers: dict[Path, Any] = {}

    def write(self, table: str, day: str, rows: list[Json]) -> None:
        import pyarrow as pa
        from pyarrow import parquet

        schema = schema_of(table)
        path = self.folder / table / day / f"{self.run}.parquet"
        if path not in self.writers:
            make_folder(path.parent)
            guarded(
                path,
                lambda: self.writers.update(
                    {path: parquet.ParquetWriter(_part(path), schema, **OPTIONS)}
                ),
            )
        guarded(path, lambda: self.writers[path].write_table(pa.Table.from_pylist(rows, schema)))

    def close(self) -> None:
        for path, writer in self.writers.items():
            guarded(path, writer.close)

    def keep(self) -> None:
        """Give the files their names, and take away what an earlier export of the run had beside
        them.
        """
        for path in self.writers:
            guarded(path, lambda path=path: os.replace(_part(path), path))  # type: ignore[misc]
        for table in TABLES:
            for old in (
                set((self.folder / table).glob(f"*/{self.run}.parquet")) - self.writers.keys()
            ):
                guarded(old, old.unlink)

    def drop(self) -> None:
        for path in self.writers:
            _part(path).unlink(missing_ok=True)


OPTIONS: dict[str, Any] = {"compression": "zstd", "version": "2.6"}
"""Format version 2.6 holds nanoseconds."""


def _part(path: Path) -> Path:
    return path.with_name(f".{path.name}.tmp")


@contextmanager
def _files(folder: Path, run: str) -> Iterator[_Files]:
    """All files of a run, or none of them."""
    files = _Files(folder, run)
    try:
        yield files
        files.close()
        files.keep()
    except BaseException:
        files.drop()
        raise


def schema_of(table: str) -> pa.Schema:
    """Types of a table's columns; the metadata says the units."""
    import pyarrow as pa

    types = {"list<string>": pa.list_(pa.string()), "timestamp[ns]": pa.timestamp("ns")}
    fields = [
        pa.field(
            name, types[kind] if kind in types else pa.type_for_alias(kind), metadata=_unit(name)
        )
        for name, kind in TABLES[table].items()
    ]
    return pa.schema(fields, metadata={"schema": _SCHEMA, "table": table})


def _unit(name: str) -> dict[str, str] | None:
    unit = next((unit for suffix, unit in _UNITS.items() if name.endswith(suffix)), None)
    return {"unit": unit} if unit else None
