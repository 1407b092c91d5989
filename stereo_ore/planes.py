"""Planes fitted around every pixel of a depth image, shared by the stages that need a smooth surface."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from stereo_ore.types import F64, Rig


@dataclass(frozen=True)
class PlaneField:
    """The plane around each pixel of an (h, w) crop.

    depth (h, w) [m] at the pixel, unit normal (h, w, 3) towards the camera, rms (h, w) [m] of the residual along z,
    share (h, w) of the window's weight.
    """

    depth: F64
    normal: F64
    rms: F64
    share: F64


def fit_planes(depth_m: F64, weight: F64, side: int, rig: Rig) -> PlaneField:
    """Fit a plane to the weighted pixels of the window around each pixel.

    On a plane inverse depth is linear in the pixel, 1/z = a·(u − cx) + b·(v − cy) + c, and its noise is that of
    disparity, the same everywhere; so the least squares fit of (a, b, c) over a window needs only box filters. The
    plane's normal is −(a·fx, b·fy, c), normalised.

    Parameters
    ----------
    depth_m : (h, w) array
        Depth; used where `weight` is not zero.
    weight : (h, w) array
        How much a pixel counts, 0…1.
    side : int
        Side of the window, odd [px].
    rig : Rig
        Geometry of the crop: see `crop_rig`.
    """
    h, w = weight.shape
    q = np.where(weight > 0, 1.0 / np.where(weight > 0, depth_m, 1.0), 0.0)
    u, v = np.meshgrid(np.arange(w) - rig.cx, np.arange(h) - rig.cy)
    wu, wv, wq = weight * u, weight * v, weight * q
    sums = np.stack([weight, wu, wv, wq, wu * u, wu * v, wv * v, wu * q, wv * q, wq * q], -1)
    means = np.asarray(
        cv2.boxFilter(sums, -1, (side, side), normalize=True, borderType=cv2.BORDER_CONSTANT), np.float64
    )
    share = means[..., 0]
    means = np.moveaxis(means[..., 1:] / np.maximum(share, 1e-9)[..., None], -1, 0)
    mu, mv, mq = means[:3]
    uu, uv, vv = means[3] - mu * mu, means[4] - mu * mv, means[5] - mv * mv
    uq, vq, qq = means[6] - mu * mq, means[7] - mv * mq, means[8] - mq * mq
    determinant = np.maximum(uu * vv - uv**2, 1e-6)
    a, b = (uq * vv - vq * uv) / determinant, (vq * uu - uq * uv) / determinant
    here = np.maximum(mq + a * (u - mu) + b * (v - mv), 1e-6)
    normal = -np.stack([a * rig.fx, b * rig.fy, here - a * u - b * v], -1)
    normal /= np.sqrt((normal**2).sum(-1, keepdims=True))
    return PlaneField(1.0 / here, normal, np.sqrt(np.maximum(qq - a * uq - b * vq, 0.0)) / here**2, share)


def crop_rig(rig: Rig, u0: int, v0: int, stride: int = 1) -> Rig:
    """Geometry of the image whose pixel (i, j) is pixel (u0 + i·stride, v0 + j·stride) of the rig's."""
    return replace(rig, fx=rig.fx / stride, fy=rig.fy / stride, cx=(rig.cx - u0) / stride, cy=(rig.cy - v0) / stride)
