"""The bars in a plane: direction, pitch, width and phase, from where it is solid and where one sees
through it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from stereo_ore.types import F64, Bars, Mask, Plane, Site

if TYPE_CHECKING:
    from stereo_ore.stages.grizzly.sample import Sample

_COARSE, FINE = 60, 13
"""Directions tried over half a turn, and then around the best of them."""
_BINS, FINE_BINS = 400, 4000
"""Bins across the screen, and PHASES across one pitch."""
PHASES = 60
SEARCHED = 3000
"""Points that directions are tried on."""
MIN_BARS, MAX_BARS = 3, 40
_AROUND = 0.1
"""Margin kept around what one sees through, of its extent."""
LEAST_SEEN = 8
"""Points that a bar or a gap must have to be judged."""
ROUGH, SHARP = (1.0, 2.0), (0.3, 1.0)
"""Within the first of these of a plane [inlier distances] it is solid, beneath the second it is
open."""
MIN_DUTY, MAX_DUTY = 0.08, 0.6
_BETWEEN = 0.8
"""Distance from a bar's middle, in widths, from which on it is looked for bars across: nearer,
depth is smeared."""
CROSS_CONTRAST, MOST_OBLONG = 0.12, 2.0
"""Contrast of bars across that nobody has described, which the image must confirm, and the largest
ratio of both pitches."""


@dataclass(frozen=True)
class BarFit:
    """The bars, if any, the share of the variance of solid/open that they explain (0…1), how many
    are seen, and in a grid the bars across them.
    """

    bars: Bars | None
    contrast: float
    seen: int = 0
    cross: Bars | None = None

    def narrowed(self, share: float) -> BarFit:
        """The same with bars of so much of their width."""
        bars, cross = (
            each and replace(each, width_m=share * each.width_m) for each in (self.bars, self.cross)
        )
        return replace(self, bars=bars, cross=cross)

    def covers(self, xyz: F64) -> Mask:
        """True for each of (N, 3) points that lies over a bar."""
        found = np.zeros(len(xyz), bool)
        for bars in (self.bars, self.cross):
            if bars is not None:
                across = xyz @ bars.across - bars.phase_m
                found |= np.abs(_wrap(across, bars.pitch_m)) < bars.width_m / 2
        return found


@dataclass(frozen=True)
class _Comb:
    """Bars of one direction in the plane's axes: angle [rad], pitch, phase and width [m], the
    contrast they explain, and how many are seen.
    """

    angle: float
    pitch: float
    phase: float
    width: float
    contrast: float
    seen: int

    def off_centre(self, q: F64) -> F64:
        """Distances (N,) [m] from the nearest bar's middle."""
        return np.abs(_wrap(_across(q, self.angle) - self.phase, self.pitch))

    def bars(self, axes: F64) -> Bars:
        """The same in space; `axes` (2, 3) are the plane's."""
        sin, cos = np.sin(self.angle), np.cos(self.angle)
        direction, across = np.array([cos, sin]) @ axes, np.array([-sin, cos]) @ axes
        return Bars(direction, across, float(self.pitch), float(self.phase), float(self.width))


def fit_bars(sample: Sample, plane: Plane, site: Site, sharp: bool = False) -> BarFit:
    """Bars of a plane.

    Each pixel's ray is cut with the plane: where the point seen lies on the plane the plane is
    solid there (+1), where it lies well beneath the plane is open (−1); a point above says nothing.
    The direction is the one along which this signal varies least; the pitch the one whose folded
    signal has the best window of solid. Bars across are looked for in what is left between the
    bars, unless the site's opening is one of slots.

    Parameters
    ----------
    sample : Sample
        Points with their tolerances.
    plane : Plane
        Plane of the bar tops.
    site : Site
        Clear distances and bar width, as far as they are known; an opening and the width together
        fix the pitch and the width.
    sharp : bool
        The plane has been refined: what lies a little beneath it is a bar's side face, or smeared
        off its edge.
    """
    q, signal, axes = rays_in_plane(sample, plane, SHARP if sharp else ROUGH)
    q, signal = _around_open(q, signal)
    if len(q) < PHASES or signal.min() > 0 or signal.max() < 0:
        return BarFit(None, 0.0)
    main = _main(q, signal, site)
    if main is None:
        return BarFit(None, 0.0)
    cross = None if _has_slots(site) else _cross(q, signal, main, site)
    if cross is None:
        return BarFit(main.bars(axes), main.contrast, main.seen)
    solid = (main.off_centre(q) < main.width / 2) | (cross.off_centre(q) < cross.width / 2)
    contrast = _explained(solid.astype(np.intp), signal)
    return BarFit(main.bars(axes), contrast, max(main.seen, cross.seen), cross.bars(axes))


def _has_slots(site: Site) -> bool:
    """Whether somebody has described the openings as slots."""
    return site.opening_m is not None and site.cross_opening_m is None


