"""Clouds of real pairs with true disparities, through the chain; and the same pairs as worse light
would show them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import cv2
import numpy as np

from stereo_ore.chain import Chain
from stereo_ore.config import CloudConfig, Config, FilterConfig
from stereo_ore.errors import CloudError
from stereo_ore.lab import metrics
from stereo_ore.lab.bench.labelled import LabelledCloud
from stereo_ore.lab.bench.stereo_sets import StereoSet
from stereo_ore.types import (
    F32,
    F64,
    U8,
    CameraModel,
    RectifiedPair,
    Rig,
    Site,
    StereoCalibration,
    StereoPair,
)

_FARTHEST_M, _LEAST_PX = 2000.0, 1.0
"""No point is farther, nor has a smaller disparity where the eyes' centres agree."""

LEAST_KNOWN = 13
"""True disparities, of the 25 pixels around, that a voxel needs to be judged."""

_Rng = np.random.Generator


def real_cloud(found: StereoSet, name: str = "") -> LabelledCloud:
    """The voxels of a set as `run` makes them without a site; noise as `metrics.is_noise` says.

    Raises
    ------
    CloudError
        When the pair gives no cloud.
    """
    pair, rig = found.pair, found.pair.rig
    farthest = min(_FARTHEST_M, rig.fx * rig.baseline_m / max(rig.doffs_px, _LEAST_PX))
    config = Config(filter=FilterConfig(method="none"), cloud=CloudConfig(max_depth_m=farthest))
    chain = Chain(_calibration(rig, found.name), Site(), config)
    grid = chain(StereoPair(pair.left, pair.right, name=found.name)).voxels
    if grid is None:
        raise CloudError("gives no cloud", file=found.name)
    K = np.array([[rig.fx, 0, rig.cx], [0, rig.fy, rig.cy], [0, 0, 1]])
    true = np.nan_to_num(found.truth.astype(np.float64))
    noise = metrics.is_noise(
        grid.xyz, np.where(true > 0, true + rig.doffs_px, 0), K, rig.fx * rig.baseline_m
    )
    return LabelledCloud(
        name or found.name, found.name, grid, noise, judged=_judged(grid.xyz, true, rig)
    )


def _calibration(rig: Rig, name: str) -> StereoCalibration:
    left = CameraModel((rig.fx, rig.fy), (rig.cx, rig.cy), ())
    right = CameraModel((rig.fx, rig.fy), (rig.cx + rig.doffs_px, rig.cy), ())
    t = np.array([-rig.baseline_m, 0, 0])
    return StereoCalibration((rig.width, rig.height), left, right, np.eye(3), t, camera=name)


def _judged(xyz: F32, true: F64, rig: Rig) -> np.ndarray:
    u, v = np.rint(rig.project(xyz)).astype(int).T
    known = cv2.boxFilter(
        (true > 0).astype(np.float32), -1, (5, 5), normalize=False, borderType=cv2.BORDER_CONSTANT
    )
    inside = (u >= 0) & (u < rig.width) & (v >= 0) & (v < rig.height)
    return np.asarray(
        inside & (known[np.clip(v, 0, rig.height - 1), np.clip(u, 0, rig.width - 1)] >= LEAST_KNOWN)
    )


def altered(found: StereoSet, way: str, rng: _Rng) -> StereoSet:
    """A set whose eyes got other light, or little of it, or are out of focus: a key of `WAYS`."""
    left, right = (image.astype(np.float32) for image in (found.pair.left, found.pair.right))
    left, right = WAYS[way](rng, left, right)
    return replace(found, pair=RectifiedPair(_stored(left), _stored(right), found.pair.rig))


def _stored(image: F32) -> U8:
    """Grey levels as a camera stores them."""
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def _noisy(rng: _Rng, image: F32, amount: float) -> F32:
    """Shot noise: its variance grows with the light."""
    noise = rng.normal(size=image.shape) * amount * np.sqrt(np.maximum(image, 1) / 40)
    return np.asarray(image + noise, np.float32)


def _slope(image: F32) -> tuple[F32, F32]:
    h, w = image.shape[:2]
    y, x = np.mgrid[-1 : 1 : h * 1j, -1 : 1 : w * 1j].astype(np.float32)
    return y[..., None], x[..., None]


def _field(rng: _Rng, image: F32, amount: float) -> F32:
    """A smooth positive field of light about 1."""
    coarse = rng.normal(size=(4, 5)).astype(np.float32)
    smooth = cv2.resize(coarse, image.shape[1::-1], interpolation=cv2.INTER_CUBIC)
    return np.asarray(np.exp(amount * smooth)[..., None], np.float32)


def _darker(rng: _Rng, left: F32, right: F32) -> tuple[F32, F32]:
    return left, right * np.float32(rng.uniform(0.35, 0.7))


def _brighter(rng: _Rng, left: F32, right: F32) -> tuple[F32, F32]:
    """Clipped, and of another gamma."""
    light = np.clip(right * rng.uniform(1.3, 1.9), 0, 255) / 255
    return left, np.asarray(255 * light ** rng.uniform(0.7, 0.9), np.float32)


def _dark(rng: _Rng, left: F32, right: F32) -> tuple[F32, F32]:
    dark = np.float32(rng.uniform(0.15, 0.35))
    return _noisy(rng, left * dark, 2), _noisy(rng, right * dark, 2)


def _vignetting(rng: _Rng, left: F32, right: F32) -> tuple[F32, F32]:
    y, x = _slope(left)
    corners = 1 - np.float32(0.3) * (x * x + y * y)
    return _noisy(rng, left * corners, 3), _noisy(
        rng, np.float32(0.8) * right * corners[:, ::-1], 3
    )


def _blurred(rng: _Rng, left: F32, right: F32) -> tuple[F32, F32]:
    """Also under a slope of light."""
    soft = cv2.GaussianBlur(right, (0, 0), float(rng.uniform(0.7, 1.3)))
    return left, np.asarray(
        soft * (np.float32(0.9) + np.float32(0.4) * _slope(left)[1]), np.float32
    )


def _other_light(rng: _Rng, left: F32, right: F32) -> tuple[F32, F32]:
    return left * _field(rng, left, 0.15), right * _field(rng, right, 0.35)


WAYS: Mapping[str, Callable[[_Rng, F32, F32], tuple[F32, F32]]] = {
    "right darker": _darker,
    "right brighter": _brighter,
    "both dark": _dark,
    "vignetting": _vignetting,
    "right blurred": _blurred,
    "other light": _other_light,
}
