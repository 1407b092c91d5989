"""The anchored voxel grid: one sorted cell for the points that fall into it, and the way back to
them.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from stereo_ore.config import VoxelConfig
from stereo_ore.errors import CloudError
from stereo_ore.threads import pool
from stereo_ore.types import F32, I32, Disparity, PointCloud, Rig, Volume, VoxelCloud

Int64 = npt.NDArray[np.int64]

SIZE_STEP_M = 0.0005
"""Automatic sizes are multiples of this, so that the grid stays the same from frame to frame."""

MAX_BITS = 62


def voxel_size(config: VoxelConfig, rig: Rig, volume: Volume | None, cloud: PointCloud) -> float:
    """Edge of a voxel [m]: the configured one, or `pixels` × the size of a pixel at the scene's
    middle depth.

    The middle depth is the cloud's median, or that of the volume's corners when the cloud is empty.
    """
    if config.size_m != "auto":
        return float(config.size_m)
    if len(cloud):
        depth = float(np.median(cloud.xyz[:, 2]))
    elif volume is not None:
        depth = max(float(np.median(volume.corners[:, 2])), 0.0)
    else:
        depth = 1.0
    return max(round(config.pixels * depth / rig.fx / SIZE_STEP_M), 1) * SIZE_STEP_M


def voxelise(cloud: PointCloud, disparity: Disparity, rig: Rig, size_m: float) -> VoxelCloud:
    """Gather points in cells of a grid anchored at the camera's origin.

    Parameters
    ----------
    cloud : PointCloud
        Points [m].
    disparity : Disparity
        Its cues are averaged over the points of each voxel.
    rig : Rig
        For the size of a pixel.
    size_m : float
        Edge of a voxel [m].

    Returns
    -------
    VoxelCloud
        Sorted by voxel key (x, then y, then z).

    Raises
    ------
    CloudError
        When the grid would have more cells than a key can number.
    """
    along = np.ascontiguousarray(cloud.xyz.T)
    inverse, count = _group(_keys(along, size_m))

    # Of another type they would be converted for every sum.
    cells = inverse.astype(np.intp)

    def mean(values: npt.NDArray[np.floating]) -> F32:
        return (np.bincount(cells, values, len(count)) / count).astype(np.float32)

    region = disparity.region
    v, u = np.divmod(cloud.pixel, np.int32(cloud.image_shape[1]))
    at = (v - region.y0) * (region.x1 - region.x0) + (u - region.x0)
    means = pool().map(lambda cue: mean(np.take(cue, at)), disparity.cues.values())
    xyz = np.stack([mean(axis) for axis in along], -1)
    return VoxelCloud(
        xyz,
        count,
        inverse,
        size_m,
        mean(cloud.sigma_z),
        (xyz[:, 2] / rig.fx).astype(np.float32),
        dict(zip(disparity.cues, means, strict=True)),
    )


def _keys(along: F32, size_m: float) -> Int64:
    """One number a cell of points (3, N), ascending in x, then y, then z.

    Cells are counted from the cloud's corner, which moves none.
    """
    keys = np.zeros(along.shape[1], np.int64)
    bits = np.log2(max(len(keys), 1))
    for axis in along if len(keys) else ():
        cell = np.floor(axis / np.float64(size_m))
        low = cell.min()
        extent = cell.max() - low + 1
        bits += np.log2(extent)
        if not bits < MAX_BITS:
            raise CloudError(
                f"voxels of {size_m:.3g} m are too small for a cloud of {extent * size_m:.3g} m",
                key="voxel.size_m",
                remedy="Use larger voxels, or a smaller working volume",
            )
        keys *= int(extent)
        keys += (cell - low).astype(np.int64)
    return keys


def _group(keys: Int64) -> tuple[I32, I32]:
    """The rank of each key among the different ones, and how often each of these occurs.

    Key and position are packed into one number, because a plain sort is several times faster than
    an argsort.
    """
    bits = max(len(keys) - 1, 1).bit_length()
    packed = np.sort((keys << bits) | np.arange(len(keys), dtype=np.int64))
    order, keys = packed & ((1 << bits) - 1), packed >> bits
    first = np.ones(len(keys), bool)
    first[1:] = keys[1:] != keys[:-1]
    inverse = np.empty(len(keys), np.int32)
    inverse[order] = np.cumsum(first, dtype=np.int32) - 1
    return inverse, np.diff(np.append(np.flatnonzero(first), len(keys))).astype(np.int32)
