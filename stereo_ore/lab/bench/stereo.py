"""Matching against truth, beside OpenCV's own with its sample settings, in one process."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from stereo_ore.config import MatchingConfig
from stereo_ore.lab.bench import peers
from stereo_ore.lab.bench.equal_density import Compared, points_by_confidence, read_at, rms_ratio
from stereo_ore.lab.bench.stereo_sets import StereoSet
from stereo_ore.lab.bench.tables import table
from stereo_ore.lab.metrics import area_under_roc, reliability
from stereo_ore.stages import matching
from stereo_ore.types import F32, F64, Disparity, Mask

Matcher = Callable[[StereoSet], F32 | F64]

_PLAIN_DISPARITIES, PLAIN_WIDTH = 128, 1280
"""What plain 3WAY searches over the whole image, at this width: the reference of time for a matcher
with a site."""


@dataclass(frozen=True)
class StereoRow:
    """One matcher on one set: shares in % of the pixels with truth, missing ones counted as bad;
    times in ms.

    `scope` is "all", "seen" (by both eyes) or "ore". `density` is the share with a disparity,
    `bad2_found` the share of these that is wrong by more than 2 px, `bias` [px] the median signed
    error of what is right to 1 px.
    """

    set: str
    matcher: str
    scope: str
    density: float
    bad1: float
    bad2: float
    bad2_found: float
    median: float
    bias: float
    ms: float


@dataclass(frozen=True)
class Sureness:
    """Our confidence on a set: area under the ROC curve for "within 1 px"; of each tenth, what is
    said and true.
    """

    set: str
    auc: float | None
    said: list[float | None]
    true: list[float | None]


def ours(data: StereoSet, config: MatchingConfig = MatchingConfig()) -> F32:  # noqa: B008 - frozen
    """All of this program's matching: a look at the range, both directions, refinement, cues."""
    return measured(data, config).values


def measured(data: StereoSet, config: MatchingConfig = MatchingConfig()) -> Disparity:  # noqa: B008 - frozen
    """The same with its confidence."""
    region = matching.narrow(data.pair, data.region, data.volume, config)
    return matching.match(data.pair, region, config)


def opencv_sgbm(data: StereoSet) -> F64:
    """``StereoSGBM`` as OpenCV's ``stereo_match.cpp`` sets it up; its lost left border is not made
    up for.
    """
    area = 3 * 3 * 3
    matcher = cv2.StereoSGBM.create(
        *_range(data), 3, 8 * area, 32 * area, 1, 63, 10, 100, 32, cv2.STEREO_SGBM_MODE_SGBM
    )
    return _pixels(matcher.compute(data.pair.left, data.pair.right), data.region.min_disparity)


def opencv_wls(data: StereoSet) -> F64:
    """``StereoSGBM`` and the weighted least squares filter as OpenCV's ``disparity_filtering.cpp``
    sets them up.
    """
    area = 3 * 3
    matcher = cv2.StereoSGBM.create(
        *_range(data), 3, 24 * area, 96 * area, 0, 63, 0, 0, 0, cv2.STEREO_SGBM_MODE_SGBM_3WAY
    )
    wls = cv2.ximgproc.createDisparityWLSFilter(matcher)
    wls.setLambda(8000.0)
    wls.setSigmaColor(1.5)
    left = matcher.compute(data.pair.left, data.pair.right)
    right = cv2.ximgproc.createRightMatcher(matcher).compute(data.pair.right, data.pair.left)
    return _pixels(
        wls.filter(left, data.pair.left, disparity_map_right=right), data.region.min_disparity
    )


