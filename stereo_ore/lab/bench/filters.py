"""`bench filter`: quality of all filters on labelled clouds, and time against Open3D's simplest
filter.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from stereo_ore.config import FilterConfig
from stereo_ore.lab.bench.baselines import CONTENDERS, Contender
from stereo_ore.lab.bench.labelled import LabelledCloud, bare_cloud
from stereo_ore.stages import filters
from stereo_ore.types import VoxelCloud

SHIPPED = ("radius", "statistical", "lof", "paper", "paper-tuned", "closed-form", "adaptive")
"""Judged on clean clouds with their default parameters: there is no best of a grid where nothing is
to be found."""


@dataclass(frozen=True)
class _Row:
    """One filter on one cloud; shares are 0…1. `noise_left` is among the kept; `bars_kept` of the
    bars' good points.
    """

    cloud: str
    cell: str
    filter: str
    setting: str
    points: int
    noise_share: float
    precision: float
    recall: float
    retention: float
    f1: float
    noise_left: float
    bars_kept: float | None


def judge_filter(labelled: LabelledCloud, contender: Contender) -> _Row:
    """The best that a contender may show on a cloud."""
    judged = slice(None) if labelled.judged is None else labelled.judged
    noise = labelled.is_noise[judged]
    setting, quality, removed = contender.best(labelled.voxels, noise, judged)
    kept_noise = noise.sum() * (1 - quality.recall)
    kept = kept_noise + (~noise).sum() * quality.retention
    bars = None if labelled.on_bar is None else labelled.on_bar[judged] & ~noise
    bars_kept = None if bars is None or not bars.any() else float((~removed[bars]).mean())
    left = float(kept_noise / max(kept, 1))
    return _Row(
        labelled.name, labelled.cell, contender.label, setting, len(noise), float(noise.mean()),
        **quality.as_dict(), noise_left=left, bars_kept=bars_kept,
    )  # fmt: skip


def judge_filters(
    clouds: Iterable[LabelledCloud], contenders: Sequence[Contender] = CONTENDERS
) -> list[_Row]:
    """Every contender on every cloud."""
    return [judge_filter(labelled, contender) for labelled in clouds for contender in contenders]


def judge_clean(clouds: Iterable[LabelledCloud]) -> list[dict[str, Any]]:
    """Share of each clean cloud that each filter removes as shipped; means over clouds of one
    cell.
    """
    found: dict[str, list[dict[str, float]]] = {}
    for labelled in clouds:
        kept = {
            name: filters.apply(labelled.voxels, FilterConfig(method=name)).keep for name in SHIPPED
        }
        found.setdefault(labelled.cell, []).append(
            {name: 1 - float(mask.mean()) for name, mask in kept.items()}
        )
    return [
        {"cell": cell, **{m: float(np.mean([r[m] for r in rows])) for m in SHIPPED}}
        for cell, rows in found.items()
    ]


def means(rows: Sequence[_Row]) -> list[dict[str, Any]]:
    """Mean figures of each filter in each cell, in order of appearance."""
    keys = list(dict.fromkeys((row.cell, row.filter) for row in rows))
    return [_mean([row for row in rows if (row.cell, row.filter) == key]) for key in keys]


def _mean(rows: Sequence[_Row]) -> dict[str, Any]:
    out: dict[str, Any] = {"cell": rows[0].cell, "filter": rows[0].filter, "clouds": len(rows)}
    for name in (
        "noise_share",
        "precision",
        "recall",
        "retention",
        "f1",
        "noise_left",
        "bars_kept",
    ):
        values = [value for row in rows if (value := asdict(row)[name]) is not None]
        out[name] = float(np.mean(values)) if values else None
    return out


def summary(cells: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Mean over the cells of each filter's F1, and of the best tuned baseline's in each cell."""
    names = list(dict.fromkeys(cell["filter"] for cell in cells))
    f1 = {name: float(np.mean([c["f1"] for c in cells if c["filter"] == name])) for name in names}
    tuned = {contender.label for contender in CONTENDERS if contender.tuned}
    by_cell = list(dict.fromkeys(cell["cell"] for cell in cells))
    best = [
        max(c["f1"] for c in cells if c["cell"] == name and c["filter"] in tuned)
        for name in by_cell
    ]
    return {"f1": f1, "best_tuned_baseline_f1": float(np.mean(best))}


def large_cloud(points: int = 1_000_000) -> VoxelCloud:
    """A bent surface at random, a fiftieth of whose points are off it."""
    rng = np.random.default_rng(0)
    xy = rng.uniform(0, 1, (points, 2))
    z = 0.03 * np.sin(9 * xy[:, 0]) * np.cos(7 * xy[:, 1]) + rng.normal(0, 2e-4, points)
    return bare_cloud(
        np.column_stack(
            [xy, z + np.where(rng.random(points) < 0.02, rng.normal(0, 0.01, points), 0)]
        )
    )


def speed(voxels: VoxelCloud, k: int = 16, repeats: int = 7) -> dict[str, float]:
    """Best of some runs in milliseconds, taken in turn with Open3D's statistical filter of the same
    K.
    """
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(voxels.xyz.astype(float)))
    tasks: dict[str, Callable[[], object]] = {
        "open3d_statistical": lambda: cloud.remove_statistical_outlier(k, 1.0),
        "adaptive": lambda: filters.apply(voxels, FilterConfig(params={"k": k})),
        "paper": lambda: filters.apply(
            voxels, FilterConfig(method="paper", params={"k0": k, "k_max": k})
        ),
    }
    best = dict.fromkeys(tasks, float("inf"))
    for _ in range(repeats):
        for name, task in tasks.items():
            start = time.perf_counter()
            task()
            best[name] = min(best[name], 1000 * (time.perf_counter() - start))
    return {"points": len(voxels), "k": k, **best}
