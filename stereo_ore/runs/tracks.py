"""Lumps followed through the frames of a still scene: one number for the same lump, what is known
of it from all frames, and no target until enough of them agree.

All that is remembered stands in the records as they are written, so that a run that is continued
goes on as one that never stopped.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from stereo_ore.config import Config
from stereo_ore.record import number
from stereo_ore.stages.order import PASSES_HOLE, calmly, is_wanted, urgencies
from stereo_ore.stages.solid import is_oversize, unknown_within
from stereo_ore.types import Json, Site

SAME_M, SAME_SHARE = 0.03, 0.03
"""A lump is that of an earlier frame when the middles of what is seen are this near, or this share
of the distance;"""
SAME_PIXELS, SAME_SIZE = 1.6, 1.3
"""and when visible area and middle dimension differ by no more than these factors."""
PATIENCE = 5
"""Frames without a lump after which it is given up, where `order.confirm` looks at fewer."""
MOST_FUSED = 20
"""Frames that the mean of a lump goes over, nearly: what changes slowly is followed."""
STILL_M, STILL_SHARE = 0.01, 0.01
"""A centre of gravity farther than this, or this share of the distance, from the mean is that of a
lump that slid: its mean begins anew, so that no target lags behind its lump."""
CALM = (1.0, 0.5, 1.5)
"""Shares of the margin (`unknown_within`) at one of which a flag must hold to stay as it is; the
first decides where none does."""
_WITHIN = 1.2
"""A place is in a lump's box, made larger by this factor."""
USABLE = ("ok", "empty")
_HELD = "HELD"
_FAR = 1e6
"""Cost of what can't be one lump."""


@dataclass(frozen=True)
class LumpTrack:
    """One lump: its number, its entry in the last record that showed it, the good frame of the run
    in which it was first seen, in which of the last ones it was (the newest last), and whether it
    was ever confirmed.
    """

    number: int
    ore: Json
    first: int
    seen: tuple[bool, ...] = ()
    known: bool = False


