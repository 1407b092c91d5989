"""Whether the disparity is right in every row of the image: the bars must lie in their plane
wherever they show.

A band of rows that slipped, rows that wobble or a film of water leave much of the image as it was,
and match well. But where the comb of the bars is known, its teeth can be looked for row by row: one
disparity on the comb that is not the plane's, and nothing so near beside it, are rows that are
measured wrong. Ore has no such teeth.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from stereo_ore.config import HealthConfig
from stereo_ore.rays import contained
from stereo_ore.types import (
    F32,
    F64,
    I32,
    Disparity,
    Grizzly,
    Mask,
    OreMap,
    Reason,
    Rig,
    Solid,
    StrikePlan,
    Volume,
    on_rays,
)

_STEP = 2
"""Every so many-th pixel each way is looked at."""
_REACH_PX, _BIN_PX = 14.0, 0.25
_BINS = int(2 * _REACH_PX / _BIN_PX)
_INNER, _GAP, _WIDE = 0.7, 1.6, 1.15
"""Bars without their smeared edges, surely no bar, and bars with all of their edges [widths]."""
_BAND, OFF_PX = 7, 0.6
"""Rows that are looked at together, and how far off the plane their bars are elsewhere."""
SHARE, _CLEARER = 0.12, 3.0
"""Share of the pixels on the comb that have one disparity, three bins wide; so many times those at
the plane."""
_TEETH = 2.0
"""So many times the share of the pixels beside the comb that have the same one."""
THROUGH_PX, _OPEN = 1.5, 0.3
"""Share of the pixels beside the comb that lie so far beneath it: one sees through bars, not
through ore."""
_PHASES, _BENT = 24, 0.08
"""Places of a pitch, and how many pitches beside the comb bars of a band of rows may be;"""
_FEWEST_SEEN, _MOST_PHASES = 150, 0.8
"""pixels of a band that tell of it, at so many of these places: bars along the rows do not;"""
_LEAST_BARS, _ALTERNATES = 3, 0.1
"""so many bars, beside each of which a share of the pixels that tell is open, and one solid;"""
_CLEAR_GAIN, _CLEARER_BENT = 4.0, 1.3
"""and how much better they must lie there: standard deviations of chance, and times as well."""
_FEWEST = 40
"""Pixels on the comb, and beside it, that tell of a band."""
ON_BARS, IN_ROWS = 0.7, 0.05
"""Shares of a lump's pixels on the comb, and in doubtful rows, from which on it is no target."""


@dataclass(frozen=True)
class Parts:
    """What is doubtful in the matched rectangle, at every `_STEP`-th pixel.

    `comb` (h, w) are pixels on bars, `rows` (h,) those whose bars lie elsewhere.
    """

    comb: Mask
    rows: Mask


def judge_parts(
    disparity: Disparity, rig: Rig, screen: Grizzly, volume: Volume | None
) -> Parts | None:
    """Look for the bars in all rows; None where it is not known where they are.

    Parameters
    ----------
    disparity : Disparity
        With the bars in the screen's plane wherever it is right.
    rig : Rig
        Geometry of the rectified pair.
    screen : Grizzly
        Plane and bars.
    volume : Volume or None
        Whether bars are straight is judged within it.
    """
    if screen.bars is None or screen.source == "auto":
        return None
    rows, columns = disparity.region.slices
    x = (np.arange(columns.start, columns.stop, _STEP) - rig.cx) / rig.fx
    y = (np.arange(rows.start, rows.stop, _STEP) - rig.cy) / rig.fy
    slope = on_rays(screen.plane.normal, x, y)
    depth = np.float32(screen.plane.offset) / slope
    excess = disparity.values[rows, columns][::_STEP, ::_STEP] + np.float32(rig.doffs_px)
    excess -= slope * np.float32(rig.fx * rig.baseline_m / screen.plane.offset)
    bars = screen.bars
    turns = (on_rays(bars.across, x, y) * depth - np.float32(bars.phase_m)) / np.float32(
        bars.pitch_m
    )
    off_centre = np.abs(turns - np.round(turns)) * np.float32(2 * bars.pitch_m / bars.width_m)
    gap = off_centre > min(_GAP, 0.5 * (1 + bars.pitch_m / bars.width_m))
    rows_off = _elsewhere(excess, off_centre < _INNER, gap)
    inside = np.ones(depth.shape, np.bool_) if volume is None else contained(volume, depth, x, y)
    rows_off |= _bent(excess, turns, inside)
    return Parts(off_centre < _WIDE, rows_off)


