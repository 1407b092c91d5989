"""Eyes that see the scene in different light: local normalisation, where a small copy shows that it pays."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from stereo_ore.config import MatchingConfig
from stereo_ore.matching import consistency, sgbm
from stereo_ore.matching.consistency import Agreement
from stereo_ore.matching.region import round_up
from stereo_ore.matching.sgbm import Crop
from stereo_ore.types import F32, U8, Region

COARSE_WIDTH_PX = 240
"""Largest width to which images are reduced for a first look; by two at least."""

COARSE = {"mode": "3way", "uniqueness": 10, "lr_max_diff": 1.0, "speckle_size": 20, "speckle_range": 1.0}
"""A noisy disparity of the small copy would widen the range, so doubt decides against it; no lump is a speckle."""

WORTH = 0.01
"""Share of the pixels that must agree in addition: it costs one point of bad pixels or more where light is the same."""

SIGMA_PX, NOISE, CONTRAST, MIDDLE = 7.0, 4.0, 42.0, 128.0
"""Standard deviation of the window; grey levels added to the contrast in it, that of noise; grey levels given to one
standard deviation; grey level given to the mean."""


def coarse_scale(width: int) -> int:
    """By how much images of a width are reduced for the first look."""
    return max(-(-width // COARSE_WIDTH_PX), 2)


def first_look(small: Crop, config: MatchingConfig) -> tuple[Agreement, bool]:
    """What both directions find on a small copy, and whether normalised images are needed for that."""
    quick = config.model_copy(update=COARSE)
    plain = consistency.match_both(small, quick)
    if not config.even_light:
        return plain, False
    even = consistency.match_both(small, quick, normalised(small))
    pays = bool(even.valid.mean() - plain.valid.mean() > WORTH)
    return (even if pays else plain), pays


def evened(images: Crop, config: MatchingConfig) -> Crop:
    """The images to be matched: normalised where more of a small copy is matched so, else as they are."""
    if not config.even_light:
        return images
    scale = coarse_scale(images.left.shape[1])
    left, right = reduced(images.left, scale), reduced(images.right, scale)
    n = images.region.num_disparities
    if not left.size or n // scale == 0:
        return images
    height, width = left.shape
    inner = Region(n // scale, 0, max(width - n // scale, n // scale + 1), height, 0, round_up(n // scale + 1))
    return normalised(images) if first_look(sgbm.crop(left, right, inner), config)[1] else images


def normalised(images: Crop) -> Crop:
    """Both images with equal mean and contrast everywhere."""
    return replace(images, left=_normalise(images.left), right=_normalise(images.right))


def _normalise(image: U8) -> U8:
    """(I − mean) / (standard deviation + noise) in a Gaussian window, as grey levels."""
    grey = image.astype(np.float32)
    mean = _blur(grey)
    spread = np.sqrt(np.maximum(_blur(grey * grey) - mean * mean, np.float32(0)))
    even = (grey - mean) / (spread + np.float32(NOISE)) * np.float32(CONTRAST) + np.float32(MIDDLE)
    return np.asarray(cv2.convertScaleAbs(np.maximum(even, np.float32(0))), np.uint8)


def _blur(image: F32) -> F32:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), SIGMA_PX), np.float32)


def reduced(image: U8, scale: int) -> U8:
    """A smaller copy, by means over squares."""
    height, width = image.shape[0] // scale, image.shape[1] // scale
    if not height or not width:
        return np.empty((0, 0), np.uint8)
    part = image[: height * scale, : width * scale]
    return np.asarray(cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
