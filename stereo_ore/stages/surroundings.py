"""What lies around a voxel in the image, beyond the windows of the matcher's cues: doubts, depth
and light.

A wrong match is often smooth inside, and shows only against what is around: the shadow beside an
edge, a patch where most pixels found nothing, an eye that saw less light.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt

from stereo_ore.threads import pool
from stereo_ore.types import (
    AROUND_CUES,
    CONTEXT_REACH_PX,
    CONTEXT_WINDOWS_PX,
    CUES,
    F32,
    KNOWN_CUES,
    Disparity,
    RectifiedPair,
    VoxelCloud,
)

_STEP = 4
"""Windows are many times this wide: sums over a copy reduced by it tell as much as over all
pixels."""

FLOOR_PX, _FLOOR = np.float32(0.05), np.float32(0.01)
"""Added before a cue's logarithm, and to either chance before log odds."""

_FAR_PX = np.float32(1e4)
_UNKNOWN = np.float32(1e-3)


def look_around(voxels: VoxelCloud, disparity: Disparity, pair: RectifiedPair) -> VoxelCloud:
    """Add the cues of `types.CONTEXT` to a cloud whose matcher gave all of `types.CUES`.

    Parameters
    ----------
    voxels : VoxelCloud
        In the frame of the left image.
    disparity : Disparity
        From which they were made.
    pair : RectifiedPair
        Likewise.

    Returns
    -------
    VoxelCloud
        The same, with (M,) cues more; as it was where cues are missing or the cloud is empty.
    """
    if not len(voxels) or not set(CUES) <= set(disparity.cues):
        return voxels
    small = _cells(voxels, disparity, pair)
    values = disparity.values[disparity.region.slices]
    seen = np.isfinite(values)
    d = np.where(seen, values, np.float32(0))
    # What the voxel's depth says is its disparity also where its middle pixel has none.
    own = pair.rig.disparity(voxels.xyz[:, 2]).astype(np.float32)
    known = _reduce(seen.astype(np.float32))
    parts = (
        lambda: _doubts(disparity, small),
        lambda: _doubts_of_known(disparity, seen, known, small),
        lambda: _depth(d, seen, known, own, small),
        lambda: _steps(d, seen, own, small),
        lambda: _light(pair, disparity, small),
    )
    found = pool().map(lambda part: dict(part()), parts)
    return replace(
        voxels, cues={**voxels.cues, **{name: cue for part in found for name, cue in part.items()}}
    )


Found = Iterator[tuple[str, F32]]
_Index = npt.NDArray[np.intp]


