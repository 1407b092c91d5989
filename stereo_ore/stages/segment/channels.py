"""What the network of lumps sees: ten images, at one scale for all cameras and screens."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from stereo_ore.types import F32, F64, U8, Disparity, Grizzly, Mask, Region, Surface

CHANNELS = (
    "height", "normal_x", "normal_y", "relief", "valid", "valid_share", "lr_diff", "kept",
    "grey", "texture",
)  # fmt: skip
"""Height over the bars [openings]; two components of the surface's normal in the screen's frame;
height less its mean near by; whether there is a disparity, and of how many around; difference of
both directions of matching [2 px]; what the filter kept; grey level less its mean, over its spread
near by; logarithm of the spread close by."""

UNIT = 32
"""Pixels that the opening spans in the network's images."""
_LEAST_SCALE = 0.15
"""The images are never smaller than this share of the camera's."""
_NEAR, _CLOSE = 1.5, 7
"""Side of the windows of means: `_NEAR` openings, and `_CLOSE` pixels for the texture."""
LOWEST, HIGHEST, STEEPEST = -1.5, 2.5, 1.5
"""Bounds of the height and of the relief [openings]."""
BEYOND = 4.0
"""Farther than this from the screen [openings] a disparity is a wrong match."""


@dataclass(frozen=True)
class Channels:
    """The network's input x (10, h, w) float32 of an image rectangle, `scale` of its pixels."""

    x: F32
    region: Region
    scale: float


def measure_channels(
    disparity: Disparity, surface: Surface, screen: Grizzly, opening_m: float, region: Region
) -> Channels:
    """The channels of a rectangle of the image that lies within the matched one.

    Parameters
    ----------
    disparity : Disparity
        As it comes from the matcher, noise included: the network has its own opinion of it.
    surface : Surface
        What the filter kept of it, and the image.
    screen : Grizzly
        Its plane is height 0.
    opening_m : float
        Unit of lengths [m].
    region : Region
        The rectangle; of it x0…y1 are used.
    """
    rig, plane = surface.rig, screen.plane
    x, y = (np.arange(region.x0, region.x1) + 0.5, np.arange(region.y0, region.y1) + 0.5)
    scale = _scale(disparity, surface, screen, opening_m)
    size = max(8, round(len(x) * scale)), max(8, round(len(y) * scale))
    u, v = (
        ((np.arange(n) + 0.5) * (len(a) / n) + a[0] - 1 - c) / f
        for n, a, c, f in zip(size, (x, y), (rig.cx, rig.cy), (rig.fx, rig.fy), strict=True)
    )
    d = disparity.values[region.slices]
    near = d > np.float32(0.5 - rig.doffs_px)
    share = _shrunk(near.astype(np.float32), size)
    mean = _shrunk(np.where(near, d, np.float32(0)), size) / np.maximum(share, np.float32(1e-3))
    with np.errstate(divide="ignore", invalid="ignore"):
        z = np.float32(rig.fx * rig.baseline_m) / (mean + np.float32(rig.doffs_px))
    axes = np.stack([*_in_plane(plane.normal), plane.normal]) / opening_m
    place = [(_on_rays(axis, u, v) * z).astype(np.float32) for axis in axes]
    place[2] -= np.float32(plane.offset / opening_m)
    valid = (share > np.float32(0.3)) & (np.abs(place[2]) < BEYOND)
    weight = valid.astype(np.float32)
    height = np.where(valid, np.clip(place[2], LOWEST, HIGHEST), np.float32(0))
    window = int(_NEAR * UNIT) | 1
    around = _box(height, window) / np.maximum(_box(weight, window), np.float32(1e-3))
    relief = np.clip(height - around, -STEEPEST, STEEPEST) * weight
    cropped = _crop(disparity.region, region)
    kept = np.isfinite(surface.xyz[..., 2][cropped]).astype(np.float32)
    doubts = [
        _shrunk(_cue(disparity, name, cropped, missing), size)
        for name, missing in (("valid_share", near.astype(np.float32)), ("lr_diff_px", None))
    ]
    return Channels(
        np.stack([
            height, *_normal(place, weight), relief, weight, doubts[0],
            np.minimum(doubts[1], np.float32(2)) / np.float32(2), _shrunk(kept, size),
            *_shades(surface.bgr[cropped], size, window),
        ]).astype(np.float32),
        region,
        scale,
    )  # fmt: skip