def row_doubts(parts: Parts | None, config: HealthConfig) -> Iterator[Reason]:
    """PARTS_DISAGREE where in too many rows the bars lie elsewhere than in the others."""
    if parts is not None and parts.rows.mean() > config.max_bad_rows:
        share = (
            f"in {100 * parts.rows.mean():.0f} % of the rows the bars are measured elsewhere than"
            " in the others"
        )
        limit = f"{100 * config.max_bad_rows:.0f} % at most are wanted (health.max_bad_rows)"
        yield Reason(
            "PARTS_DISAGREE",
            f"{share}, {limit}: is there water on a lens, does the camera shake, lose lines?",
        )


def without_doubtful(
    plans: Sequence[StrikePlan],
    solids: Sequence[Solid | None],
    ore_map: OreMap,
    disparity: Disparity,
    screen: Grizzly,
    parts: Parts | None,
) -> tuple[StrikePlan, ...]:
    """The plans, without strikes of lumps that lie in doubtful rows or are bars themselves.

    Small ore does lie on a bar; what is longer than an opening is wider than a bar, unless it is
    one.
    """
    if parts is None:
        return tuple(plans)
    labels = ore_map.labels[disparity.region.slices][::_STEP, ::_STEP]
    ore = labels > 0
    counts = [
        np.bincount(labels[part], minlength=len(plans) + 1)[1:]
        for part in (ore, parts.comb & ore, parts.rows[:, None] & ore)
    ]
    on_bars, in_rows = (count / np.maximum(counts[0], 1) for count in counts[1:])
    long = [
        solid is None or screen.opening_m is None or solid.size_m[0] > screen.opening_m
        for solid in solids
    ]
    doubts = (_doubt(*shares) for shares in zip(on_bars * long, in_rows, strict=True))
    return tuple(
        StrikePlan((), (doubt,)) if doubt and plan.strikes else plan
        for plan, doubt in zip(plans, doubts, strict=True)
    )


def _doubt(on_bars: float, in_rows: float) -> Reason | None:
    if on_bars > ON_BARS:
        return Reason("ON_BARS", f"{100 * on_bars:.0f} % of it is where the image shows bars")
    if in_rows > IN_ROWS:
        return Reason(
            "IN_BAD_ROWS",
            f"in {100 * in_rows:.0f} % of it the rows' bars are measured elsewhere than others",
        )
    return None