def _main(q: F64, signal: F64, site: Site) -> _Comb | None:
    """The bars that are most clearly seen."""
    angle, width = _direction(q, signal), site.bar_width_m
    main = _fitted(q, signal, angle, site.opening_m, width)
    if _has_slots(site):
        return main
    # In a grid either direction may be the one along which the signal varies least.
    turned = _fitted(q, signal, angle + np.pi / 2, site.opening_m, width)
    return turned if turned and (main is None or turned.contrast > main.contrast) else main


def _cross(q: F64, signal: F64, main: _Comb, site: Site) -> _Comb | None:
    """Bars across the main ones, looked for between these; None where it is no grid."""
    angle = main.angle + np.pi / 2
    between = main.off_centre(q) > _BETWEEN * main.width
    # Of few bars the frame behind the last would be taken for another one.
    between &= _where_open(_across(q, angle), signal)
    if between.sum() < PHASES or not signal[between].min() < 0 < signal[between].max():
        return None
    cross = _fitted(q[between], signal[between], angle, site.cross_opening_m, site.bar_width_m)
    return cross if cross is not None and _is_grid(main, cross, site) else None


def _across(q: F64, angle: float) -> F64:
    """Coordinates (N,) [m] of places (N, 2) of a plane across a direction [rad] in it."""
    return np.asarray(q @ np.array([-np.sin(angle), np.cos(angle)]))


def _is_grid(main: _Comb, cross: _Comb, site: Site) -> bool:
    """Whether bars across were seen: ties under the bars are few and far between."""
    if site.cross_opening_m is not None:
        return True
    ratio = cross.pitch / main.pitch
    return cross.contrast > CROSS_CONTRAST and 1 / MOST_OBLONG < ratio < MOST_OBLONG


def _fitted(
    q: F64, signal: F64, angle: float, opening_m: float | None, bar_width_m: float | None
) -> _Comb | None:
    """The bars along a direction of the plane."""
    position = _across(q, angle)
    comb = _comb(position, signal, opening_m, bar_width_m)
    if comb is None:
        return None
    pitch, phase, width = comb
    solid = np.abs(_wrap(position - phase, pitch)) < width / 2
    contrast = _explained(solid.astype(np.intp), signal)
    seen = _seen(position, signal, pitch, phase, solid)
    return _Comb(float(angle), pitch, phase, width, contrast, seen)


def _seen(position: F64, signal: F64, pitch: float, phase: float, on_bar: Mask) -> int:
    """Number of bars that are mostly solid where the half gaps beside them are mostly open."""
    number = np.round((position - phase) / pitch).astype(np.intp)
    number -= number.min()
    means = []
    for part in (on_bar, ~on_bar):
        count = np.bincount(number[part], minlength=number.max() + 1)
        total = np.bincount(number[part], signal[part], number.max() + 1)
        means.append(np.where(count >= LEAST_SEEN, total / np.maximum(count, 1), 0.0))
    return int(((means[0] > 0.3) & (means[1] < -0.3)).sum())


def rays_in_plane(
    sample: Sample, plane: Plane, limits: tuple[float, float]
) -> tuple[F64, F64, F64]:
    """Where each ray meets the plane (N, 2) [m], solid +1 or open −1 (N,), and the plane's axes (2,
    3).
    """
    height = plane.height(sample.xyz)
    solid, open_ = (limit * sample.tolerance for limit in limits)
    known = (np.abs(height) < solid) | (height < -open_)
    xyz, height = sample.xyz[known], height[known]
    signal = np.where(height > -solid[known], 1.0, -1.0)
    hit = xyz * (plane.offset / (height + plane.offset))[:, None]
    x = np.array([1.0, 0, 0]) - plane.normal[0] * plane.normal
    x /= np.linalg.norm(x)
    axes = np.stack([x, np.cross(plane.normal, x)])
    return hit @ axes.T, signal, axes


def _where_open(position: F64, signal: F64) -> Mask:
    """Which coordinates (N,) lie between the ends of what one sees through."""
    low, high = np.percentile(position[signal < 0], (0.5, 99.5))
    return np.asarray((position > low) & (position < high))


def _around_open(q: F64, signal: F64) -> tuple[F64, F64]:
    """The rays where one sees through the plane and a little around: bars are there, a floor goes
    on for ever.
    """
    through = q[signal < 0]
    if not len(through):
        return q, signal
    low, high = np.percentile(through, (1, 99), axis=0)
    margin = _AROUND * (high - low)
    near = ((q > low - margin) & (q < high + margin)).all(1)
    return q[near], signal[near]


def _wrap(value: F64, period: float) -> F64:
    """Value folded into −period/2 … period/2."""
    return np.asarray(value - period * np.round(value / period))


