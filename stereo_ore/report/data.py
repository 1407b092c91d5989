"""What the page shows, as JSON: all frames in brief, some in detail."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from stereo_ore.io.results import Results
from stereo_ore.report import cloud_view, pictures
from stereo_ore.times import utc
from stereo_ore.types import Json, Rig

DETAILED_FRAMES = 8
THUMBNAILS = 120
CLOUD_POINTS = 25_000
"""Points shown of a frame: a processor without a graphics card draws them in half a second."""

LISTED_FRAMES = 3000
"""Frames in the table; of more, as many spread evenly."""

LISTED_ORES = 15_000
"""Ores in tables of frames without a 3-D view: about 4 MB; of a run with more such frames have
none."""

_SIGNS = np.array(list(product((-1.0, 1.0), repeat=3)))
"""Corners of a cube; those of a square are the last two columns of the first four."""
_CLICK_SHARE = 0.02
"""Half the side of the square for a lump without a body, as a share of the picture's width."""
SIZE_POINTS = 6000
REASON_EXAMPLES = 40


def page_data(results: Results) -> dict[str, Any]:
    """All that the page's script needs; frames in brief and in detail go by their place among those
    listed.
    """
    records = results.records
    listed = [records[place] for place in _spread(len(records), LISTED_FRAMES)]
    detailed = _spread(len(listed), DETAILED_FRAMES)
    return {
        "run": _run(results),
        "opening_m": results.site.opening_m,
        "image_px": results.rig and [results.rig.width, results.rig.height],
        "frames": [_row(record, results.timings.get(record["frame"])) for record in listed],
        "frames_total": len(records),
        "statuses": dict(Counter(record["status"] for record in records)),
        "reasons": _reasons(records),
        "sizes": _sizes(records),
        "timings": _timings(results),
        "thumbnails": {
            str(place): _picture(results, listed[place], pictures.thumbnail)
            for place in sorted({*_spread(len(listed), THUMBNAILS), *detailed})
        },
        "details": {str(place): _detail(results, listed[place]) for place in detailed},
        "tables": _tables(listed, detailed, results.rig),
        "files": {
            name: text
            for name in ("config.yaml", "calibration.yaml", "site.yaml")
            if (text := results.text(name))
        },
        "check": results.calibration_check,
    }


def _spread(count: int, wanted: int) -> list[int]:
    """At most `wanted` places spread evenly over `count`, first and last among them."""
    return sorted(
        {int(place) for place in np.linspace(0, max(count - 1, 0), min(wanted, count)).round()}
    )


def _run(results: Results) -> dict[str, Any]:
    run = results.run
    keys = ("source", "recording", "versions", "search", "files")
    stamps = [record["stamp_ns"] for record in results.records if record["stamp_ns"] is not None]
    return {key: run[key] for key in keys if key in run} | {
        "finished": results.finished,
        "camera": results.camera,
        "from_utc": utc(min(stamps, default=None)),
        "to_utc": utc(max(stamps, default=None)),
    }


def _row(record: Json, timing: Json | None) -> dict[str, Any]:
    """A frame in the table."""
    sizes = [ore["size_m"][1] for ore in record["ores"] if ore["size_m"]]
    screen = record["grizzly"] or {}
    moved = screen.get("registration")
    return {
        "frame": record["frame"],
        "index": record["index"],
        "stamp_utc": utc(record["stamp_ns"]),
        "stamp_source": record.get("stamp_source"),
        "status": record["status"],
        "reasons": [f"{reason['code']}: {reason['detail']}" for reason in record["reasons"]],
        "ores": record["counts"]["ores"],
        "oversize": sum(ore["oversize"] is True for ore in record["ores"]),
        "targets": record["counts"]["targets"],
        "largest_m": max(sizes, default=None),
        "total_ms": timing["total_ms"] if timing else None,
        "bars_off_m": moved and moved["worst_m"],
        "fines_share": screen.get("fines_share"),
    }


def _reasons(records: Sequence[Json]) -> list[dict[str, Any]]:
    """Why frames or ores gave less than they might: how often each code, with an example."""
    counts: Counter[tuple[str, str]] = Counter()
    examples: dict[tuple[str, str], str] = {}
    for record in records:
        found = [("frame", record["frame"], reason) for reason in record["reasons"]]
        found += [
            ("ore", f"{record['frame']}, ore {ore['id']}", r)
            for ore in record["ores"]
            for r in ore["reasons"]
        ]
        for kind, where, reason in found:
            key = kind, reason["code"]
            counts[key] += 1
            examples.setdefault(key, f"{where}: {reason['detail']}")
    common = counts.most_common(REASON_EXAMPLES)
    return [
        {"of": key[0], "code": key[1], "count": count, "example": examples[key]}
        for key, count in common
    ]


