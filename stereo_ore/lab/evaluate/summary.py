"""Figures of many frames pooled, and the table that people read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

_Row = dict[str, Any]


def pool_scenes(rows: Sequence[_Row]) -> dict[str, float]:
    """Medians over lumps or scenes, means of filter figures, shares of counts; NaN where nothing
    counts.
    """
    filters, matches, ores = ([row[key] for row in rows] for key in ("filter", "match", "ores"))
    best = [
        max(row["baseline"][k]["f1"] for k in ("statistical", "radius"))
        for row in rows
        if row["baseline"]
    ]
    xy, z, relative, volume, size = (
        _pooled(rows, "solid", k) for k in ("cog_xy", "cog_z", "cog_rel", "volume", "size")
    )
    return {
        "scenes": len(rows),
        "match_valid": _median([m["valid"] for m in matches]),
        "match_bad1": _median([m["bad1"] for m in matches]),
        "filter_f1": _mean([f["f1"] for f in filters]),
        "filter_recall": _mean([f["recall"] for f in filters]),
        "filter_retention": _mean([f["retention"] for f in filters]),
        "noise_left": _mean([f["noise_left"] for f in filters]),
        "best_baseline_f1": _mean(best),
        "iou": _mean([o["iou"] for o in ores if o["iou"] is not None]),
        "recall50": _share(ores, "hit", "wanted"),
        "precision50": 1 - _share(ores, "false", "predicted"),
        "on_tool": sum(o["on_tool"] for o in ores),
        "false_ores": sum(o["false"] for o in ores),
        "oversize_recall": _share(ores, "oversize_hit", "oversize"),
        "oversize_flag": _share(ores, "flag_ok", "flag_n"),
        "cog_xy_mm": _median(xy),
        "cog_xy_p90_mm": _median(xy, 90),
        "cog_z_mm": _median(z),
        "cog_rel": _median(relative),
        "cog_inside_2_sigma": _mean(_lumps(rows, "inside_2_sigma")),
        "volume_rel": _median(volume),
        "volume_inside_bounds": _mean(_lumps(rows, "inside_bounds")),
        "size_rel": _median(size),
        "strike_mm": _median(_pooled(rows, "strike", "distance")),
        "strike_deg": _median(_pooled(rows, "strike", "angle")),
        "ms": _median([row["ms"] for row in rows if row.get("ms")]),
    }


def _pooled(rows: Sequence[_Row], group: str, key: str) -> list[float]:
    return [value for row in rows for value in row[group][key]]


def _lumps(rows: Sequence[_Row], key: str) -> list[float]:
    return [lump[key] for row in rows for lump in row["lumps"] if key in lump]


def _share(rows: Sequence[_Row], part: str, whole: str) -> float:
    return float(sum(row[part] for row in rows) / max(sum(row[whole] for row in rows), 1))


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def _median(values: Sequence[float], percent: float = 50) -> float:
    finite = np.array([v for v in values if np.isfinite(v)])
    return float(np.percentile(finite, percent)) if len(finite) else float("nan")


def summary_table(rows: Sequence[_Row]) -> list[list[str]]:
    """Heading and a line of cells a scene; a dash where nothing counts."""
    return [list(_cells(rows[0]))] + [list(_cells(row).values()) for row in rows] if rows else []


def _cells(row: _Row) -> dict[str, str]:
    match, quality, ores, solid, strike = (
        row[key] for key in ("match", "filter", "ores", "solid", "strike")
    )
    shares = {
        "valid %": match["valid"], "bad1 %": match["bad1"], "Pr %": quality["precision"],
        "Recall %": quality["recall"], "Retain %": quality["retention"], "F1 %": quality["f1"],
        "noise left %": quality["noise_left"],
        "IoU %": np.nan if ores["iou"] is None else ores["iou"],
        "volume %": _median(solid["volume"]), "size %": _median(solid["size"]),
    }  # fmt: skip
    lengths = {
        "xy mm": _median(solid["cog_xy"]), "z mm": _median(solid["cog_z"]),
        "strike mm": _median(strike["distance"]), "strike °": _median(strike["angle"]),
    }  # fmt: skip
    counts = {"hit": f"{ores['hit']}/{ores['wanted']}", "false": str(ores["false"])}
    percent = {key: _number(100 * value) for key, value in shares.items()}
    return (
        {"scene": row["scene"]}
        | counts
        | percent
        | {key: _number(value) for key, value in lengths.items()}
    )


def _number(value: float) -> str:
    return f"{value:.1f}" if np.isfinite(value) else "–"
