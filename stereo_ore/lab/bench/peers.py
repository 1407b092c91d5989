"""OpenCV's matchers as peers: every setting of a grid, the left border padded, the whole range
searched.

Each gives a curve of (density, bad-1, bad-2) over its own doubt, so that peers can be compared at
one density.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from stereo_ore.lab.bench.equal_density import Point, points_by_confidence, quality
from stereo_ore.lab.bench.stereo_sets import StereoSet
from stereo_ore.types import F32, U8

BLOCKS, UNIQUENESS, _SHOWN = (3, 5, 7), (0, 5, 10, 15, 20, 25, 40), 20
"""Settings tried; the disparities of `_SHOWN` are those whose sub-pixel errors are compared."""

_MODES = {"3WAY": cv2.STEREO_SGBM_MODE_SGBM_3WAY, "HH": cv2.STEREO_SGBM_MODE_HH}
P1, P2, CAP, LR_PX, SPECKLE, SPECKLE_RANGE = 8, 32, 63, 1, 100, 2
"""OpenCV's sample's: penalties times channels and block area, and what it drops."""

WLS_LAMBDA, WLS_SIGMA = 8000.0, 1.5


@dataclass(frozen=True)
class Peer:
    """A matcher at one setting of the grid: its name, the setting in words, its curve, and its
    disparities (H, W).
    """

    name: str
    setting: str
    curve: list[Point]
    values: F32


def grid(data: StereoSet) -> Iterator[Peer]:
    """Every peer at every setting on one set."""
    for colour in ("grey", "colour"):
        eyes = _padded(data, colour == "colour")
        for block in BLOCKS:
            words = f"block {block}, {colour}"
            for name in _MODES:
                found = {u: _sgbm(data, eyes, name, block, u) for u in UNIQUENESS}
                yield Peer(
                    name,
                    words,
                    [quality(values - data.truth) for values in found.values()],
                    found[_SHOWN],
                )
            values, sure = _wls(data, eyes, block)
            yield Peer("WLS", words, points_by_confidence(values, sure, data.truth), values)


def _padded(data: StereoSet, colour: bool) -> tuple[U8, U8]:
    """Both eyes with as many columns more at the left as disparities are searched: no pixel is lost
    to the border.
    """
    both = data.pair.left, data.pair.right
    eyes = both if colour else [cv2.cvtColor(eye, cv2.COLOR_BGR2GRAY) for eye in both]
    n, rim = data.region.num_disparities, cv2.BORDER_REPLICATE
    left, right = (np.asarray(cv2.copyMakeBorder(eye, 0, 0, n, 0, rim), np.uint8) for eye in eyes)
    return left, right


def _matcher(
    n: int, channels: int, name: str, block: int, checks: tuple[int, int, int, int]
) -> cv2.StereoSGBM:
    area = channels * block * block
    lr, uniqueness, speckle, step = checks
    return cv2.StereoSGBM.create(
        0, n, block, P1 * area, P2 * area, lr, CAP, uniqueness, speckle, step, _MODES[name]
    )


def _sgbm(data: StereoSet, eyes: tuple[U8, U8], name: str, block: int, uniqueness: int) -> F32:
    n, channels = data.region.num_disparities, 3 if eyes[0].ndim == 3 else 1
    matcher = _matcher(n, channels, name, block, (LR_PX, uniqueness, SPECKLE, SPECKLE_RANGE))
    return _pixels(matcher.compute(*eyes)[:, n:])


def _wls(data: StereoSet, eyes: tuple[U8, U8], block: int) -> tuple[F32, F32]:
    """Disparities of the weighted least squares filter over 3WAY, and its confidence, as in
    OpenCV's sample.
    """
    n, channels = data.region.num_disparities, 3 if eyes[0].ndim == 3 else 1
    matcher = _matcher(n, channels, "3WAY", block, (0, 0, 0, 0))
    smoother = cv2.ximgproc.createDisparityWLSFilter(matcher)
    smoother.setLambda(WLS_LAMBDA)
    smoother.setSigmaColor(WLS_SIGMA)
    left = matcher.compute(*eyes)
    right = cv2.ximgproc.createRightMatcher(matcher).compute(eyes[1], eyes[0])
    fixed = smoother.filter(left, _padded(data, colour=True)[0], disparity_map_right=right)
    return _pixels(fixed[:, n:]), np.asarray(smoother.getConfidenceMap()[:, n:], np.float32)


def _pixels(fixed: cv2.typing.MatLike) -> F32:
    return np.where(fixed >= 0, fixed / np.float32(16), np.float32(np.nan)).astype(np.float32)