def _elsewhere(excess: F32, comb: Mask, gap: Mask) -> Mask:
    """Rows (h,) in whose band most of the comb has one disparity off the plane's, and one sees
    through beside it.
    """
    known = np.isfinite(excess)
    index = np.clip((np.where(known, excess, 0) + _REACH_PX) / _BIN_PX, 0, _BINS - 1).astype(
        np.int32
    )
    on = _banded(_by_row(index, comb & known & (np.abs(excess) < _REACH_PX)))
    beside = _banded(_by_row(index, gap & known))
    unseen = _banded((gap & ~known).sum(1).astype(np.float32)[:, None])[:, 0]
    near = cv2.blur(on, (3, 1), borderType=cv2.BORDER_CONSTANT) * 3
    top, most, total = near.argmax(1), near.max(1), on.sum(1)
    here = near[:, _BINS // 2 - 2 : _BINS // 2 + 2].max(1)
    shift = (top + 0.5) * _BIN_PX - _REACH_PX
    level = np.clip(top - int(THROUGH_PX / _BIN_PX), 0, _BINS - 1)
    beneath = np.cumsum(beside, 1)
    below = beneath[np.arange(len(top)), level] + unseen
    gaps = beneath[:, -1] + unseen
    level_too = (
        cv2.blur(beside, (3, 1), borderType=cv2.BORDER_CONSTANT)[np.arange(len(top)), top] * 3
    )
    # A floor beside the screen has one disparity, too, on the comb and between its teeth.
    teeth = most * gaps > _TEETH * level_too * total
    seen = (
        (total >= _FEWEST) & (gaps >= _FEWEST) & (most > SHARE * total) & (most > _CLEARER * here)
    )
    return np.asarray(seen & teeth & (np.abs(shift) > OFF_PX) & (below > _OPEN * gaps))


def _bent(excess: F32, turns: F32, inside: Mask) -> Mask:
    """Rows (h,) in whose band the bars are solid, and their gaps open, beside the comb: rows that
    swing alike in both eyes leave disparities as they are, and bars no longer straight.

    `turns` (h, w) are places across the bars in pitches. What is solid and open is folded by them,
    and each band's fold laid over that of all.
    """
    signal = (np.abs(excess) < OFF_PX).astype(np.float32) - (excess < -THROUGH_PX)
    v, u = np.nonzero(inside & (signal != 0))
    place = v * _PHASES + ((turns[v, u] % 1) * _PHASES).astype(np.intp) % _PHASES
    shape, size = (len(excess), _PHASES), len(excess) * _PHASES
    total, count = (
        _banded(np.bincount(place, weights, size).reshape(shape).astype(np.float32))
        for weights in (signal[v, u], np.ones(len(v)))
    )
    all_rows = total.sum(0) / np.maximum(count.sum(0), 1)
    all_rows -= all_rows.mean()
    seen = count.sum(1)
    total -= count * (total.sum(1) / np.maximum(seen, 1))[:, None]
    shifted = np.stack([np.roll(all_rows, shift) for shift in range(_PHASES)])
    likeness = np.einsum("vp,sp->vs", total, shifted)
    shift = likeness.argmax(1)
    gain = likeness.max(1) - likeness[:, 0]
    chance = np.sqrt(seen * np.mean(all_rows**2))
    judged = (seen > _FEWEST_SEEN) & ((count >= 2).mean(1) > _MOST_PHASES)
    clear = (gain > _CLEAR_GAIN * chance) & (likeness.max(1) > _CLEARER_BENT * likeness[:, 0])
    far = np.minimum(shift, _PHASES - shift) > _BENT * _PHASES
    bent = judged & clear & far
    if bent.any():
        bent &= _bars_seen(v, turns[v, u], signal[v, u], len(excess)) >= _LEAST_BARS
    return np.asarray(bent)


def _bars_seen(v: npt.NDArray[np.intp], turns: F32, signal: F32, height: int) -> F64:
    """Number (h,) of pitches that are solid in a part and open in another, in the band of each
    row: the edge of the frame, which is askew to the rows, has one at each end.
    """
    number = np.floor(turns).astype(np.intp)
    number -= number.min(initial=0)
    shape = (height, int(number.max(initial=0)) + 1)
    place = v * shape[1] + number
    solid, open_ = (
        _banded(np.bincount(place, part, height * shape[1]).reshape(shape).astype(np.float32))
        for part in (signal > 0, signal < 0)
    )
    both = np.minimum(solid, open_) > _ALTERNATES * (solid + open_)
    return np.asarray(both.sum(1), np.float64)


def _by_row(index: I32, part: Mask) -> F32:
    """Counts (h, bins) of a part's pixels."""
    v, u = np.nonzero(part)
    return (
        np.bincount(v * _BINS + index[v, u], minlength=len(index) * _BINS)
        .reshape(-1, _BINS)
        .astype(np.float32)
    )


def _banded(counts: F32) -> F32:
    """Sums over the band about each row."""
    return np.asarray(
        cv2.blur(counts, (1, _BAND), borderType=cv2.BORDER_CONSTANT) * _BAND, np.float32
    )