def _explained(group: np.ndarray, signal: F64) -> float:
    """Share of the variance of the signal that is between groups (0…1)."""
    count = np.bincount(group)
    total = np.bincount(group, signal)
    between = float((total**2 / np.maximum(count, 1)).sum()) - signal.sum() ** 2 / len(signal)
    within = len(signal) - signal.sum() ** 2 / len(signal)
    return between / within if within > 0 else 0.0


def _direction(q: F64, signal: F64) -> float:
    """Angle of the bars in the plane [rad]: the signal summed along them varies most across
    them.
    """
    if len(q) > SEARCHED:
        # Not every n-th: the sample is a grid, and bars along its columns would be missed or hit
        # all at once.
        some = np.random.default_rng(0).choice(len(q), SEARCHED, replace=False)
        q, signal = q[some], signal[some]

    def contrast(angle: float) -> float:
        position = _across(q, angle)
        low, high = position.min(), position.max()
        return _explained(
            ((position - low) / max(high - low, 1e-9) * (_BINS // 3)).astype(np.intp), signal
        )

    best, span = 0.0, np.pi / 2
    for count in (_COARSE, FINE, FINE):
        angles = best + np.linspace(-span, span, count, endpoint=count != _COARSE)
        best = float(angles[int(np.argmax([contrast(a) for a in angles]))])
        span = np.pi / _COARSE if count == _COARSE else span / 8
    return best


def _comb(
    position: F64, signal: F64, opening_m: float | None, bar_width_m: float | None
) -> tuple[float, float, float] | None:
    """Pitch, phase and width [m] of the comb that agrees best with the signal."""
    low, high = np.percentile(position, (1, 99))
    extent = float(high - low)
    if opening_m is not None and bar_width_m is not None:
        pitches = (opening_m + bar_width_m) * np.linspace(0.995, 1.005, 5)
        if pitches[0] > extent:
            return None
    else:
        pitches = extent / np.geomspace(MIN_BARS, MAX_BARS, 240)
    centres, balanced = _balanced(position, signal, low, extent)
    for wide in (True, False) if opening_m is None or bar_width_m is None else (True,):
        comb = _best_window(centres, balanced, pitches, bar_width_m)
        if wide:
            pitches = comb[0] * np.linspace(0.97, 1.03, 31)
    return comb


def _balanced(position: F64, signal: F64, low: float, extent: float) -> tuple[F64, F64]:
    """The signal in fine bins across the screen: centres [m] and sums of those that hold any.

    Wide bins are first brought to the same weight, then solid and open to the same sum.
    """
    inside = (position >= low) & (position < low + extent)
    position, signal = position[inside], signal[inside]
    share = (position - low) / max(extent, 1e-9)
    even = signal / np.bincount((share * _BINS).astype(np.intp))[(share * _BINS).astype(np.intp)]
    solid = even > 0
    even = np.where(
        solid, even / max(even[solid].sum(), 1e-9), -even / min(even[~solid].sum(), -1e-9)
    )
    sums = np.asarray(
        np.bincount((share * FINE_BINS).astype(np.intp), even, FINE_BINS)[:FINE_BINS],
        dtype=np.float64,
    )
    held = np.flatnonzero(sums)
    return low + (held + 0.5) * extent / FINE_BINS, sums[held]


def _best_window(
    position: F64, signal: F64, pitches: F64, width_m: float | None
) -> tuple[float, float, float]:
    """Pitch, phase and width [m] of the window whose periodic repetition holds the most signal."""
    folds = _folded(position, signal, pitches)
    sums = np.zeros((len(pitches), 2 * PHASES + 1))
    np.cumsum(np.tile(folds, 2), axis=1, out=sums[:, 1:])
    if width_m is not None:
        lengths = np.round(width_m / pitches * PHASES).astype(np.intp)[:, None]
    else:
        lengths = np.arange(round(MIN_DUTY * PHASES), round(MAX_DUTY * PHASES))[None]
    ends = np.arange(PHASES)[:, None] + lengths[:, None]
    held = sums[np.arange(len(pitches))[:, None, None], ends] - sums[:, :PHASES, None]
    best, start, length = np.unravel_index(int(np.argmax(held)), held.shape)
    pitch, bins = float(pitches[best]), float(lengths[best if len(lengths) > 1 else 0, length])
    middle = (start + bins / 2) / PHASES * pitch
    return pitch, middle % pitch, bins / PHASES * pitch if width_m is None else width_m


def _folded(position: F64, signal: F64, pitches: F64) -> F64:
    """The signal (N,) at positions [m] summed by phase of each pitch [m], (P, PHASES)."""
    turns = position / pitches[:, None]
    turns -= np.floor(turns)
    turns *= PHASES
    phase = turns.astype(np.intp) % PHASES + PHASES * np.arange(len(pitches))[:, None]
    weights = np.broadcast_to(signal, phase.shape).ravel()
    sums = np.bincount(phase.ravel(), weights, PHASES * len(pitches))
    return np.asarray(sums, dtype=np.float64).reshape(-1, PHASES)