class Tracks:
    """Follows the lumps of a run's good frames; others are passed by.

    Parameters
    ----------
    config : Config
        `order`, and the margin of `solid`.
    site : Site
        The arm's reach, for the order of targets.
    """

    def __init__(self, config: Config, site: Site) -> None:
        self._order, self._solid, self._site = config.order, config.solid, site
        self._wanted, self._window = config.order.confirming
        self._tracks: tuple[LumpTrack, ...] = ()
        self._before: dict[int, int] = {}
        self._frames = self._highest = 0

    def follow(self, record: Json) -> Json:
        """The record with the lumps' numbers, means over frames, and confirmed targets alone."""
        if record["status"] not in USABLE:
            return record
        matches = _matches(record["ores"], self._tracks)
        fresh = itertools.count(self._highest + 1)
        ores = [
            self._known(ore, matches[k], record) if k in matches else _numbered(ore, next(fresh))
            for k, ore in enumerate(record["ores"])
        ]
        after = self._advanced(ores)
        hidden = [track for track in after if not track.seen[-1] and self._is_there(track, ores)]
        held = [_held(track.ore, id) for id, track in enumerate(hidden, len(ores) + 1)]
        doubtful = {track.number for track in after if not self._is_confirmed(track)}
        targets = record["targets"]
        if self._frames:
            targets = self._targets(record, [*ores, *held])
        number_of = {ore["id"]: _number(ore) for ore in ores + held}
        targets = [id for id in targets if number_of[id] not in doubtful]
        ores = [self._doubted(ore) if _number(ore) in doubtful else ore for ore in ores] + held
        events = {"started": list(self._started(after)), "ended": list(self._ended(after))}
        counts = record["counts"] | {"ores": len(ores), "targets": len(targets)}
        return record | {"ores": ores, "targets": targets, "counts": counts, "tracks": events}

    def remember(self, record: Json) -> None:
        """Note a record as `follow` made it."""
        if record["status"] not in USABLE:
            return
        after = self._advanced([ore for ore in record["ores"] if not _is_held(ore)])
        self._tracks = tuple(track for track in after if any(track.seen))
        self._highest = max([self._highest, *(_number(ore) for ore in record["ores"])])
        number_of = {ore["id"]: _number(ore) for ore in record["ores"]}
        if record["targets"]:
            self._before = {number_of[id]: place for place, id in enumerate(record["targets"])}
        self._frames += 1

    def _advanced(self, ores: Sequence[Json]) -> list[LumpTrack]:
        """All tracks one frame later."""
        found = {_number(ore): ore for ore in ores}
        old = {track.number for track in self._tracks}
        new = [LumpTrack(n, ore, self._frames) for n, ore in found.items() if n not in old]
        return [self._later(track, found.get(track.number)) for track in [*self._tracks, *new]]

    def _later(self, track: LumpTrack, ore: Json | None) -> LumpTrack:
        seen = (*track.seen, ore is not None)[-max(self._window, PATIENCE) :]
        later = replace(track, ore=ore or track.ore, seen=seen)
        return replace(later, known=track.known or self._is_confirmed(later))

    def _is_confirmed(self, track: LumpTrack) -> bool:
        return sum(track.seen[-self._window :]) >= self._wanted

    def _is_there(self, track: LumpTrack, ores: Sequence[Json]) -> bool:
        """Whether a lump that is not told apart in this frame is confirmed all the same, and
        something lies where it is to be struck.
        """
        strike = track.ore["strike"]
        return (
            strike is not None
            and self._is_confirmed(track)
            and any(_holds(ore, strike["point"]["camera"]) for ore in ores)
        )

    def _known(self, ore: Json, track: LumpTrack, record: Json) -> Json:
        """A lump's entry with the means over its frames, and the flag that they give."""
        fused = _mean(ore, track.ore) if _is_still(ore, track.ore) else _numbered(ore, track.number)
        if not (fused["size_m"] and record["grizzly"]):
            return fused
        openings = record["grizzly"]["openings_m"]
        openings = None if openings is None else tuple(openings)
        margin = unknown_within(fused["volume_bounds_m3"], self._solid)
        flags = [
            is_oversize(fused["size_m"], openings, fused["cut"], share * margin) for share in CALM
        ]
        flag = track.ore["oversize"] if track.ore["oversize"] in flags else flags[0]
        reasons = [reason for reason in fused["reasons"] if reason["code"] != PASSES_HOLE.code]
        if not is_wanted(flag, self._order):
            reasons = [vars(PASSES_HOLE), *reasons]
        return fused | {"oversize": flag, "reasons": reasons}

    def _doubted(self, ore: Json) -> Json:
        detail = f"not seen in {self._order.confirm} frames (order.confirm)"
        return _with_reason(ore, "NOT_CONFIRMED", detail)

    def _targets(self, record: Json, ores: Sequence[Json]) -> list[int]:
        """Ids of the targets, by the flags as they are now and in an order like the one before."""
        if record["status"] != "ok" or record["withheld"]:
            return []
        able = [ore for ore in ores if ore["strike"] and is_wanted(ore["oversize"], self._order)]
        if not able:
            return []
        points = np.array([ore["strike"]["point"]["camera"] for ore in able])
        arm = [ore["strike"]["point"]["arm"] for ore in able]
        total = urgencies(
            [ore["oversize"] for ore in able],
            points @ np.array(record["grizzly"]["normal"]),
            [ore["strike"]["score"] for ore in able],
            None if None in arm else np.array(arm),
            self._site,
            self._order,
        )
        places = [self._before.get(_number(ore)) for ore in able]
        return [able[k]["id"] for k in calmly(total, places, self._order)]

    def _started(self, after: Sequence[LumpTrack]) -> Iterator[Json]:
        """NEW_LUMP for what is confirmed now and was not there when the run began."""
        earlier = {track.number for track in self._tracks if track.known}
        for track in after:
            if track.known and track.first > 0 and track.number not in earlier:
                place = _shown(track.ore["surface_centroid"]["camera"])
                yield _event(track, "NEW_LUMP", f"a lump lies at {place} where none was before")

    def _ended(self, after: Sequence[LumpTrack]) -> Iterator[Json]:
        """Why a confirmed lump that none of the last frames shows is given up."""
        for track in after:
            if track.known and not any(track.seen):
                last = self._frames - len(track.seen)
                since = [other for other in after if other.known and other.first > last]
                yield _event(track, *_fate(track.ore, since))


def _matches(ores: Sequence[Json], tracks: Sequence[LumpTrack]) -> dict[int, LumpTrack]:
    """Which track a lump belongs to, by its place in `ores`; the sum of distances is least."""
    if not ores or not tracks:
        return {}
    here, there = (
        np.array([ore["surface_centroid"]["camera"] for ore in entries])
        for entries in (ores, [track.ore for track in tracks])
    )
    apart = np.linalg.norm(here[:, None] - there[None], axis=2)
    apart /= np.maximum(SAME_M, SAME_SHARE * here[:, 2])[:, None]
    alike = np.array([[_alike(ore, track.ore) for track in tracks] for ore in ores])
    cost = np.where(alike & (apart < 1), apart, _FAR)
    rows, columns = linear_sum_assignment(cost)
    pairs = zip(rows.tolist(), columns.tolist(), strict=True)
    return {row: tracks[column] for row, column in pairs if cost[row, column] < _FAR}