def opencv_3way(data: StereoSet) -> F64:
    """Plain 3WAY on grey images over the whole image, 128 disparities at 1280 px: the reference of
    time.
    """
    count = 16 * -(-data.pair.rig.width * _PLAIN_DISPARITIES // PLAIN_WIDTH // 16)
    grey = [cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in (data.pair.left, data.pair.right)]
    matcher = cv2.StereoSGBM.create(
        0, count, 5, 200, 800, 1, 31, 10, 100, 32, cv2.STEREO_SGBM_MODE_SGBM_3WAY
    )
    return _pixels(matcher.compute(*grey), 0)


MATCHERS: dict[str, Matcher] = {
    "stereo-ore": ours,
    "SGBM": opencv_sgbm,
    "SGBM+WLS": opencv_wls,
    "3WAY": opencv_3way,
}


def judge_matchers(sets: Iterable[StereoSet], repeats: int = 3) -> Iterator[StereoRow]:
    """Every matcher on every set, in turns, so that a busy machine slows all of them alike."""
    for data in sets:
        found = {name: matcher(data) for name, matcher in MATCHERS.items()}
        times: dict[str, list[float]] = {name: [] for name in MATCHERS}
        for _ in range(repeats):
            for name, matcher in MATCHERS.items():
                start = time.perf_counter()
                matcher(data)
                times[name].append(1000 * (time.perf_counter() - start))
        for name, disparity in found.items():
            yield from _rows(data, name, disparity, float(np.median(times[name])))


def beside_peers(data: StereoSet) -> Iterator[Compared]:
    """Our disparities and every peer's at every setting of the grid, compared at one density."""
    found, known = measured(data), np.isfinite(data.truth)
    curve = points_by_confidence(found.values, found.confidence, data.truth)
    density = curve[-1][0]
    for peer in peers.grid(data):
        at = min(density, max(point[0] for point in peer.curve))
        both = read_at(curve, at), read_at(peer.curve, at)
        ratio = rms_ratio(found.values[known], peer.values[known], data.truth[known])
        yield Compared(data.name, peer.name, peer.setting, at, *both, ratio)


def sureness(data: StereoSet) -> Sureness:
    """How far our confidence is to be believed, over all pixels with a disparity and truth."""
    found = measured(data)
    error = np.abs(found.values - data.truth)
    known = np.isfinite(error)
    said, right = found.confidence[known], error[known] <= 1
    return Sureness(data.name, area_under_roc(said, right), *reliability(said, right))


def _rows(data: StereoSet, matcher: str, disparity: F32 | F64, ms: float) -> Iterator[StereoRow]:
    known = np.isfinite(data.truth)
    scopes: dict[str, Mask | None] = {"all": known, "seen": data.seen, "ore": data.ore}
    for scope, where in scopes.items():
        if where is not None and (where & known).any():
            error = np.asarray(disparity - data.truth, float)[where & known]
            yield StereoRow(data.name, matcher, scope, **_quality(error), ms=ms)


def _quality(error: F64) -> dict[str, float]:
    """Density, bad-1, bad-2, bad-2 of what was found, median and bias of signed errors, NaN =
    missing.
    """
    found = np.abs(error[np.isfinite(error)])
    right = error[np.abs(error) <= 1]
    return {
        "density": 100 * len(found) / len(error),
        "bad1": 100 * float((~(np.abs(error) <= 1)).mean()),
        "bad2": 100 * float((~(np.abs(error) <= 2)).mean()),
        "bad2_found": 100 * float((found > 2).mean()) if len(found) else float("nan"),
        "median": float(np.median(found)) if len(found) else float("nan"),
        "bias": float(np.median(right)) if len(right) else float("nan"),
    }


def sureness_markdown(found: Sequence[Sureness]) -> str:
    """A row a set: area under the ROC curve, and the share that is right in each tenth of the
    confidence.
    """
    head = ["set", "AUC", *(f"{low / 10:.1f}…{(low + 1) / 10:.1f}" for low in range(10))]
    rows = [
        [
            s.set,
            "–" if s.auc is None else f"{s.auc:.3f}",
            *("–" if x is None else f"{x:.2f}" for x in s.true),
        ]
        for s in found
    ]
    return f"Share within 1 px of the truth, by the confidence said:\n\n{table(head, rows)}\n"


def stereo_markdown(rows: Sequence[StereoRow]) -> str:
    """One table a scope."""
    parts = []
    for scope, title in (
        ("all", "All pixels with truth"),
        ("seen", "Pixels that both eyes see"),
        ("ore", "Ore"),
    ):
        chosen = [row for row in rows if row.scope == scope]
        if chosen:
            head = [
                "set",
                "matcher",
                "density %",
                "bad-1 %",
                "bad-2 %",
                "bad-2 of found %",
                "median px",
                "ms",
            ]
            parts.append(
                f"**{title}** (missing counts as"
                f" bad)\n\n{table(head, [_cells(row) for row in chosen])}"
            )
    return "\n\n".join(parts) + "\n"


def _cells(row: StereoRow) -> list[str]:
    shares = [f"{value:.1f}" for value in (row.density, row.bad1, row.bad2, row.bad2_found)]
    return [row.set, row.matcher, *shares, f"{row.median:.3f}", f"{row.ms:.0f}"]


def _range(data: StereoSet) -> tuple[int, int]:
    return data.region.min_disparity, data.region.num_disparities


def _pixels(fixed: cv2.typing.MatLike, lowest: int) -> F64:
    return np.where(fixed >= 16 * lowest, fixed / 16.0, np.nan)
