"""From disparities to points in metres, and from kept points back to the image."""

from __future__ import annotations

import numpy as np

from stereo_ore.config import CloudConfig
from stereo_ore.rays import contained
from stereo_ore.types import (
    I32,
    Disparity,
    Mask,
    PointCloud,
    RectifiedPair,
    Region,
    Surface,
    Volume,
)


def reproject(
    disparity: Disparity,
    pair: RectifiedPair,
    volume: Volume | None,
    config: CloudConfig,
    sigma_px: float,
) -> PointCloud:
    """The points of all pixels of the matched rectangle, z = fx·B / (d + doffs), cropped to the
    volume.

    Parameters
    ----------
    disparity : Disparity
        Of the left image.
    pair : RectifiedPair
        Images and geometry.
    volume : Volume or None
        Points outside are left out; None keeps all up to `config.max_depth_m`.
    config : CloudConfig
        Depth limit.
    sigma_px : float
        Standard deviation of a disparity [px], for `sigma_z`.

    Returns
    -------
    PointCloud
        In ascending pixel order.
    """
    rig, region = pair.rig, disparity.region
    values = disparity.values[region.slices]
    # NaN compares false, so this also leaves out the pixels without a disparity.
    inside = values >= np.float32(rig.disparity(config.max_depth_m))
    with np.errstate(divide="ignore"):
        depth = np.float32(rig.fx * rig.baseline_m) / (values + np.float32(rig.doffs_px))
    x = np.arange(region.x0, region.x1, dtype=np.float32) - np.float32(rig.cx)
    y = np.arange(region.y0, region.y1, dtype=np.float32) - np.float32(rig.cy)
    if volume is not None:
        inside &= contained(volume, depth, np.asarray(x / rig.fx), np.asarray(y / rig.fy))
    index = np.flatnonzero(inside).astype(np.int32)
    row, column = _rows_columns(index, values.shape[1])
    z = depth.ravel()[index]
    pixel: I32 = (row + np.int32(region.y0)) * np.int32(rig.width) + (column + np.int32(region.x0))
    return PointCloud(
        np.stack([x[column] * z / np.float32(rig.fx), y[row] * z / np.float32(rig.fy), z], -1),
        pixel,
        np.take(pair.left.reshape(-1, 3), pixel, axis=0),
        z**2 * np.float32(rig.depth_sigma(1.0, sigma_px)),
        (rig.height, rig.width),
    )


_HORIZON_M = 1e6
"""Farther than any pair of eyes can tell from infinity."""


def nearest_beyond(
    disparity: Disparity, pair: RectifiedPair, volume: Volume | None, config: CloudConfig
) -> float | None:
    """Depth [m] of the nearest point that `config.max_depth_m` alone keeps out of the cloud; None
    without one.
    """
    unlimited = config.model_copy(update={"max_depth_m": _HORIZON_M})
    points = reproject(disparity, pair, volume, unlimited, 1.0)
    beyond = points.xyz[points.xyz[:, 2] > config.max_depth_m, 2]
    return float(beyond.min()) if len(beyond) else None


def _rows_columns(index: I32, width: int) -> tuple[I32, I32]:
    """Row and column of flat indices; `np.divmod` is several times slower."""
    row = np.asarray(index // np.int32(width), np.int32)
    return row, index - row * np.int32(width)


def surface(cloud: PointCloud, keep_points: Mask, pair: RectifiedPair, region: Region) -> Surface:
    """The kept points laid back into the image, cropped to the matched rectangle that the cloud was
    made from.
    """
    height, width = region.y1 - region.y0, region.x1 - region.x0
    kept = np.flatnonzero(keep_points)
    row, column = _rows_columns(cloud.pixel[kept], cloud.image_shape[1])
    # Point of each pixel; the one after the last stands for none.
    point = np.full(height * width, len(cloud), np.int32)
    point[(row - np.int32(region.y0)) * np.int32(width) + (column - np.int32(region.x0))] = kept
    xyz = np.append(cloud.xyz, np.full((1, 3), np.nan, np.float32), axis=0)
    sigma = np.append(cloud.sigma_z, np.float32(np.nan))
    return Surface(
        np.take(xyz, point, axis=0).reshape(height, width, 3),
        pair.left[region.slices].copy(),
        np.take(sigma, point).reshape(height, width),
        region.x0,
        region.y0,
        pair.rig,
    )
