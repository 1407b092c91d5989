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
from stereo_ore.stages.matching import relief, sgbm, windows
from stereo_ore.stages.matching.consistency import Agreement
from stereo_ore.stages.matching.sgbm import Crop
from stereo_ore.threads import pool
from stereo_ore.types import F32, Mask

RIGHT_PX = 1.0
"""A disparity is right when it is within this of the truth."""

AGREED_PX = 2.0
"""Left and right match agree up to this difference."""

_NEAR_PX = (7, 21, 61)
"""Windows in which the share of pixels that agree is taken."""

_INNER_PX = 24.0
"""Pixels farther than this from any without a disparity are alike."""

_STEP_PX, MAX_STEP_PX = 9, 16.0
"""Window over which steps of disparity are averaged, and how much one counts at most."""

_SURFACE = tuple(f"{name}_{side}_px" for side in (14, 36) for name in ("offset", "scatter"))
_CONTEXT = (*(f"agreed_{side}" for side in _NEAR_PX), "inside_px", *_SURFACE, "off_alike_px")
PIXEL_FEATURES = (
    "lr_diff_px", *_CONTEXT, "texture", "residual", "median_diff_px", "spread_px", "valid_share",
    "step_px",
)  # fmt: skip
"""What the network is given: cues of `types.CUES`, and

agreed_N    share of the pixels of a window on which left and right match agree, 0…1
inside_px   logarithm of one plus the distance to the nearest pixel without a disparity
off_alike_px  disparity less what is likely by its brightness; offsets as asinh(3·offset)
residual    logarithm of one plus the standard deviation of left − warped right over a window
            [grey levels]
texture     logarithm of one plus the cue of that name; of scatter_N_px its logarithm
step_px     mean size of the steps of disparity along the rows in a window, px
"""


def context(images: Crop, found: Agreement, surface: Mapping[str, F32]) -> list[F32]:
    """What the features of `_CONTEXT` are made of, (h, w) each, which looks farther than a band of
    rows reaches; `surface` is from `relief.relief_cues`.
    """
    agreed = found.difference <= np.int16(AGREED_PX * sgbm.SUBPIXEL)
    jobs = [pool().submit(_share, agreed, side) for side in _NEAR_PX]
    jobs.append(pool().submit(_inside, found.valid))
    alike = relief.off_alike(found.filled, found.valid, images.inner)
    return [*(job.result() for job in jobs), *(surface[name] for name in _SURFACE), alike]


def _share(agreed: Mask, side: int) -> F32:
    return windows.count_valid(agreed, side) * np.float32(1 / side**2)


def _inside(valid: Mask) -> F32:
    away = cv2.distanceTransform(valid.view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_3)
    return np.asarray(np.log1p(np.minimum(away, np.float32(_INNER_PX))), np.float32)


def pixel_features(
    cues: Mapping[str, F32], around: list[F32], residual: F32, filled: F32
) -> list[F32]:
    """`PIXEL_FEATURES` of some rows, (h, w) each.

    Parameters
    ----------
    cues : mapping
        From `cues.pixel_cues`.
    around : list
        From `context`.
    residual : (h, w) float32
        From `subpixel.refine_disparity` [grey levels].
    filled : (h, w) float32
        Disparity as matched [px], 0 where it is not valid.
    """
    wide = {name: _scaled(name, image) for name, image in zip(_CONTEXT, around, strict=True)}
    step = np.minimum(np.abs(cv2.Sobel(filled, cv2.CV_32F, 1, 0)), np.float32(MAX_STEP_PX))
    found = {
        **cues,
        **wide,
        "texture": np.log1p(cues["texture"]),
        "residual": np.log1p(residual),
        "step_px": windows.total(step, _STEP_PX) * np.float32(1 / _STEP_PX**2),
    }
    return [found[name] for name in PIXEL_FEATURES]


def _scaled(name: str, image: F32) -> F32:
    if name.startswith("off"):
        return np.asarray(np.arcsinh(3 * image), np.float32)
    if name.startswith("scatter"):
        return np.asarray(np.log(image + np.float32(0.05)), np.float32)
    return image


def probability_right(seen: list[F32], network: Network | None = None) -> F32:
    """Probability of being within `RIGHT_PX` of the truth, (h, w) float32, from `pixel_features`;
    of the shipped network if no other is given.
    """
    return (network or shipped()).map(seen)


@cache
def shipped() -> Network:
    """The network that comes with the package, of ``confidence.json``."""
    stored = json.loads(
        (files("stereo_ore.stages.matching") / "confidence.json").read_text(encoding="utf-8")
    )
    if tuple(stored["features"]) != PIXEL_FEATURES:
        raise ValueError("confidence.json was trained on other features; train it again")
    return Network(**stored["network"])
