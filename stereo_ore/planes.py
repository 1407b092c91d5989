"""Planes fitted around every pixel of a depth image, shared by the stages that need a smooth surface."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from stereo_ore.types import F32, F64, Rig


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
    inverse = np.where(weight > 0, 1.0 / np.where(weight > 0, depth_m, 1.0), 0.0)
    middle = float((weight * inverse).sum() / max(float(weight.sum()), 1e-9))
    q, counts = (inverse - middle).astype(np.float32), weight.astype(np.float32)
    u, v = np.meshgrid(np.arange(w, dtype=np.float32) - w // 2, np.arange(h, dtype=np.float32) - h // 2)
    wu, wv, wq = counts * u, counts * v, counts * q
    share = _mean(counts, side)
    over = 1.0 / np.maximum(share, 1e-6)
    mu, mv, mq = (_mean(x, side) * over for x in (wu, wv, wq))
    uu, uv, vv, uq, vq, qq = (
        _mean(x * y, side) * over - mx * my
        for x, y, mx, my in (
            (wu, u, mu, mu), (wu, v, mu, mv), (wv, v, mv, mv), (wu, q, mu, mq), (wv, q, mv, mq), (wq, q, mq, mq)
        )
    )  # fmt: skip
    determinant = np.maximum(uu * vv - uv * uv, 1e-4)
    a, b = (uq * vv - vq * uv) / determinant, (vq * uu - uq * uv) / determinant
    here = np.maximum(middle + mq + a * (u - mu) + b * (v - mv), 1e-6)
    c = here - a * (u + (w // 2 - rig.cx)) - b * (v + (h // 2 - rig.cy))
    normal = -np.stack([a * rig.fx, b * rig.fy, c], -1).astype(np.float64)
    normal /= np.sqrt((normal**2).sum(-1, keepdims=True))
    rms = np.sqrt(np.maximum(qq - a * uq - b * vq, 0.0)) / here**2
    return PlaneField(1.0 / here.astype(np.float64), normal, rms.astype(np.float64), share.astype(np.float64))


def _mean(image: F32, side: int) -> F32:
    return np.asarray(cv2.boxFilter(image, -1, (side, side), borderType=cv2.BORDER_CONSTANT), np.float32)


def crop_rig(rig: Rig, u0: int, v0: int, stride: int = 1) -> Rig:
    """Geometry of the image whose pixel (i, j) is pixel (u0 + i·stride, v0 + j·stride) of the rig's."""
    return replace(rig, fx=rig.fx / stride, fy=rig.fy / stride, cx=(rig.cx - u0) / stride, cy=(rig.cy - v0) / stride)