def _cells(voxels: VoxelCloud, disparity: Disparity, pair: RectifiedPair) -> _Index:
    """Places of the voxels, within the matched region, in the reduced copy laid out flat."""
    region = disparity.region
    height, width = region.y1 - region.y0, region.x1 - region.x0
    u, v = np.rint(pair.rig.project(voxels.xyz)).astype(np.intp).T
    row, column = (
        np.clip(v - region.y0, 0, height - 1) // _STEP,
        np.clip(u - region.x0, 0, width - 1) // _STEP,
    )
    return np.asarray(row * -(-width // _STEP) + column)


def _doubts(disparity: Disparity, at: _Index) -> Found:
    """Means of cues over all pixels of the windows, known or not."""
    for name in AROUND_CUES:
        image = _reduce(_plain(disparity.cues[name]))
        yield from (
            (f"{name}_around_{size}", _mean(image, size).take(at)) for size in CONTEXT_WINDOWS_PX
        )


def _doubts_of_known(disparity: Disparity, seen: F32, known: F32, at: _Index) -> Found:
    """Means of logarithms of cues over the pixels with a disparity, and their share."""
    share = {size: _mean(known, size) for size in CONTEXT_WINDOWS_PX}
    for name in KNOWN_CUES:
        image = _reduce(np.where(seen, _told(name, _plain(disparity.cues[name])), np.float32(0)))
        yield from (
            (
                f"{name}_known_{size}",
                _mean(image, size).take(at) / (share[size].take(at) + _UNKNOWN),
            )
            for size in CONTEXT_WINDOWS_PX
        )
    yield from ((f"known_{size}", share[size].take(at)) for size in CONTEXT_WINDOWS_PX)


def _depth(d: F32, seen: F32, known: F32, own: F32, at: _Index) -> Found:
    """The voxel's disparity against mean and deviation of those around."""
    middle = np.float32(np.median(own))
    first, second = (
        _reduce(np.where(seen, d - middle, 0)),
        _reduce(np.where(seen, (d - middle) ** 2, 0)),
    )
    for size in CONTEXT_WINDOWS_PX:
        total = _mean(known, size).take(at) + _UNKNOWN
        mean = _mean(first, size).take(at) / total
        deviation = np.sqrt(np.maximum(_mean(second, size).take(at) / total - mean * mean, 0))
        off = own - middle - mean
        yield f"off_{size}", np.copysign(np.log1p(np.abs(off)), off)
        yield f"deviation_{size}", np.log(deviation + FLOOR_PX)
        yield f"off_in_deviations_{size}", off / (deviation + np.float32(0.3))


def _steps(d: F32, seen: F32, own: F32, at: _Index) -> Found:
    """How much nearer and farther things lie around: beside an edge is the shadow that only one eye
    sees.
    """
    nearest, farthest = (
        _extreme(np.where(seen, d, -_FAR_PX), np.maximum),
        _extreme(np.where(seen, d, _FAR_PX), np.minimum),
    )
    for size in CONTEXT_REACH_PX:
        box = np.ones((size // _STEP | 1, size // _STEP | 1), np.uint8)
        yield f"nearer_{size}", np.log1p(np.clip(cv2.dilate(nearest, box).take(at) - own, 0, 200))
        yield f"farther_{size}", np.log1p(np.clip(own - cv2.erode(farthest, box).take(at), 0, 200))


def _light(pair: RectifiedPair, disparity: Disparity, at: _Index) -> Found:
    """Gradients along and across rows, and brightness."""
    grey = np.asarray(cv2.cvtColor(pair.left[disparity.region.slices], cv2.COLOR_BGR2GRAY))
    for axis, dx in (("u", 1), ("v", 0)):
        steep = _reduce(np.abs(cv2.Scharr(grey, cv2.CV_32F, dx, 1 - dx) * np.float32(1 / 32)))
        yield from (
            (f"gradient_{axis}_{size}", np.log(_mean(steep, size).take(at) + np.float32(0.3)))
            for size in (7, *CONTEXT_WINDOWS_PX[:2])
        )
    yield "brightness", np.log(_mean(_reduce(grey.astype(np.float32)), 9).take(at) + np.float32(3))


def _plain(cue: F32) -> F32:
    return np.where(np.isfinite(cue), cue, np.float32(0))


def _told(name: str, cue: F32) -> F32:
    """A share as it is, log odds of a confidence, logarithms of all else."""
    if name.startswith("support"):
        return cue
    if name == "confidence":
        share = np.minimum(cue, 1)
        return np.log((share + _FLOOR) / (1 + _FLOOR - share))
    return np.asarray(np.log(np.maximum(cue, 0) + FLOOR_PX), np.float32)


def _reduce(image: F32) -> F32:
    """Means over squares of `_STEP` pixels; those at the right and the lower rim repeat their last
    pixels.
    """
    return np.asarray(
        cv2.resize(_padded(image), None, fx=1 / _STEP, fy=1 / _STEP, interpolation=cv2.INTER_AREA)
    )


def _extreme(image: F32, of: np.ufunc) -> F32:
    """Least or greatest values of squares of `_STEP` pixels."""
    height, width = (image := _padded(image)).shape
    rows = of.reduce(image.reshape(height // _STEP, _STEP, width), axis=1)
    return np.asarray(of.reduce([rows[:, column::_STEP] for column in range(_STEP)], axis=0))


def _padded(image: F32) -> F32:
    height, width = image.shape
    if height % _STEP == width % _STEP == 0:
        return image
    return np.asarray(
        cv2.copyMakeBorder(image, 0, -height % _STEP, 0, -width % _STEP, cv2.BORDER_REPLICATE)
    )


def _mean(image: F32, size: int) -> F32:
    """Mean over a window of `size` pixels of the full image."""
    side = max(round(size / _STEP), 1) | 1
    return np.asarray(cv2.blur(image, (side, side), borderType=cv2.BORDER_REPLICATE), np.float32)
