"""Semi-global matching in both directions on the crop that a region needs (Hirschmüller 2008,
OpenCV's StereoSGBM).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from stereo_ore.config import MatchingConfig
from stereo_ore.types import F32, I16, U8, Mask, Region

SUBPIXEL = 16
NONE = -SUBPIXEL
"""Any negative disparity of a crop means none."""

OWN_CHECK_OFF = 1_000_000
"""OpenCV compares left with right by whole pixels; -1, which is said to switch that off, acts as 1
px."""

CLEAN_PX, NOISY_PX, NOISY = 3, 5, 1.1
"""Matching windows of an automatic size, and the noise [grey levels] from which on the larger one
is taken: it errs less there, while the smaller one follows what is thin."""

NOISE_CELL_PX, _NOISE_SHARE, NOISE_ROWS = 16, 5, 4
"""Cells whose noise is measured, the per cent of them that are plainest, and of how many stretches
of rows one will do. """

_MODES = {
    "sgbm": cv2.STEREO_SGBM_MODE_SGBM,
    "3way": cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    "hh": cv2.STEREO_SGBM_MODE_HH,
    "hh4": cv2.STEREO_SGBM_MODE_HH4,
}


@dataclass(frozen=True)
class Crop:
    """The grey images that a region needs, (h, w + 2n) each for n disparities; pixels outside the
    image repeat its rim.

    Region column j is column j + n of both. The right image is shifted by the smallest disparity,
    so that the search begins at zero and no column of the region is lost to the border. Disparities
    of a crop are counted from there. `image_width` is that of the whole images, `gain` the left
    eye's contrast over the right one's.
    """

    left: U8
    right: U8
    region: Region
    image_width: int
    gain: float = 1.0

    @property
    def inner(self) -> U8:
        """The left image's own columns of the region, (h, w)."""
        n = self.region.num_disparities
        return np.ascontiguousarray(self.left[:, n:-n])

    @property
    def columns(self) -> F32:
        """The crop column of each column of the region, (w,)."""
        n = self.region.num_disparities
        return np.arange(n, self.left.shape[1] - n, dtype=np.float32)

    @property
    def right_columns(self) -> tuple[int, int]:
        """First and last (exclusive) crop column that holds the right image itself and may match
        the region.
        """
        region, width = self.region, self.right.shape[1] - self.region.num_disparities
        start = region.num_disparities + region.min_disparity - region.x0
        return min(max(start, 0), width - 1), min(max(start + self.image_width, 1), width)

    def rows(self, rows: slice) -> Crop:
        """Some rows of the crop; the region is still the whole one."""
        return replace(self, left=self.left[rows], right=self.right[rows])


def crop(left: U8, right: U8, region: Region) -> Crop:
    """Cut what the region needs out of two grey images (H, W)."""
    n, shift = region.num_disparities, region.min_disparity
    rows = slice(region.y0, region.y1)
    start, stop = region.x0 - n, region.x1 + n
    lefts, rights = (
        _columns(left[rows], start, stop),
        _columns(right[rows], start - shift, stop - shift),
    )
    return Crop(lefts, rights, region, left.shape[1])


def with_block(config: MatchingConfig, images: Crop) -> MatchingConfig:
    """The configuration with the size of the matching window that suits the images."""
    if config.block_size != "auto":
        return config
    size = NOISY_PX if noise(images.inner) >= NOISY else CLEAN_PX
    return config.model_copy(update={"block_size": size})


def noise(image: U8) -> float:
    """Standard deviation of the noise of a grey image [grey levels], from where it is plainest
    (Immerkær 1996).

    A mask that any slope of brightness leaves at zero is applied, and its mean size taken in each
    of many cells.
    """
    cell, (height, width) = NOISE_CELL_PX, image.shape
    if height < cell or width < cell:
        return 0.0
    rows = [
        image[y : y + cell, : width // cell * cell]
        for y in range(0, height - cell + 1, cell * NOISE_ROWS)
    ]
    once = np.array([1, -2, 1], np.float32)
    size = [
        np.abs(cv2.sepFilter2D(part, cv2.CV_32F, once, once)).reshape(cell, -1, cell).mean((0, 2))
        for part in rows
    ]
    return float(np.percentile(np.concatenate(size), _NOISE_SHARE) * np.sqrt(np.pi / 2) / 6)


def match_left(images: Crop, config: MatchingConfig) -> I16:
    """Disparity of the region's pixels, (h, w) int16 [px / 16], negative where none was found."""
    n = images.region.num_disparities
    end = images.left.shape[1] - n
    matcher = _matcher(config, 0, n)
    fixed = matcher.compute(
        np.ascontiguousarray(images.left[:, :end]), np.ascontiguousarray(images.right[:, :end])
    )
    return np.ascontiguousarray(fixed[:, n:], np.int16)


def match_right(images: Crop, config: MatchingConfig) -> I16:
    """Disparity of the right image's pixels, (h, w + n) int16 [px / 16], negative where none was
    found.

    Column j is column j of the crop, and matches its left column j + disparity. Only columns of the
    image itself are matched: those beside it repeat its rim.
    """
    n = images.region.num_disparities
    first, last = images.right_columns
    wide = slice(first, last + n)
    fixed = _matcher(config, 1 - n, n).compute(
        np.ascontiguousarray(images.right[:, wide]), np.ascontiguousarray(images.left[:, wide])
    )
    found = np.full((len(fixed), images.right.shape[1] - n), NONE, np.int16)
    np.negative(fixed[:, : last - first], out=found[:, first:last])
    return found


def drop_speckles(fixed: I16, size: int, step_px: float) -> Mask:
    """True where a disparity [px / 16] belongs to a connected patch of more than `size` pixels."""
    if size == 0:
        return np.asarray(fixed >= 0)
    kept = fixed.copy()
    cv2.filterSpeckles(kept, NONE, size, step_px * SUBPIXEL)
    return np.asarray(kept >= 0)


def to_px(fixed: I16) -> F32:
    """Sixteenths as pixels."""
    return np.multiply(fixed, np.float32(1 / SUBPIXEL), dtype=np.float32)


def _columns(image: U8, start: int, stop: int) -> U8:
    """Columns `start` to `stop` of an image; those outside repeat its rim."""
    width = image.shape[1]
    inner = image[:, min(max(start, 0), width - 1) : max(min(stop, width), 1)]
    before, after = max(-start, 0), max(stop - width, 0)
    return np.asarray(
        cv2.copyMakeBorder(inner, 0, 0, before, after, cv2.BORDER_REPLICATE), np.uint8
    )


def _matcher(config: MatchingConfig, lowest: int, count: int) -> cv2.StereoSGBM:
    block = CLEAN_PX if config.block_size == "auto" else config.block_size
    area = block**2
    return cv2.StereoSGBM.create(
        minDisparity=lowest,
        numDisparities=count,
        blockSize=block,
        P1=config.p1 * area,
        P2=config.p2 * area,
        disp12MaxDiff=OWN_CHECK_OFF,
        preFilterCap=config.pre_filter_cap,
        uniquenessRatio=config.uniqueness,
        speckleWindowSize=0,
        mode=_MODES[config.mode],
    )
