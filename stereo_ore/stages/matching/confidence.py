"""The probability that a disparity is right: one small network on what the two matches and the
images say.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cache
from importlib.resources import files

import cv2
import numpy as np

from stereo_ore.network import Network
from stereo_ore.stages.matching import sgbm, windows
from stereo_ore.threads import pool
from stereo_ore.types import F32, I16

RIGHT_PX = 1.0
"""A disparity is right when it is within this of the truth."""

AGREED_PX = 2.0
"""Left and right match agree up to this difference."""

_NEAR_PX = (7, 21, 61)
"""Windows in which the share of pixels that agree is taken."""

_STEP_PX, MAX_STEP_PX = 9, 16.0
"""Window over which steps of disparity are averaged, and how much one counts at most."""

WITNESSES = (
    "lr_diff_px", "agreed_7", "agreed_21", "agreed_61", "texture", "residual", "median_diff_px",
    "spread_px",
    "valid_share", "step_px",
)  # fmt: skip
"""What the network is given: cues of `types.CUES`, and

agreed_N    share of the pixels of a window on which left and right match agree, 0…1
residual    logarithm of one plus the standard deviation of left − warped right over a window
            [grey levels]
texture     logarithm of one plus the cue of that name
step_px     mean size of the steps of disparity along the rows in a window, px
"""


def agreement(difference: I16) -> list[F32]:
    """Share of pixels that agree in each window of `_NEAR_PX`, (h, w) each, from differences [px /
    16].
    """
    agreed = difference <= np.int16(AGREED_PX * sgbm.SUBPIXEL)
    return list(
        pool().map(
            lambda side: windows.count_valid(agreed, side) * np.float32(1 / side**2), _NEAR_PX
        )
    )


def witnesses(cues: Mapping[str, F32], agreed: list[F32], residual: F32, filled: F32) -> list[F32]:
    """`WITNESSES` of some rows, (h, w) each.

    Parameters
    ----------
    cues : mapping
        From `cues.pixel_cues`.
    agreed : list
        From `agreement`.
    residual : (h, w) float32
        From `subpixel.refine_disparity` [grey levels].
    filled : (h, w) float32
        Disparity as matched [px], 0 where it is not valid.
    """
    step = np.minimum(np.abs(cv2.Sobel(filled, cv2.CV_32F, 1, 0)), np.float32(MAX_STEP_PX))
    found = {
        **cues,
        **{f"agreed_{side}": share for side, share in zip(_NEAR_PX, agreed, strict=True)},
        "texture": np.log1p(cues["texture"]),
        "residual": np.log1p(residual),
        "step_px": windows.total(step, _STEP_PX) * np.float32(1 / _STEP_PX**2),
    }
    return [found[name] for name in WITNESSES]


def probability_right(seen: list[F32], network: Network | None = None) -> F32:
    """Probability of being within `RIGHT_PX` of the truth, (h, w) float32, from `witnesses`; the
    shipped network.
    """
    return (network or shipped()).map(seen)


@cache
def shipped() -> Network:
    """The network that comes with the package, of ``confidence.json``."""
    stored = json.loads(
        (files("stereo_ore.stages.matching") / "confidence.json").read_text(encoding="utf-8")
    )
    if tuple(stored["witnesses"]) != WITNESSES:
        raise ValueError("confidence.json was trained on other witnesses; train it again")
    return Network(**stored["network"])
