"""Outlier filters: a mask and a score for each point, never a smaller cloud. The registry has a
line a method.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from stereo_ore.config import FilterConfig
from stereo_ore.config.filters import (
    AdaptiveParams,
    ClosedFormParams,
    LofParams,
    NoneParams,
    PaperParams,
    RadiusParams,
    StatisticalParams,
)
from stereo_ore.config.models import StageConfig
from stereo_ore.config.validation import nearest_word, validate
from stereo_ore.errors import ConfigError
from stereo_ore.stages.filters.adaptive import adaptive
from stereo_ore.stages.filters.baselines import keep_all, lof, radius, statistical
from stereo_ore.stages.filters.closed_form import closed_form
from stereo_ore.stages.filters.like import PROGRAMS, apply_like
from stereo_ore.stages.filters.paper import paper
from stereo_ore.threads import pool
from stereo_ore.types import F32, I32, FilterResult, Mask, VoxelCloud

__all__ = ["METHODS", "PROGRAMS", "Method", "apply", "apply_like", "parameters", "prepared"]


@dataclass(frozen=True)
class Method:
    """A filter: its parameters' model, its function, and a preset that differs from the model's
    defaults.
    """

    params: type[StageConfig]
    function: Callable[[VoxelCloud, Any], FilterResult]
    preset: Mapping[str, Any] = field(default_factory=dict)


METHODS: Mapping[str, Method] = {
    "adaptive": Method(AdaptiveParams, adaptive),
    "closed-form": Method(ClosedFormParams, closed_form),
    "paper": Method(PaperParams, paper),
    "paper-tuned": Method(PaperParams, paper, {"k0": 5, "alpha": 10.0, "R": 1.4}),
    "statistical": Method(StatisticalParams, statistical),
    "radius": Method(RadiusParams, radius),
    "lof": Method(LofParams, lof),
    "none": Method(NoneParams, keep_all),
}


def parameters(config: FilterConfig) -> StageConfig:
    """The method's parameters: its defaults, its preset, then what the configuration says.

    Raises
    ------
    ConfigError
        For an unknown method or parameter (naming the nearest valid one) or a value out of range.
    """
    if config.method not in METHODS:
        hint = nearest_word(config.method, METHODS)
        raise ConfigError(f"no filter is called {config.method!r}{hint}", key="filter.method")
    method = METHODS[config.method]
    return validate(method.params, {**method.preset, **config.params}, "filter.params", ConfigError)


def apply(voxels: VoxelCloud, config: FilterConfig) -> FilterResult:
    """Decide which points of a cloud are noise.

    Rows that are not finite are removed with an infinite score; points at the same place are judged
    once, together; points are brought into an order of their own, so that the result does not
    depend on the given one.

    Parameters
    ----------
    voxels : VoxelCloud
    config : FilterConfig

    Returns
    -------
    FilterResult
        `keep` (M,), `score` (M,), higher is noisier; `diagnostics` with counts, the parameters and
        what the method says about its decision.
    """
    params = parameters(config)
    finite = _finite(voxels.xyz)
    order, first, group = _distinct(voxels.xyz, finite)
    keep, score = np.zeros(len(voxels), bool), np.full(len(voxels), np.inf, np.float32)
    if len(first) < 2:
        # A lone place has no neighbourhood to be judged by.
        result = FilterResult(np.ones(len(first), bool), np.zeros(len(first), np.float32))
    else:
        result = METHODS[config.method].function(_take(voxels, first), params)
    keep[order], score[order] = result.keep[group], result.score[group]
    counts = {
        "points": len(voxels),
        "not_finite": int((~finite).sum()),
        "duplicates": len(order) - len(first),
    }
    settings = {"method": config.method, "params": params.model_dump(mode="json")}
    return FilterResult(
        keep, score, counts | {"kept": int(keep.sum())} | settings | dict(result.diagnostics)
    )


def prepared(voxels: VoxelCloud) -> tuple[VoxelCloud, I32]:
    """The finite, distinct points in the order in which a method sees them, and their rows."""
    _, first, _ = _distinct(voxels.xyz, _finite(voxels.xyz))
    return _take(voxels, first), first


def _finite(xyz: F32) -> Mask:
    x, y, z = np.isfinite(xyz).T
    return np.asarray(x & y & z)


def _distinct(xyz: F32, finite: Mask) -> tuple[I32, I32, I32]:
    """Finite rows in a spatially coherent order, the first row of each place, and the place of each
    ordered row.
    """
    rows = np.flatnonzero(finite).astype(np.int32)
    order = rows[_order(xyz[rows])]
    places = xyz[order]
    x, y, z = (places[1:] != places[:-1]).T
    new = np.append(True, x | y | z)[: len(order)]
    return order, order[new], np.cumsum(new, dtype=np.int32) - np.int32(1)


def _order(xyz: F32) -> npt.NDArray[np.int64]:
    """Rows in the order of their coarse cell, then x, y, z, then given: as by `lexsort`, at a
    fraction of its time.

    Cell and x are packed into one number, since few points have both in common. The bits of a float
    sort as those of an integer once those of the negative ones are turned over.
    """
    bits = (xyz[:, 0] + np.float32(0)).view(np.int32)
    ascending = np.where(bits < 0, bits ^ np.int32(2**31 - 1), bits)
    key = (_coarse_cell(xyz) << 32) + ascending
    order = np.argsort(key)
    same = np.diff(key[order]) == 0
    tied = np.flatnonzero(np.append(same, False) | np.append(False, same))
    rows = order[tied]
    order[tied] = rows[np.lexsort((rows, xyz[rows, 2], xyz[rows, 1], key[rows]))]
    return order


def _coarse_cell(xyz: F32, cells: int = 64) -> npt.NDArray[np.int64]:
    """Key (M,) of a coarse grid over the cloud: points in its order are near to each other, which
    speeds the search.
    """
    if not len(xyz):
        return np.zeros(0, np.int64)
    low, high = np.quantile(xyz, (0.01, 0.99), axis=0)
    step = max(float((high - low).max()) / cells, np.finfo(np.float32).tiny)
    grid = np.clip((xyz - low) / step, -1, cells).astype(np.int64) + 1
    return np.asarray((grid[:, 0] * (cells + 2) + grid[:, 1]) * (cells + 2) + grid[:, 2])


def _take(voxels: VoxelCloud, rows: I32) -> VoxelCloud:
    # One block, whose memory comes in large pages; "clip" because else a copy is made first.
    taken = np.empty((len(voxels.cues), len(rows)), np.float32)
    list(
        pool().map(
            lambda cue, row: cue.take(rows, out=row, mode="clip"), voxels.cues.values(), taken
        )
    )
    return dataclasses.replace(
        voxels,
        xyz=voxels.xyz[rows],
        count=voxels.count[rows],
        inverse=np.zeros(0, np.int32),
        sigma_z=voxels.sigma_z[rows],
        pixel_m=voxels.pixel_m[rows],
        cues=dict(zip(voxels.cues, taken, strict=True)),
    )
