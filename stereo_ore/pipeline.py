"""The order of the stages: one recorded pair in, one `FrameResult` out."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from stereo_ore import surroundings
from stereo_ore.config import Config
from stereo_ore.errors import FrameError
from stereo_ore.io.recordings import Source
from stereo_ore.stages import (
    cloud,
    empty_screen,
    filters,
    grizzly,
    health,
    matching,
    order,
    rectify,
    segment,
    solid,
    strike,
    voxels,
)
from stereo_ore.threads import pool
from stereo_ore.types import (
    Disparity,
    FrameResult,
    Mask,
    Ore,
    OreMap,
    Reason,
    RectifiedPair,
    Region,
    Site,
    Solid,
    StereoCalibration,
    StereoPair,
    StrikePlan,
    Surface,
)

COUNTS = ("pixels", "disparities", "points", "voxels", "kept", "ores", "targets")


@dataclass(frozen=True)
class Context:
    """All that is fixed for a run: calibration, site, parameters, and what follows from them."""

    calibration: StereoCalibration
    site: Site
    config: Config
    rectifier: rectify.Rectifier
    region: Region
    empty: empty_screen.EmptyScreen | None = None


def make_context(calibration: StereoCalibration, site: Site, config: Config) -> Context:
    """Prepare a run.

    Raises
    ------
    CalibrationError, ConfigError
        When calibration, site and parameters contradict each other.
    """
    rectifier = rectify.make_rectifier(calibration)
    region = matching.find_region(rectifier.rig, site.volume, config.matching)
    filters.parameters(config.filter)
    empty = empty_screen.load(rectifier.rig, region, site, config)
    return Context(calibration, site, config, rectifier, region, empty)


def process_frame(source: Source, index: int, context: Context) -> FrameResult:
    """Read and process frame `index`; what can't be read is a failed frame with a reason, not an exception."""
    start = time.perf_counter()
    try:
        pair, *more = (source.read(i) for i in fused_indices(source, index, context))
    except FrameError as error:
        return _failed(FrameResult(source.names[index], index, None, "failed", (), dict.fromkeys(COUNTS, 0)), error)
    read_ms = 1000 * (time.perf_counter() - start)
    result = process(pair, context, more)
    return replace(result, stages_ms={"read": read_ms, **result.stages_ms})


def fused_indices(source: Source, index: int, context: Context) -> range:
    """The frames that are measured as one with frame `index`: itself, or as many as `matching.fuse` says."""
    return range(index, min(index + context.config.matching.fuse, len(source.names)))


def process(pair: StereoPair, context: Context, more: Sequence[StereoPair] = ()) -> FrameResult:
    """The whole chain on one pair, or on one and `more` of the same still scene.

    A fault in the frame ends the chain early: the result then holds what was reached, a status other than "ok", and
    the reason. Other threads do the checks beside the chain.
    """
    result = FrameResult(pair.name, pair.index, pair.stamp_ns, "ok", (), dict.fromkeys(COUNTS, 0))
    checks: list[Future[tuple[Reason, ...]]] = []
    steps: tuple[tuple[str, Step], ...] = (
        ("rectify", lambda r: replace(r, pair=rectify.rectify(pair, context.rectifier))),
        ("match", lambda r: _match(r, context, more)),
        ("cloud", lambda r: _cloud(r, context)),
        ("voxels", lambda r: _voxels(r, context)),
        ("filter", lambda r: _filter(r, context)),
        ("grizzly", lambda r: _grizzly(r, context)),
        ("segment", lambda r: _segment(r, context)),
        ("ores", lambda r: _doubt(_ores(r, context), checks)),
    )
    times: dict[str, float] = {}
    for name, step in steps:
        start = time.perf_counter()
        try:
            result = step(result)
        except FrameError as error:
            return replace(_failed(_doubt(result, checks), error), stages_ms=times)
        times[name] = 1000 * (time.perf_counter() - start)
        if name in CHECKS:
            checks.append(pool().submit(CHECKS[name], result, context))
    return replace(_judge(result), stages_ms=times)


Step = Callable[[FrameResult], FrameResult]
Value = TypeVar("Value")


def _match(result: FrameResult, context: Context, more: Sequence[StereoPair]) -> FrameResult:
    pairs = [_have(result.pair), *(rectify.rectify(pair, context.rectifier) for pair in more)]
    disparity, *others = (_match_pair(pair, context) for pair in pairs)
    if others:
        disparity = matching.fuse(pairs, [disparity, *others])
    if context.empty is not None:
        matching.background.compare(context.empty.background, disparity)
    result = replace(result, disparity=disparity)
    return _count(result, pixels=disparity.values.size, disparities=int(np.isfinite(disparity.values).sum()))


def _match_pair(pair: RectifiedPair, context: Context) -> Disparity:
    config = context.config.matching
    return matching.match(pair, matching.narrow(pair, context.region, context.site.volume, config), config)


def _cloud(result: FrameResult, context: Context) -> FrameResult:
    config = context.config
    disparity, pair = _have(result.disparity), _have(result.pair)
    points = cloud.reproject(disparity, pair, context.site.volume, config.cloud, config.matching.sigma_px)
    result = _count(replace(result, cloud=points), points=len(points))
    if len(points) == 0:
        raise FrameError("no point lies in the working volume", code="NO_POINTS", remedy="Check site and calibration")
    return result


