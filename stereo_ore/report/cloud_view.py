"""What the page shows of a cloud: points for the 3-D view, scores of the filter, expected depth
noise.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from stereo_ore.io import clouds
from stereo_ore.types import F64, Rig

SCORE_BINS = 60
NOISE_COLUMNS = 96
MILLIMETRE = 0.001
"""Points are sent as whole millimetres in 16 bits: ±32 m, finer than the screen."""


def cloud_views(
    cloud: clouds.Records,
    stages: Mapping[str, npt.NDArray[Any]] | None,
    rig: Rig | None,
    sigma_px: float,
    points: int,
) -> dict[str, Any]:
    """Points, score histogram and noise map of one frame.

    Parameters
    ----------
    cloud
        The filtered cloud: x y z [m], red green blue, ore_id, score.
    stages
        Arrays of all voxels, where the run kept them: then removed ones are in the histogram too.
    rig
        Geometry of the images, for the noise map.
    sigma_px
        Standard deviation of a disparity.
    points
        At most about this many are shown.
    """
    noise = None if rig is None else noise_map(clouds.xyz(cloud), rig, sigma_px)
    return {"points": pack_cloud(cloud, points), "scores": scores(cloud, stages), "noise": noise}


def pack_cloud(cloud: clouds.Records, points: int) -> dict[str, Any]:
    """Every n-th point as base64 of little-endian arrays: xyz int16 [mm], grey uint8, ore id
    uint16.
    """
    step = -(-len(cloud) // max(points, 1))
    some = cloud[::step]
    millimetres = np.clip(np.rint(clouds.xyz(some) / MILLIMETRE), -32767, 32767)
    grey = 0.299 * some["red"] + 0.587 * some["green"] + 0.114 * some["blue"]
    return {
        "count": len(some),
        "of": len(cloud),
        "xyz_mm": _base64(millimetres, "<i2"),
        "grey": _base64(grey, "u1"),
        "ore": _base64(np.clip(some["ore_id"], 0, 65535), "<u2"),
    }


def scores(cloud: clouds.Records, stages: Mapping[str, npt.NDArray[Any]] | None) -> dict[str, Any]:
    """Histogram of the filter's scores among kept and, where known, removed voxels; the top 0.5 %
    in the last bin.
    """
    if stages is None:
        kept, removed = cloud["score"], np.zeros(0, np.float32)
    else:
        kept, removed = stages["score"][stages["keep"]], stages["score"][~stages["keep"]]
    kept, removed = kept[np.isfinite(kept)], removed[np.isfinite(removed)]
    both = np.concatenate([kept, removed])
    if len(both) == 0:
        return {"edges": [], "kept": [], "removed": []}
    low, high = (float(value) for value in np.quantile(both, [0, 0.995]))
    edges = np.linspace(low, max(high, low + 1e-6), SCORE_BINS + 1)
    counts = [
        np.histogram(np.clip(part, edges[0], edges[-1]), edges)[0].tolist()
        for part in (kept, removed)
    ]
    return {
        "edges": [round(float(edge), 6) for edge in edges],
        "kept": counts[0],
        "removed": counts[1],
    }


def noise_map(xyz: F64, rig: Rig, sigma_px: float) -> dict[str, Any]:
    """Expected standard deviation of depth [mm], σ_z = z² / (f·B) · σ_d, as the median of each
    image cell's points.
    """
    cell = rig.width / NOISE_COLUMNS
    rows = int(np.ceil(rig.height / cell))
    column, row = np.floor(rig.project(xyz) / cell).T
    inside = (column >= 0) & (column < NOISE_COLUMNS) & (row >= 0) & (row < rows)
    cells = (row * NOISE_COLUMNS + column)[inside].astype(int)
    sigma = rig.depth_sigma(xyz[inside, 2], sigma_px) / MILLIMETRE
    order = np.lexsort((sigma, cells))
    found, first, count = np.unique(cells[order], return_index=True, return_counts=True)
    grid: list[list[float | None]] = [[None] * NOISE_COLUMNS for _ in range(rows)]
    for place, middle in zip(found, first + count // 2, strict=True):
        grid[place // NOISE_COLUMNS][place % NOISE_COLUMNS] = round(float(sigma[order[middle]]), 2)
    return {"mm": grid, "cell_px": cell}


def _base64(values: npt.NDArray[Any], kind: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values).astype(kind).tobytes()).decode()
