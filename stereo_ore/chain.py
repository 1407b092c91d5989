"""The chain: one recorded pair in, one `FrameResult` out; this file alone knows the order of the
stages.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from stereo_ore.config import Config
from stereo_ore.errors import FrameError
from stereo_ore.stages import (
    cloud,
    empty_screen,
    filters,
    fines,
    foreign,
    grizzly,
    health,
    matching,
    order,
    ores,
    rectify,
    segment,
    solid,
    stack,
    strike,
    surroundings,
    voxels,
)
from stereo_ore.threads import pool
from stereo_ore.types import (
    Disparity,
    FrameResult,
    Grizzly,
    KeepOut,
    Ore,
    OreMap,
    PointCloud,
    Postures,
    Reason,
    RectifiedPair,
    Registration,
    Site,
    Status,
    StereoCalibration,
    StereoPair,
    Surface,
)

COUNTS = ("pixels", "disparities", "points", "voxels", "kept", "ores", "targets")

_NOTHING = foreign.Foreign(np.zeros((0, 0), np.bool_), np.zeros((0, 3)))

_Value = TypeVar("_Value")


class Chain:
    """Finds ore in stereo pairs; all that is fixed for a run is prepared once.

    Parameters
    ----------
    calibration : StereoCalibration
        Of the camera, for raw or for rectified images.
    site : Site
        Arm, working volume and grizzly, as far as they are known.
    config : Config
        Parameters of all stages.
    postures : Postures, optional
        Where the arm's parts are at a time, for a site with `posture`; without it such a site gives
        no targets.

    Raises
    ------
    CalibrationError, ConfigError
        When calibration, site and parameters contradict each other.
    """

    def __init__(
        self,
        calibration: StereoCalibration,
        site: Site | None = None,
        config: Config | None = None,
        postures: Postures | None = None,
    ) -> None:
        self.postures = postures
        self.calibration, self.site, self.config = calibration, site or Site(), config or Config()
        self.rectifier = rectify.make_rectifier(calibration)
        self.rig = self.rectifier.rig
        self.region = matching.find_region(self.rig, self.site.volume, self.config.matching)
        filters.parameters(self.config.filter)
        self.lumps = segment.load_lump_model(self.config.models.lumps)
        self.empty = empty_screen.load_empty_screen(self.rig, self.region, self.site, self.config)
        self.withheld = tuple(health.missing_in_site(self.site))

    def __call__(self, pair: StereoPair, *more: StereoPair) -> FrameResult:
        """Return what one pair shows, or one and `more` of the same still scene measured together.

        A fault in the frame ends the chain early: the result then holds what was reached, a status
        other than "ok", and the reason. The self-checks run on other threads beside the chain.
        """
        trace = Trace()
        trace.remark(self.withheld, withhold=bool(self.withheld))
        trace.check(health.other_scene, self.site, self.calibration)
        with trace.until_a_fault():
            self._follow(trace, pair, more, self._keep_out(trace, pair))
        return trace.result(pair)

    def _keep_out(self, trace: Trace, pair: StereoPair) -> tuple[KeepOut, ...]:
        """Where nothing is ore while this pair is taken: the site's places, and the arm's parts."""
        link = self.site.posture
        parts, doubts = foreign.arm_places(pair.stamp_ns, self.postures, link)
        trace.remark(doubts, withhold=bool(doubts))
        return (*self.site.keep_out, *parts)

    def _follow(
        self,
        trace: Trace,
        pair: StereoPair,
        more: Sequence[StereoPair],
        keep_out: Sequence[KeepOut],
    ) -> None:
        site, config = self.site, self.config
        eyes = trace.reached("rectify", rectify.rectify(pair, self.rectifier))
        disparity = trace.reached("match", self._match(eyes, more))
        matched, (disparity, moved) = disparity, self._register(disparity)
        trace.reached("register", disparity)
        elsewhere = any(health.bar_doubts(moved, site.opening_m, config.health))
        bars, acting = None if elsewhere else moved, not self.withheld
        trace.check(health.eye_doubts, eyes, matched, config.health, bars, acting)
        every = disparity.unsifted()
        points = trace.reached("cloud", self._cloud(every, eyes))
        size_m = voxels.voxel_size(config.voxel, self.rig, site.volume, points)
        grid = voxels.voxelise(points, every, self.rig, size_m)
        grid = trace.reached("voxels", surroundings.look_around(grid, every, eyes))
        filtered = trace.reached("filter", filters.apply(grid, config.filter))
        # A lump's pixels are those that neither filter nor matcher doubts.
        kept = filtered.keep[grid.inverse] & disparity.is_known(points.pixel)
        surface = cloud.surface(points, kept, eyes, disparity.region)
        alien = foreign.places(surface, keep_out)
        surface = trace.reached("surface", foreign.without_foreign(surface, alien))
        screen = trace.reached("grizzly", replace(self._screen(surface), registration=moved))
        opening_m = screen.opening_m or config.segment.default_opening_m
        trace.check(health.bar_doubts, moved, screen.opening_m, config.health)
        if screen.source != "auto":
            trace.check(health.screen_doubts, surface, screen.plane, config.grizzly, config.health)
            if moved is None:
                limits = (config.grizzly, config.health)
                trace.check(health.unmeasured_doubts, surface, screen.plane, opening_m, *limits)
        if self.empty is None:
            # Of what was there when the screen was empty nothing is taken for ore.
            trace.check(health.tier_doubts, surface, screen, site.volume)
        parts = health.judge_parts(disparity, self.rig, screen, site.volume)
        trace.check(health.row_doubts, parts, config.health)
        alien = foreign.find_foreign(surface, screen, opening_m, alien, config.foreign)
        trace.reached("foreign", alien)
        too_much = alien.found_share > config.foreign.max_share
        trace.remark(foreign.foreign_doubts(alien), withhold=too_much)
        surface = foreign.without_foreign(surface, alien)
        ore_map = foreign.cleared(self._segment(disparity, surface, screen), alien, surface)
        trace.reached("segment", ore_map)
        covered = fines.fines_share(surface, screen, site.volume, ore_map, alien.mask)
        trace.reached("fines", covered)
        solids = trace.reached("solids", solid.solids(surface, ore_map, screen, config.solid))
        plans = strike.plans(surface, ore_map, solids, screen, site, config.strike)
        plans = health.without_blurred(plans, ore_map, matched, eyes, config.health)
        plans = trace.reached(
            "strikes", health.without_doubtful(plans, solids, ore_map, disparity, screen, parts)
        )
        plans = foreign.clear_of(plans, alien, opening_m, config.foreign)
        targets = order.order(solids, plans, site, config.order)
        found = ores.describe_ores(
            surface,
            ore_map,
            solids,
            plans,
            site,
            order.passing(solids, config.order),
            stack.carried(solids, screen.plane),
        )
        trace.reached("ores", (found, targets))

    def _match(self, eyes: RectifiedPair, more: Sequence[StereoPair]) -> Disparity:
        pairs = [eyes, *(rectify.rectify(pair, self.rectifier) for pair in more)]
        disparity, *others = (self._match_pair(pair) for pair in pairs)
        if others:
            disparity = matching.fuse(pairs, [disparity, *others])
        if self.empty is not None:
            matching.background.compare(self.empty.background, disparity)
        return disparity

    def _register(self, disparity: Disparity) -> tuple[Disparity, Registration | None]:
        """The disparity with the bars where they are known to be, and how far from there they were
        measured.
        """
        plane = self.site.plane if self.empty is None else self.empty.grizzly.plane
        if plane is None:
            return disparity, None
        known = None if self.empty is None else self.empty.registration
        disparity = grizzly.corrected(disparity, known, self.rig)
        moved = grizzly.register(disparity, self.rig, plane, self.site, self.config.grizzly)
        return grizzly.corrected(disparity, moved, self.rig), moved

    def _match_pair(self, pair: RectifiedPair) -> Disparity:
        config = self.config.matching
        region = matching.narrow(pair, self.region, self.site.volume, config)
        return matching.match(pair, region, config)

    def _cloud(self, disparity: Disparity, eyes: RectifiedPair) -> PointCloud:
        config, volume = self.config, self.site.volume
        points = cloud.reproject(disparity, eyes, volume, config.cloud, config.matching.sigma_px)
        if not len(points):
            nearest_m = cloud.nearest_beyond(disparity, eyes, volume, config.cloud)
            raise _no_points(nearest_m, config.cloud.max_depth_m)
        return points

    def _screen(self, surface: Surface) -> Grizzly:
        if self.empty is not None:
            return self.empty.grizzly
        return grizzly.find(surface, self.site, self.config.grizzly)

    def _segment(self, disparity: Disparity, surface: Surface, screen: Grizzly) -> OreMap:
        if self.empty is not None:
            surface = empty_screen.new_on(self.empty, disparity.unsifted(), surface)
        if self.site.volume is None:
            surface = grizzly.over(surface, screen, self.config.grizzly)
        volume, config = self.site.volume, self.config.segment
        return segment.segment(disparity, surface, screen, volume, config, self.lumps)


def _no_points(nearest_m: float | None, max_depth_m: float) -> FrameError:
    """Why a cloud is empty; `nearest_m` is what lies nearest of what the depth limit took away."""
    if nearest_m is None:
        problem, key, remedy = "no point lies in the working volume", None, _CHECK
    else:
        problem = (
            f"all points are farther than {max_depth_m:g} m; the nearest lies at {nearest_m:.4g} m"
        )
        key, remedy = "cloud.max_depth_m", f"Set it to what the site needs. {_CHECK}"
    return FrameError(problem, code="NO_POINTS", key=key, remedy=remedy)


_CHECK = "Check site and calibration"


class Trace:
    """The way of one frame through the chain: what was reached, when, and what speaks against
    it.
    """

    def __init__(self) -> None:
        self._remarks: list[Reason] = []
        self._withheld: list[str] = []
        self._reached: dict[str, Any] = {}
        self._stages_ms: dict[str, float] = {}
        self._checks: list[Future[tuple[Reason, ...]]] = []
        self._fault: FrameError | None = None
        self._mark = time.perf_counter()

    def reached(self, stage: str, value: _Value) -> _Value:
        """Note that a stage is done, and pass its value on."""
        self._reached[stage] = value
        self._lap(stage)
        return value

    def check(self, check: Callable[..., Iterable[Reason]], *arguments: Any) -> None:
        """Begin a self-check on another thread, beside the stages that follow."""
        self._checks.append(pool().submit(lambda: tuple(check(*arguments))))

    def remark(self, reasons: Iterable[Reason], withhold: bool) -> None:
        """Note what is no fault of the frame; its targets may be withheld for it."""
        reasons = tuple(reasons)
        self._remarks.extend(reasons)
        self._withheld += [reason.code for reason in reasons] if withhold else []

    @contextmanager
    def until_a_fault(self) -> Iterator[None]:
        """End the chain where the frame itself is at fault; other errors pass."""
        try:
            yield
        except FrameError as fault:
            self._fault = fault

    def result(self, pair: StereoPair) -> FrameResult:
        """Wait for the self-checks, and judge: what was found, or why there is nothing to act
        on.
        """
        reasons = [reason for check in self._checks for reason in check.result()]
        self._lap("health")
        found, targets = self._reached.get("ores", ((), ()))
        status: Status = "degraded" if reasons else "ok"
        if self._fault is not None:
            # With a filtered cloud the frame is not lost: it can still be looked at.
            status = "degraded" if "filter" in self._reached else "failed"
            reasons.append(Reason(self._fault.code, str(self._fault)))
        elif status == "ok" and not found:
            status = "empty"
            reasons.append(Reason("NO_ORE", "no lump on the screen"))
        if status != "failed":
            reasons.extend(self._remarks)
        targets = targets if status == "ok" and not self._withheld else ()
        return self._filled(pair, status, tuple(reasons), found, targets)

    def _filled(
        self,
        pair: StereoPair,
        status: Status,
        reasons: tuple[Reason, ...],
        found: tuple[Ore, ...],
        targets: tuple[int, ...],
    ) -> FrameResult:
        get = self._reached.get
        return FrameResult(
            pair.name,
            pair.index,
            pair.stamp_ns,
            status,
            reasons,
            self._counts(targets),
            pair=get("rectify"),
            disparity=get("register", get("match")),
            cloud=get("cloud"),
            voxels=get("voxels"),
            filtered=get("filter"),
            surface=get("surface"),
            grizzly=get("grizzly"),
            ore_map=get("segment"),
            foreign=get("foreign", _NOTHING).bodies,
            ores=found,
            targets=targets,
            stages_ms=self._stages_ms,
            stamp_source=pair.stamp_source,
            fines_share=get("fines"),
            withheld=tuple(dict.fromkeys(self._withheld)) if status == "ok" else (),
        )

    def _counts(self, targets: tuple[int, ...]) -> dict[str, int]:
        """Count what is left at each step from pixel to target; 0 for what was not reached."""
        counts = {**no_counts(), "targets": len(targets)}
        get = self._reached.get
        if (disparity := get("match")) is not None:
            counts["pixels"] = disparity.values.size
            counts["disparities"] = int(np.isfinite(disparity.unsifted().values).sum())
        if (points := get("cloud")) is not None:
            counts["points"] = len(points)
        if (grid := get("voxels")) is not None:
            counts["voxels"] = len(grid)
        if (filtered := get("filter")) is not None:
            counts["kept"] = int(filtered.keep.sum())
        if (ore_map := get("segment")) is not None:
            counts["ores"] = int(ore_map.labels.max(initial=0))
        return counts

    def _lap(self, stage: str) -> None:
        now = time.perf_counter()
        self._stages_ms[stage] = 1000 * (now - self._mark)
        self._mark = now


def no_counts() -> dict[str, int]:
    """The counts of a frame that reached nothing."""
    return dict.fromkeys(COUNTS, 0)
