"""Ores as rows: what a record's ores look like in ores.csv and, with more columns, in Parquet."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from stereo_ore.times import utc
from stereo_ore.types import Json

FIELDS = (
    "frame",
    "id",
    "target_rank",
    "oversize",
    "cut",
    *(f"{name}_{axis}_m" for name in ("cog_camera", "cog_arm", "cog_sigma") for axis in "xyz"),
    "volume_m3",
    *(f"size_{name}_m" for name in ("longest", "middle", "shortest")),
    *(f"strike_{frame}_{axis}_m" for frame in ("camera", "arm") for axis in "xyz"),
    *(f"direction_{frame}_{axis}" for frame in ("camera", "arm") for axis in "xyz"),
    "slope_deg",
    "points",
    "pixels",
    "reasons",
    "stamp_utc",
    "stamp_source",
    "track",
)
"""Columns of ores.csv; units are in the names."""


def ores_csv(frames: Path) -> Iterator[str]:
    """A line an ore from the records of a run, after one with the columns' names."""
    yield _csv_line(FIELDS)
    with frames.open(encoding="utf-8") as lines:
        for line in lines:
            frame = json.loads(line)
            for ore in frame["ores"]:
                row = ore_row(frame, ore)
                row["reasons"] = " ".join(row["reasons"])
                yield _csv_line(row.get(name) for name in FIELDS)


def _csv_line(values: Iterable[Any]) -> str:
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerow(values)
    return buffer.getvalue()


def ore_row(frame: Json, ore: Json) -> Json:
    """The values of `FIELDS` that an ore of a record has; reasons are a list of codes."""
    rank = frame["targets"].index(ore["id"]) + 1 if ore["id"] in frame["targets"] else None
    row = {key: ore[key] for key in ("id", "oversize", "cut", "volume_m3", "points", "pixels")}
    row |= {
        "frame": frame["frame"],
        "target_rank": rank,
        "reasons": [r["code"] for r in ore["reasons"]],
        "stamp_utc": utc(frame["stamp_ns"]),
        "stamp_source": frame.get("stamp_source"),
        "track": track["number"] if (track := ore.get("track")) else None,
    }
    centre = ore["centre_of_gravity"] or {}
    for name, values in (
        ("camera", centre.get("camera")),
        ("arm", centre.get("arm")),
        ("sigma", centre.get("sigma_m")),
    ):
        row |= _vector(f"cog_{name}", "_m", values)
    row |= dict(
        zip(
            ("size_longest_m", "size_middle_m", "size_shortest_m"),
            ore["size_m"] or (),
            strict=False,
        )
    )
    if strike := ore["strike"]:
        row["slope_deg"] = strike["slope_deg"]
        for name in ("camera", "arm"):
            row |= _vector(f"strike_{name}", "_m", strike["point"][name])
            row |= _vector(f"direction_{name}", "", strike["direction"][name])
    return row


def _vector(prefix: str, suffix: str, values: list[float] | None) -> dict[str, float]:
    return {
        f"{prefix}_{axis}{suffix}": value for axis, value in zip("xyz", values or (), strict=False)
    }
