"""Matchers compared at one density: whoever gives fewer disparities errs less, which says nothing
by itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from stereo_ore.lab.bench.tables import table
from stereo_ore.types import F32

Point = tuple[float, float, float]
"""Density, bad-1, bad-2: shares of the pixels with truth, missing ones counted as bad."""

_NEAR_PX = 1.5
"""Sub-pixel errors are compared where both matchers are within this of the truth."""

_POINTS = 200
"""A curve has no more points than this."""


@dataclass(frozen=True)
class Compared:
    """A peer at one setting on one set, beside the program.

    `peer` and `program` are (bad-1, bad-2) at the lesser of both densities; `rms_ratio` is the
    program's RMS over the peer's on common pixels.
    """

    set: str
    peer: str
    setting: str
    density: float
    program: tuple[float, float]
    peers: tuple[float, float]
    rms_ratio: float


@dataclass(frozen=True)
class _Verdict:
    """A peer at its best setting for one measure: mean difference in points, sets won, and the
    sets.
    """

    peer: str
    measure: str
    setting: str
    difference: float
    won: int
    sets: list[Compared] = field(default_factory=list)


def quality(error: F32) -> Point:
    """The point of signed errors of all pixels, NaN where a disparity is missing; unknown truth is
    left out before.
    """
    size = np.abs(error)
    return (
        float(np.isfinite(size).mean()),
        float((~(size <= 1)).mean()),
        float((~(size <= 2)).mean()),
    )


def points_by_confidence(values: F32, confidence: F32, truth: F32) -> list[Point]:
    """From the surest pixel to all of them; pixels of one confidence come together.

    Parameters
    ----------
    values, confidence, truth : (H, W) float32
        Disparities [px] and truth [px], NaN where there is none; any confidence where there is a
        disparity.
    """
    known = np.isfinite(truth)
    error, sure = np.abs(values - truth)[known], confidence[known]
    found = np.isfinite(error)
    order = np.argsort(-sure[found], kind="stable")
    ordered, sure, total = error[found][order], sure[found][order], len(error)
    if not len(ordered):
        return [(0.0, 1.0, 1.0)]
    last = np.flatnonzero(np.append(np.diff(sure) != 0, True))
    last = last[np.unique(np.linspace(0, len(last) - 1, min(_POINTS, len(last))).astype(int))]
    right = [np.cumsum(ordered <= limit)[last] for limit in (1, 2)]
    return [
        ((i + 1) / total, 1 - a / total, 1 - b / total)
        for i, a, b in zip(last, *right, strict=True)
    ]


def read_at(curve: Sequence[Point], density: float) -> tuple[float, float]:
    """Bad-1 and bad-2 of a curve at a density; below its sparsest point the line ends in nothing
    found.
    """
    x, one, two = zip(*sorted([(0.0, 1.0, 1.0), *curve]), strict=True)
    return float(np.interp(density, x, one)), float(np.interp(density, x, two))


def rms_ratio(ours: F32, peers: F32, truth: F32) -> float:
    """RMS of our errors over that of the peer's, where both are within `_NEAR_PX` of the truth."""
    a, b = ours - truth, peers - truth
    both = (np.abs(a) < _NEAR_PX) & (np.abs(b) < _NEAR_PX)
    return (
        float(np.sqrt(np.mean(a[both] ** 2) / np.mean(b[both] ** 2)))
        if both.any()
        else float("nan")
    )


def verdicts(rows: Sequence[Compared]) -> list[_Verdict]:
    """Each peer at the one setting that is best for it on the mean of all sets, for bad-1 and for
    bad-2.
    """
    by: dict[tuple[str, str], list[Compared]] = {}
    for row in rows:
        by.setdefault((row.peer, row.setting), []).append(row)
    return [
        max(_of(by, peer, index), key=lambda verdict: verdict.difference)
        for peer in dict.fromkeys(peer for peer, _ in by)
        for index in (0, 1)
    ]


def _of(by: Mapping[tuple[str, str], list[Compared]], peer: str, index: int) -> list[_Verdict]:
    found = []
    for (name, setting), sets in by.items():
        if name == peer:
            each = [100 * (row.program[index] - row.peers[index]) for row in sets]
            won = sum(value < 0 for value in each)
            found.append(
                _Verdict(peer, f"bad-{index + 1}", setting, float(np.mean(each)), won, sets)
            )
    return found


def density_markdown(rows: Sequence[Compared]) -> str:
    """The peers at their best, then set by set."""
    found = verdicts(rows)
    head = [
        "peer at its best",
        "measure",
        "program − peer, points",
        "sets won",
        "RMS ratio, mean (worst)",
    ]
    cells = [
        [
            f"{v.peer} ({v.setting})",
            v.measure,
            f"{v.difference:+.2f}",
            f"{v.won} of {len(v.sets)}",
            _rms(v.sets),
        ]
        for v in found
    ]
    sets = ["set", "density %", *(f"{v.peer} {v.measure}" for v in found)]
    each = [[name, *_set_cells(found, name)] for name in dict.fromkeys(row.set for row in rows)]
    return f"{table(head, cells)}\n\nProgram − peer by set, points:\n\n{table(sets, each)}\n"


def _set_cells(found: Sequence[_Verdict], name: str) -> list[str]:
    rows = [next(row for row in verdict.sets if row.set == name) for verdict in found]
    parts = [100 * (r.program[i % 2] - r.peers[i % 2]) for i, r in enumerate(rows)]
    return [f"{100 * min(row.density for row in rows):.1f}", *(f"{part:+.2f}" for part in parts)]


def _rms(sets: Sequence[Compared]) -> str:
    ratios = [row.rms_ratio for row in sets]
    return f"{np.mean(ratios):.3f} ({np.max(ratios):.3f})"
