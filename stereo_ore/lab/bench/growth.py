"""How the filter's time and memory grow with the number of points, beside the filters of Open3D and
scikit-learn.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context

import numpy as np

from stereo_ore.config import FilterConfig
from stereo_ore.lab.bench.labelled import bare_cloud
from stereo_ore.lab.bench.memory import peak_mb, sampled
from stereo_ore.stages import filters
from stereo_ore.types import F32

K = 16
NOISE_SHARE = 0.15
_ROUNDS = 3
ONCE_FROM = 1_000_000
SPACING_M = 0.001
"""Of the cloud's points; also where radii come from."""

LOF = "scikit-learn LOF"
LARGEST_LOF = 1_000_000
"""Above this it takes many minutes and gigabytes."""


@dataclass(frozen=True)
class GrowthRow:
    """One filter at one number of points: the median of some runs, or None where it was left out.

    `extra_mb` is by how much the resident set grew at most.
    """

    filter: str
    points: int
    seconds: float | None
    extra_mb: float | None


def rough_surface(points: int, seed: int = 0) -> F32:
    """A wavy surface of about one point a square millimetre with noise off it, (points, 3) [m], in
    random order.
    """
    rng = np.random.default_rng(seed)
    side = SPACING_M * np.sqrt(points)
    xyz = rng.uniform(0, side, (points, 3))
    xyz[:, 2] = 0.05 * np.sin(xyz[:, 0] / 0.05) * np.cos(xyz[:, 1] / 0.07) + rng.normal(
        0, 0.0003, points
    )
    noise = rng.random(points) < NOISE_SHARE
    xyz[noise] += rng.normal(0, 0.008, (int(noise.sum()), 3))
    return xyz.astype(np.float32)


def measure_growth(sizes: Sequence[int], limit_s: float) -> list[GrowthRow]:
    """All filters at all sizes; a filter whose next size would take longer than `limit_s` is left
    out from there on.
    """
    rows: list[GrowthRow] = []
    last: dict[str, tuple[int, float]] = {}
    for points in sizes:
        names = [name for name in FILTERS if not _too_long(last.get(name), points, limit_s, name)]
        found = _in_own_process(points, names)
        last |= {
            row.filter: (points, row.seconds) for row in found.values() if row.seconds is not None
        }
        rows += [found.get(name, GrowthRow(name, points, None, None)) for name in FILTERS]
    return rows


def _too_long(last: tuple[int, float] | None, points: int, limit_s: float, name: str) -> bool:
    """Whether n log n growth from the `last` size, if there was any, would break the limit."""
    if name == LOF and points > LARGEST_LOF:
        return True
    return last is not None and last[1] * n_log_n(points) / n_log_n(last[0]) > limit_s


def n_log_n(points: int) -> float:
    """The growth of a search in a tree."""
    return float(points * np.log(points))


def _in_own_process(points: int, names: Sequence[str]) -> dict[str, GrowthRow]:
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(_measure, points, names).result()


def _measure(points: int, names: Sequence[str]) -> dict[str, GrowthRow]:
    """Filters in turn, so that a busy machine slows all alike; clouds of a million points and more
    only once.
    """
    xyz = rough_surface(points)
    tasks = {name: FILTERS[name](xyz) for name in names}
    runs: dict[str, list[tuple[float, float | None]]] = {name: [] for name in names}
    for _ in range(_ROUNDS if points < ONCE_FROM else 1):
        for name, task in tasks.items():
            runs[name].append(_cost(task))
    return {
        name: GrowthRow(name, points, float(np.median([s for s, _ in r])), r[0][1])
        for name, r in runs.items()
    }


def _cost(task: Callable[[], object]) -> tuple[float, float | None]:
    """Seconds, and by how many MB the resident set grew."""
    took: list[float] = []

    def timed() -> None:
        start = time.perf_counter()
        task()
        took.append(time.perf_counter() - start)

    samples = sampled(timed)
    peak = peak_mb(samples)
    return took[0], None if peak is None else peak - samples[0][1] / 1e6


def _ours(method: str) -> Filter:
    def prepare(xyz: F32) -> Callable[[], object]:
        cloud = bare_cloud(xyz)
        return lambda: filters.apply(cloud, FilterConfig(method=method))

    return prepare


def _open3d(method: str, *settings: float) -> Filter:
    def prepare(xyz: F32) -> Callable[[], object]:
        import open3d as o3d

        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(xyz.astype(float)))
        return lambda: getattr(cloud, method)(*settings)

    return prepare


def _sklearn_lof(xyz: F32) -> Callable[[], object]:
    from sklearn.neighbors import LocalOutlierFactor

    return lambda: LocalOutlierFactor(n_neighbors=K, n_jobs=-1).fit_predict(xyz)


Filter = Callable[[F32], Callable[[], object]]
"""Makes ready for a cloud what is then timed."""

FILTERS: dict[str, Filter] = {
    "adaptive": _ours("adaptive"),
    "paper": _ours("paper"),
    "Open3D statistical": _open3d("remove_statistical_outlier", K, 1.0),
    "Open3D radius": _open3d("remove_radius_outlier", K, 3 * SPACING_M),
    LOF: _sklearn_lof,
}
