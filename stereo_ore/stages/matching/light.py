"""Eyes that see the scene in different light: like brightness or local normalisation, where a small
copy gains.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from stereo_ore.config import MatchingConfig
from stereo_ore.stages.matching import consistency, sgbm
from stereo_ore.stages.matching.consistency import Agreement
from stereo_ore.stages.matching.region import round_up
from stereo_ore.stages.matching.sgbm import Crop
from stereo_ore.types import F32, U8, Region

COARSE_WIDTH_PX = 240
"""Largest width to which images are reduced for a first look; by two at least."""

_COARSE = {
    "mode": "3way",
    "block_size": 3,
    "uniqueness": 10,
    "lr_max_diff": 1.0,
    "speckle_size": 20,
    "speckle_range": 1.0,
}
"""A noisy disparity of the small copy would widen the range, so doubt decides against it; no lump
is a speckle."""

ALIKE_LOSS, EVEN_GAIN = 0.01, 0.018
"""Share of the pixels that may agree less with like brightness, which hardly ever harms; and that
must agree in addition for normalised images to be matched, which cost a point of bad pixels or more
where light is the same."""

ENOUGH = 0.9
"""Share of the pixels that agree which no other light would raise much: then the look is over."""

UNLIKE = 0.5
"""Mean difference of the eyes' brightness [grey levels] from which on one is given the other's."""

SIGMA_PX, _NOISE, CONTRAST, MIDDLE = 7.0, 4.0, 42.0, 128.0
"""Standard deviation of the window; grey levels added to the contrast in it, that of noise; grey
levels given to one standard deviation; grey level given to the mean."""


def coarse_scale(width: int) -> int:
    """By how much images of a width are reduced for the first look."""
    return max(-(-width // COARSE_WIDTH_PX), 2)


@dataclass(frozen=True)
class _Look:
    """What a small copy shows: what both directions find on it, and in which of its images.

    `like` is whether the right eye's brightness is to be made the left's, `even` whether to match
    normalised images.
    """

    found: Agreement
    like: bool
    even: bool

    @property
    def share(self) -> float:
        """Share of the pixels that agree."""
        return float(self.found.valid.mean())


def first_look(small: Crop, config: MatchingConfig) -> _Look:
    """Match a small copy with like brightness, and where that is not enough as it is and
    normalised; choose.
    """
    quick = config.model_copy(update=_COARSE)
    alike = with_like_brightness(small) if config.even_light else small
    best = _Look(consistency.match_both(alike, quick), like=alike is not small, even=False)
    if not config.even_light or best.share >= ENOUGH:
        return best
    if best.like:
        plain = _Look(consistency.match_both(small, quick), like=False, even=False)
        best = plain if plain.share - best.share > ALIKE_LOSS else best
    even = replace(best, found=consistency.match_both(small, quick, normalised(small)), even=True)
    return even if even.share - best.share > EVEN_GAIN else best


def evened(images: Crop, config: MatchingConfig) -> tuple[Crop, Crop]:
    """The images with their gain, and those to be matched, as far as a small copy shows that it
    pays.

    Rounded to whole grey levels, images of like brightness suit the matcher, but not the
    refinement.
    """
    scale = coarse_scale(images.left.shape[1])
    n, (height, width) = (
        images.region.num_disparities // scale,
        (side // scale for side in images.left.shape),
    )
    if not config.even_light or min(n, height, width - 2 * n) < 1:
        return images, images
    inner = Region(n, 0, width - n, height, 0, round_up(n + 1))
    look = first_look(
        sgbm.crop(reduced(images.left, scale), reduced(images.right, scale), inner), config
    )
    compared = with_like_brightness(images) if look.like else images
    gain = float(compared.right.std() / max(images.right.std(), 1.0)) if look.like else 1.0
    return replace(images, gain=gain), normalised(images) if look.even else compared


def with_like_brightness(images: Crop) -> Crop:
    """The right image with the left one's histogram; the same images where theirs are alike
    already.

    A monotone map of brightness, that of the distributions, makes up for exposure, gain, offset and
    gamma.
    """
    first, last = images.right_columns
    # Exact up to 2^24 pixels, and many times faster than `np.bincount`.
    own, other = (
        cv2.calcHist([image], [0], None, [256], [0, 256]).ravel().astype(np.int64)
        for image in (images.right[:, first:last], images.inner)
    )
    shares = [np.cumsum(count) / count.sum() for count in (own, other)]
    levels = np.arange(256)
    wanted = np.interp(shares[0], shares[1], levels)
    if float(np.abs(wanted - levels) @ own) <= UNLIKE * own.sum():
        return images
    return replace(
        images, right=np.asarray(cv2.LUT(images.right, np.rint(wanted).astype(np.uint8)), np.uint8)
    )


def normalised(images: Crop) -> Crop:
    """Both images with equal mean and contrast everywhere."""
    return replace(images, left=_normalise(images.left), right=_normalise(images.right))


def _normalise(image: U8) -> U8:
    """(I − mean) / (standard deviation + noise) in a Gaussian window, as grey levels."""
    grey = image.astype(np.float32)
    mean = _blur(grey)
    spread = np.sqrt(np.maximum(_blur(grey * grey) - mean * mean, np.float32(0)))
    even = (grey - mean) / (spread + np.float32(_NOISE)) * np.float32(CONTRAST) + np.float32(MIDDLE)
    return np.asarray(cv2.convertScaleAbs(np.maximum(even, np.float32(0))), np.uint8)


def _blur(image: F32) -> F32:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), SIGMA_PX), np.float32)


def reduced(image: U8, scale: int) -> U8:
    """A smaller copy, by means over squares."""
    height, width = image.shape[0] // scale, image.shape[1] // scale
    part = image[: height * scale, : width * scale]
    return np.asarray(cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