def _voxels(result: FrameResult, context: Context) -> FrameResult:
    points, disparity, rig = _have(result.cloud), _have(result.disparity), context.rectifier.rig
    size_m = voxels.voxel_size(context.config.voxel, rig, context.site.volume, points)
    grid = surroundings.look_around(voxels.voxelise(points, disparity, rig, size_m), disparity, _have(result.pair))
    return _count(replace(result, voxels=grid), voxels=len(grid))


def _filter(result: FrameResult, context: Context) -> FrameResult:
    grid = _have(result.voxels)
    filtered = filters.apply(grid, context.config.filter)
    keep_points: Mask = filtered.keep[grid.inverse]
    surface = cloud.surface(_have(result.cloud), keep_points, _have(result.pair), _have(result.disparity).region)
    return _count(replace(result, filtered=filtered, surface=surface), kept=int(filtered.keep.sum()))


def _grizzly(result: FrameResult, context: Context) -> FrameResult:
    surface, empty = _have(result.surface), context.empty
    found = grizzly.find(surface, context.site, context.config.grizzly) if empty is None else empty.grizzly
    return replace(result, grizzly=found)


def _segment(result: FrameResult, context: Context) -> FrameResult:
    surface, screen = _have(result.surface), _have(result.grizzly)
    if context.empty is not None:
        surface = empty_screen.new_on(context.empty, _have(result.disparity), surface)
    ore_map = segment.segment(surface, screen, context.site.volume, context.config.segment)
    return _count(replace(result, ore_map=ore_map), ores=int(ore_map.labels.max(initial=0)))


def _ores(result: FrameResult, context: Context) -> FrameResult:
    surface, ore_map, screen = _have(result.surface), _have(result.ore_map), _have(result.grizzly)
    config, site = context.config, context.site
    solids = solid.solids(surface, ore_map, screen, config.solid)
    plans = strike.plans(surface, ore_map, solids, screen, site, config.strike)
    targets = order.order(solids, plans, site, config.order)
    ores = _describe(surface, ore_map, solids, plans)
    return _count(replace(result, ores=ores, targets=targets), targets=len(targets))


def _describe(
    surface: Surface, ore_map: OreMap, solids: tuple[Solid | None, ...], plans: tuple[StrikePlan, ...]
) -> tuple[Ore, ...]:
    height, width = surface.xyz.shape[:2]
    labels = ore_map.labels[surface.y0 : surface.y0 + height, surface.x0 : surface.x0 + width]
    n = len(solids)
    inside = np.flatnonzero(labels > 0)
    mine, xyz = labels.ravel()[inside].astype(np.intp), surface.xyz.reshape(-1, 3)[inside]
    measured = np.flatnonzero(np.isfinite(xyz[:, 2]))
    seen = mine[measured]
    pixels, points = (np.bincount(each, minlength=n + 1) for each in (mine, seen))
    sums = [np.bincount(seen, axis, n + 1) for axis in xyz[measured].T]
    centroids = np.stack(sums, 1) / np.maximum(points, 1)[:, None]
    return tuple(
        Ore(id, int(points[id]), int(pixels[id]), id in ore_map.cut, centroids[id], solids[id - 1], plans[id - 1])
        for id in range(1, n + 1)
    )


def _eye_doubts(result: FrameResult, context: Context) -> tuple[Reason, ...]:
    return tuple(health.eye_doubts(_have(result.pair), _have(result.disparity), context.config.health))


def _screen_doubts(result: FrameResult, context: Context) -> tuple[Reason, ...]:
    surface, screen, config = _have(result.surface), _have(result.grizzly), context.config
    if screen.source == "auto":
        return ()
    return tuple(health.screen_doubts(surface, screen.plane, config.grizzly, config.health))


CHECKS = {"match": _eye_doubts, "grizzly": _screen_doubts}
"""What is checked after a step, beside the steps that follow."""


def _doubt(result: FrameResult, checks: Iterable[Future[tuple[Reason, ...]]]) -> FrameResult:
    """The frame with what speaks against acting on it, if anything does."""
    if not (found := tuple(reason for check in checks for reason in check.result())):
        return result
    return replace(result, status="degraded", reasons=(*result.reasons, *found))


def _judge(result: FrameResult) -> FrameResult:
    """Final status: nothing found is "empty", and a degraded frame gives no targets."""
    if result.status == "degraded":
        return _count(replace(result, targets=()), targets=0)
    if not result.ores:
        return replace(result, status="empty", reasons=(*result.reasons, Reason("NO_ORE", "no lump on the screen")))
    return result


def _failed(result: FrameResult, error: FrameError) -> FrameResult:
    """A frame that ends early: with a filtered cloud it is "degraded", for the cloud is still good; else "failed"."""
    reasons = (*result.reasons, Reason(error.code, str(error)))
    return replace(result, status="degraded" if result.filtered else "failed", reasons=reasons, ores=(), targets=())


def _count(result: FrameResult, **counts: int) -> FrameResult:
    return replace(result, counts={**result.counts, **counts})


def _have(value: Value | None) -> Value:
    """The value that an earlier stage has put in place."""
    assert value is not None, "stages run in order"
    return value
