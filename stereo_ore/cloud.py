"""From disparities to points in metres, and from kept points back to the image."""

from __future__ import annotations

import numpy as np

from stereo_ore.config import CloudConfig
from stereo_ore.types import Disparity, Mask, PointCloud, RectifiedPair, Region, Surface, Volume


def reproject(
    disparity: Disparity, pair: RectifiedPair, volume: Volume | None, config: CloudConfig, sigma_px: float
) -> PointCloud:
    """The points of all pixels with a disparity, z = fx·B / (d + doffs), cropped to the volume.

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
    rig = pair.rig
    values = disparity.values.ravel()
    least = float(rig.disparity(config.max_depth_m))
    # NaN compares false, so this also leaves out the pixels without a disparity.
    pixel = np.flatnonzero(values >= least).astype(np.int32)
    v, u = np.divmod(pixel, np.int32(rig.width))
    z = np.float32(rig.fx * rig.baseline_m) / (values[pixel] + np.float32(rig.doffs_px))
    x = (u - np.float32(rig.cx)) * z / np.float32(rig.fx)
    y = (v - np.float32(rig.cy)) * z / np.float32(rig.fy)
    xyz = np.stack([x, y, z], -1, dtype=np.float32)
    if volume is not None:
        inside = volume.contains(xyz)
        xyz, pixel, z = xyz[inside], pixel[inside], z[inside]
    return PointCloud(
        xyz,
        pixel,
        pair.left.reshape(-1, 3)[pixel],
        rig.depth_sigma(z, sigma_px).astype(np.float32),
        (rig.height, rig.width),
    )


def surface(cloud: PointCloud, keep_points: Mask, pair: RectifiedPair, region: Region) -> Surface:
    """The kept points laid back into the image, cropped to the matched rectangle."""
    size = cloud.image_shape[0] * cloud.image_shape[1]
    xyz = np.full((size, 3), np.nan, np.float32)
    sigma = np.full(size, np.nan, np.float32)
    pixel = cloud.pixel[keep_points]
    xyz[pixel] = cloud.xyz[keep_points]
    sigma[pixel] = cloud.sigma_z[keep_points]
    part = region.slices
    return Surface(
        xyz.reshape(*cloud.image_shape, 3)[part].copy(),
        pair.left[part].copy(),
        sigma.reshape(cloud.image_shape)[part].copy(),
        region.x0,
        region.y0,
        pair.rig,
    )