def _alike(one: Json, other: Json) -> bool:
    """Whether two entries may be one lump by what is seen of it and its size."""
    sizes = [(one["pixels"], other["pixels"], SAME_PIXELS)]
    if one["size_m"] and other["size_m"]:
        sizes.append((one["size_m"][1], other["size_m"][1], SAME_SIZE))
    return all(max(a, b) < factor * min(a, b) for a, b, factor in sizes)


def _mean(ore: Json, before: Json) -> Json:
    """A lump's entry with centre, volume and size as the mean over frames.

    Each frame weighs 1/σ² by the deviations of its centre. What is uncertain is mostly the unseen
    side, which is the same in each frame of a still scene: the errors are taken for common to all,
    so that the deviation of the mean is that of a frame.
    """
    frames = min(before["track"]["frames"], MOST_FUSED - 1)
    new, old = (_variance(each["centre_of_gravity"]["sigma_m"]) for each in (ore, before))
    share = old / (old + frames * new)
    keys = ("centre_of_gravity", "volume_m3", "volume_bounds_m3", "size_m")
    track = {"number": _number(before), "frames": before["track"]["frames"] + 1}
    return ore | {key: _between(before[key], ore[key], share) for key in keys} | {"track": track}


def _is_still(ore: Json, before: Json) -> bool:
    """Whether a lump's centre of gravity is where the mean of its frames has it."""
    if not (ore["centre_of_gravity"] and before["centre_of_gravity"]):
        return False
    here, there = (np.array(o["centre_of_gravity"]["camera"]) for o in (ore, before))
    return bool(np.linalg.norm(here - there) < max(STILL_M, STILL_SHARE * here[2]))


def _variance(sigma_m: Sequence[float]) -> float:
    return max(sum(value * value for value in sigma_m), 1e-12)


def _between(old: Any, new: Any, share: float) -> Any:
    """Numbers, or lists and objects of such, so far on the way from one to another."""
    if isinstance(new, dict):
        return {key: _between(old[key], value, share) for key, value in new.items()}
    if isinstance(new, list):
        return [_between(a, b, share) for a, b in zip(old, new, strict=True)]
    return number(old + share * (new - old)) if isinstance(new, (int, float)) else new


def _holds(ore: Json, point: Sequence[float]) -> bool:
    """Whether a point lies in the box of a lump, or close by."""
    if not ore["box"]:
        return False
    box = ore["box"]["camera"]
    along = np.array(box["axes"]) @ (np.array(point) - np.array(box["centre"]))
    return bool((np.abs(along) < 0.5 * _WITHIN * np.array(ore["box"]["extent_m"])).all())


def _fate(ore: Json, since: Sequence[LumpTrack]) -> tuple[str, str]:
    """What became of a lump, by the lumps that have come since."""
    parts = [t for t in since if _holds(ore, t.ore["surface_centroid"]["camera"])]
    if len(parts) > 1:
        numbers = ", ".join(str(part.number) for part in parts)
        return "BROKEN", f"in its place lie the lumps of tracks {numbers}"
    alike = [track for track in since if _alike(track.ore, ore)]
    if len(alike) == 1:
        place = _shown(alike[0].ore["surface_centroid"]["camera"])
        return "MOVED", f"a lump like it is at {place} now, track {alike[0].number}"
    return "GONE", f"no lump at {_shown(ore['surface_centroid']['camera'])} any more"


def _shown(point: Sequence[float]) -> str:
    return f"({', '.join(f'{value:.2f}' for value in point)}) m"


def _event(track: LumpTrack, code: str, detail: str) -> Json:
    return {"track": track.number, "code": code, "detail": detail}


def _numbered(ore: Json, track: int) -> Json:
    return ore | {"track": {"number": track, "frames": 1}}


def _number(ore: Json) -> int:
    return int(ore["track"]["number"])


def _held(ore: Json, id: int) -> Json:
    """The last entry of a lump, as one of a frame that does not tell it apart."""
    detail = "not told apart in this frame: as it was seen last (order.confirm)"
    return _with_reason(ore, _HELD, detail) | {"id": id, "carries": [], "carried_by": []}


def _is_held(ore: Json) -> bool:
    return any(reason["code"] == _HELD for reason in ore["reasons"])


def _with_reason(ore: Json, code: str, detail: str) -> Json:
    return ore | {"reasons": [*ore["reasons"], {"code": code, "detail": detail}]}