def _sizes(records: Sequence[Json]) -> dict[str, list[Any]]:
    """Middle dimension of every ore over the frames: the size that sieving is about."""
    ores = [
        (place, ore["size_m"][1], ore["oversize"])
        for place, record in enumerate(records)
        for ore in record["ores"]
        if ore["size_m"]
    ]
    ores = ores[:: 1 + len(ores) // SIZE_POINTS]
    place, size, oversize = zip(*ores, strict=True) if ores else ((), (), ())
    return {"place": list(place), "middle_m": list(size), "oversize": list(oversize)}


def _timings(results: Results) -> dict[str, float]:
    """Median milliseconds of each stage over all frames that reached it."""
    stages: dict[str, list[float]] = {}
    for timing in results.timings.values():
        for stage, ms in timing["stages_ms"].items():
            stages.setdefault(stage, []).append(ms)
    return {stage: round(float(np.median(values)), 2) for stage, values in stages.items()}


def _tables(listed: Sequence[Json], detailed: Sequence[int], rig: Rig | None) -> dict[str, Any]:
    """Ores and targets of the frames that have no details, by place."""
    rest = {place: record for place, record in enumerate(listed) if place not in set(detailed)}
    if sum(len(record["ores"]) for record in rest.values()) > LISTED_ORES:
        return {}
    return {
        str(place): {
            "ores": [
                {
                    key: value
                    for key, value in _ore(ore, rig).items()
                    if key not in ("box", "surface_centroid")
                }
                for ore in record["ores"]
            ],
            "targets": record["targets"],
        }
        for place, record in rest.items()
    }


def _picture(results: Results, record: Json, convert: Callable[[Path], str | None]) -> str | None:
    path = results.overlay(record["frame"])
    return convert(path) if path else None


def _detail(results: Results, record: Json) -> dict[str, Any]:
    """A frame with picture, cloud and charts."""
    frame = record["frame"]
    cloud, timing = results.cloud(frame), results.timings.get(frame)
    detail: dict[str, Any] = {
        "counts": record["counts"],
        "losses": record.get("losses", []),
        "grizzly": record["grizzly"],
        "arm_frame": record["arm_frame"],
        "ores": [_ore(ore, results.rig) for ore in record["ores"]],
        "targets": record["targets"],
        "timings": timing["stages_ms"] if timing else None,
        "overlay": _picture(results, record, pictures.overlay),
    }
    if cloud is not None and len(cloud):
        detail |= cloud_view.cloud_views(
            cloud,
            results.stages(frame),
            results.rig,
            results.config.matching.sigma_px,
            CLOUD_POINTS,
        )
    return detail


def _ore(ore: Json, rig: Rig | None) -> Mapping[str, Any]:
    """An ore for the picture, the 3-D view and its table."""
    keys = ("id", "cut", "size_m", "volume_m3", "oversize", "box", "surface_centroid")
    strike, centre = ore["strike"], ore["centre_of_gravity"]
    return {key: ore[key] for key in keys} | {
        "centre": centre and {key: centre[key] for key in ("camera", "arm", "sigma_m")},
        "strike": strike
        and {key: strike[key] for key in ("point", "direction", "slope_deg", "score")},
        "reasons": [reason["code"] for reason in ore["reasons"]],
        "outline_px": rig and _outline(ore, rig),
    }


def _outline(ore: Json, rig: Rig) -> list[list[int]]:
    """Where in the picture a lump can be clicked: corners of its box, or of a square about the
    middle of what is seen of it.
    """
    if ore["box"]:
        box = ore["box"]["camera"]
        half = np.array(box["axes"]) * np.array(ore["box"]["extent_m"])[:, None] / 2
        corners = rig.project(np.array(box["centre"]) + _SIGNS @ half)
    else:
        middle = rig.project(ore["surface_centroid"]["camera"])
        corners = middle + _CLICK_SHARE * rig.width * _SIGNS[:4, 1:]
    corners = corners[np.isfinite(corners).all(1)]
    if len(corners) < 3:
        return []
    hull = cv2.convexHull(corners.astype(np.float32))[:, 0]
    clipped: list[list[int]] = (
        np.clip(np.rint(hull), 0, [rig.width, rig.height]).astype(int).tolist()
    )
    return clipped
