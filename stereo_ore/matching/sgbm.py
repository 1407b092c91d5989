"""Semi-global matching in both directions on the crop that a region needs (Hirschmüller 2008, OpenCV's StereoSGBM)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from stereo_ore.config import MatchingConfig
from stereo_ore.types import F32, U8, Mask, Region

SUBPIXEL = 16
MODES = {
    "sgbm": cv2.STEREO_SGBM_MODE_SGBM,
    "3way": cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    "hh": cv2.STEREO_SGBM_MODE_HH,
    "hh4": cv2.STEREO_SGBM_MODE_HH4,
}


@dataclass(frozen=True)
class Crop:
    """The grey images that a region needs, (h, w + 2n) each for n disparities; pixels outside the image repeat its rim.

    Region column j is column j + n of both. The right image is shifted by the smallest disparity, so that the search
    begins at zero and no column of the region is lost to the border. Disparities of a crop are counted from there.
    """

    left: U8
    right: U8
    region: Region

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


def crop(left: U8, right: U8, region: Region) -> Crop:
    """Cut what the region needs out of two grey images (H, W)."""
    n, width = region.num_disparities, left.shape[1]
    rows = slice(region.y0, region.y1)
    columns = np.arange(region.x0 - n, region.x1 + n)
    take_left = np.clip(columns, 0, width - 1)
    take_right = np.clip(columns - region.min_disparity, 0, width - 1)
    return Crop(left[rows][:, take_left], right[rows][:, take_right], region)


def match_left(images: Crop, config: MatchingConfig) -> F32:
    """Disparity of the region's pixels, (h, w) float32 [px], NaN where none was found."""
    n = images.region.num_disparities
    end = images.left.shape[1] - n
    matcher = _matcher(config, 0, n)
    fixed = matcher.compute(np.ascontiguousarray(images.left[:, :end]), np.ascontiguousarray(images.right[:, :end]))
    return _to_float(fixed[:, n:], 0)


def match_right(images: Crop, config: MatchingConfig) -> F32:
    """Disparity of the right image's pixels, (h, w + n) float32 [px]: column j matches left column j + disparity.

    Column j of the result is column j of the crop.
    """
    n = images.region.num_disparities
    fixed = _matcher(config, 1 - n, n).compute(images.right, images.left)
    return -_to_float(fixed[:, : images.right.shape[1] - n], 1 - n)


def drop_speckles(values: F32, size: int, step_px: float) -> Mask:
    """True where a disparity belongs to a connected patch of at least `size` pixels."""
    valid = np.isfinite(values)
    if size == 0:
        return valid
    none = -SUBPIXEL
    fixed = np.where(valid, values * np.float32(SUBPIXEL), np.float32(none)).astype(np.int16)
    cv2.filterSpeckles(fixed, none, size, step_px * SUBPIXEL)
    return np.asarray(fixed != none)


def _matcher(config: MatchingConfig, lowest: int, count: int) -> cv2.StereoSGBM:
    area = config.block_size**2
    return cv2.StereoSGBM.create(
        minDisparity=lowest,
        numDisparities=count,
        blockSize=config.block_size,
        P1=config.p1 * area,
        P2=config.p2 * area,
        disp12MaxDiff=-1,
        preFilterCap=config.pre_filter_cap,
        uniquenessRatio=config.uniqueness,
        speckleWindowSize=0,
        mode=MODES[config.mode],
    )


def _to_float(fixed: cv2.typing.MatLike, lowest: int) -> F32:
    """OpenCV's int16 sixteenths of a pixel as float32, its "none" as NaN."""
    values = fixed.astype(np.float32) / np.float32(SUBPIXEL)
    values[fixed < lowest * SUBPIXEL] = np.nan
    return np.asarray(values, np.float32)
