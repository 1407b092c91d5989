"""Planes fitted around every pixel of a depth image, shared by the stages that need a smooth
surface.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from stereo_ore.types import F32, F64, Mask, Rig


@dataclass(frozen=True)
class PlaneField:
    """The plane around each pixel of an (h, w) crop.

    `inverse` (h, w) [1/m] is the inverse depth at the pixel, `slope_u` and `slope_v` (h, w) its
    slopes [1/(m px)], `rms` (h, w) [m] the residual along z, `share` (h, w) that of the window's
    weight.
    """

    inverse: F32
    slope_u: F32
    slope_v: F32
    rms: F32
    share: F32
    rig: Rig

    def depth(self, where: Mask) -> F64:
        """Depth (N,) [m] at the pixels of a mask."""
        return 1.0 / self.inverse[where].astype(np.float64)

    def normal(self, where: Mask) -> F64:
        """Unit normals (N, 3) towards the camera at the pixels of a mask."""
        v, u = np.nonzero(where)
        a, b, here = (
            image[where].astype(np.float64) for image in (self.slope_u, self.slope_v, self.inverse)
        )
        c = here - a * (u - self.rig.cx) - b * (v - self.rig.cy)
        normal = -np.stack([a * self.rig.fx, b * self.rig.fy, c], -1)
        return np.asarray(normal / np.sqrt((normal**2).sum(-1, keepdims=True)))


def fit_planes(depth_m: F32, weight: F32, side: int, rig: Rig) -> PlaneField:
    """Fit a plane to the weighted pixels of the window around each pixel.

    On a plane inverse depth is linear in the pixel, 1/z = a·(u − cx) + b·(v − cy) + c, and its
    noise is that of disparity, the same everywhere; so the least squares fit of (a, b, c) over a
    window needs only box filters. The plane's normal is −(a·fx, b·fy, c), normalised.

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
    inverse = np.divide(1.0, depth_m, out=np.zeros(weight.shape, np.float32), where=weight > 0)
    middle = np.float32((weight * inverse).sum() / max(float(weight.sum()), 1e-9))
    u, v = (
        np.arange(w, dtype=np.float32)[None, :] - w // 2,
        np.arange(h, dtype=np.float32)[:, None] - h // 2,
    )
    q = inverse - middle
    wu, wv, wq = weight * u, weight * v, weight * q
    share = _mean(weight, side)
    over = 1 / np.maximum(share, np.float32(1e-6))
    mu, mv, mq = (_mean(x, side) * over for x in (wu, wv, wq))
    uu, uv, vv, uq, vq, qq = (
        _mean(x * y, side) * over - mx * my
        for x, y, mx, my in (
            (wu, u, mu, mu), (wu, v, mu, mv), (wv, v, mv, mv), (wu, q, mu, mq), (wv, q, mv, mq),
            (wq, q, mq, mq)
        )
    )  # fmt: skip
    determinant = np.maximum(uu * vv - uv * uv, np.float32(1e-4))
    a, b = (uq * vv - vq * uv) / determinant, (vq * uu - uq * uv) / determinant
    here = np.maximum(middle + mq + a * (u - mu) + b * (v - mv), np.float32(1e-6))
    rms = np.sqrt(np.maximum(qq - a * uq - b * vq, 0)) / here**2
    inverse, slope_u, slope_v, residual = (
        np.asarray(image, np.float32) for image in (here, a, b, rms)
    )
    return PlaneField(inverse, slope_u, slope_v, residual, share, rig)


def _mean(image: F32, side: int) -> F32:
    return np.asarray(
        cv2.boxFilter(image, -1, (side, side), borderType=cv2.BORDER_CONSTANT), np.float32
    )


def crop_rig(rig: Rig, u0: int, v0: int, stride: int = 1) -> Rig:
    """Geometry of the image whose pixel (i, j) is pixel (u0 + i·stride, v0 + j·stride) of the
    rig's.
    """
    return replace(
        rig,
        fx=rig.fx / stride,
        fy=rig.fy / stride,
        cx=(rig.cx - u0) / stride,
        cy=(rig.cy - v0) / stride,
    )