def _scale(disparity: Disparity, surface: Surface, screen: Grizzly, opening_m: float) -> float:
    """Pixels of the channels over pixels of the camera: the opening spans `UNIT` in the middle."""
    return float(np.clip(UNIT * pixel_m(disparity, surface, screen) / opening_m, _LEAST_SCALE, 1.0))


def pixel_m(disparity: Disparity, surface: Surface, screen: Grizzly) -> float:
    """Size [m] of a pixel on the screen, in the middle of the matched rectangle."""
    rig, plane, r = surface.rig, screen.plane, disparity.region
    middle = np.array(
        [((r.x0 + r.x1) / 2 - rig.cx) / rig.fx, ((r.y0 + r.y1) / 2 - rig.cy) / rig.fy, 1]
    )
    return max(plane.offset / min(float(plane.normal @ middle), -1e-3), 1e-3) / rig.fx


def _in_plane(normal: F64) -> tuple[F64, F64]:
    """The image's x laid into the plane, and the axis across it that points down the image."""
    across = np.array([1.0, 0, 0]) - normal[0] * normal
    across /= max(float(np.linalg.norm(across)), 1e-9)
    down = np.cross(normal, across)
    return across, down * (1.0 if down[1] >= 0 else -1.0)


def _on_rays(vector: F64, u: F64, v: F64) -> F32:
    across, down = (
        (vector[0] * u).astype(np.float32),
        (vector[1] * v + vector[2]).astype(np.float32),
    )
    return np.asarray(across[None, :] + down[:, None])


def _shrunk(image: F32, size: tuple[int, int]) -> F32:
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float32)


def _box(image: F32, side: int) -> F32:
    return np.asarray(cv2.blur(image, (side, side), borderType=cv2.BORDER_REFLECT), np.float32)


def _crop(outer: Region, inner: Region) -> tuple[slice, slice]:
    return (
        slice(inner.y0 - outer.y0, inner.y1 - outer.y0),
        slice(inner.x0 - outer.x0, inner.x1 - outer.x0),
    )


def _cue(disparity: Disparity, name: str, at: tuple[slice, slice], missing: F32 | None) -> F32:
    """A doubt of the matcher; a matcher that has none is taken for sure."""
    if name in disparity.cues:
        return np.minimum(disparity.cues[name][at], np.float32(4))
    shape = at[0].stop - at[0].start, at[1].stop - at[1].start
    return np.zeros(shape, np.float32) if missing is None else missing


def _normal(place: list[F32], weight: F32) -> tuple[F32, F32]:
    """Components in the screen's plane of the normal of points smoothed by a pixel."""

    def smooth(image: F32) -> F32:
        return np.asarray(cv2.GaussianBlur(image, (5, 5), 1.0), np.float32)

    share = np.maximum(smooth(weight), np.float32(1e-3))
    a, b, c = (smooth(np.where(weight > 0, p, np.float32(0))) / share for p in place)
    step = np.array([[-1, 0, 0, 0, 1]], np.float32)
    (ax, ay), (bx, by), (cx, cy) = (
        (cv2.filter2D(p, -1, step), cv2.filter2D(p, -1, step.T)) for p in (a, b, c)
    )
    n = np.stack([bx * cy - cx * by, cx * ay - ax * cy, ax * by - bx * ay])
    n /= np.maximum(np.sqrt((n * n).sum(0)), np.float32(1e-9))
    n *= np.where(n[2] < 0, np.float32(-1), np.float32(1))
    inner: Mask = cv2.erode(weight, np.ones((5, 5), np.uint8)) > 0
    return n[0] * inner, n[1] * inner


def _shades(bgr: U8, size: tuple[int, int], window: int) -> tuple[F32, F32]:
    """Grey level less its mean over its spread near by, and logarithm of the spread close by."""
    grey = _shrunk(np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY), np.uint8), size)
    square = grey * grey

    def spread(side: int) -> F32:
        variance = np.maximum(_box(square, side) - _box(grey, side) ** 2, np.float32(0))
        return np.asarray(np.sqrt(variance), np.float32)

    even = np.clip((grey - _box(grey, window)) / (spread(window) + np.float32(3)), -3, 3)
    texture = (np.log(spread(_CLOSE) + np.float32(0.5)) - np.float32(1.5)) / np.float32(1.5)
    return np.asarray(even / np.float32(2), np.float32), np.asarray(texture, np.float32)
