"""What the network of lumps sees: ten images, at one scale for all cameras and screens."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from stereo_ore.threads import pool
from stereo_ore.types import (
    F32,
    F64,
    U8,
    Disparity,
    Grizzly,
    Mask,
    Plane,
    Region,
    Rig,
    Surface,
    on_rays,
)

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
STRIDE = 16
"""Sides of the network's input are multiples of this."""
_LEAST_SCALE = 0.15
"""The images are never smaller than this share of the camera's."""
_WINDOW, _CLOSE = int(1.5 * UNIT) | 1, 7
"""Sides of the windows of means [pixels]: near by, one and a half openings, and close by."""
LOWEST, HIGHEST, STEEPEST = -1.5, 2.5, 1.5
"""Bounds of the height and of the relief [openings]."""
BEYOND = 4.0
"""Farther than this from the screen [openings] a disparity is a wrong match."""


@dataclass(frozen=True)
class Channels:
    """The network's images x (10, h, w) float32 of an image rectangle, `scale` of its pixels.

    They are the upper left part of `padded`, which is zero elsewhere and has sides that the network
    takes.
    """

    x: F32
    padded: F32
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
    scale = _scale(disparity, surface, screen, opening_m)
    sides = region.x1 - region.x0, region.y1 - region.y0
    width, height = (max(8, round(side * scale)) for side in sides)
    inner = _crop(disparity.region, region)
    d = disparity.values[region.slices]
    near = d > np.float32(0.5 - surface.rig.doffs_px)
    parts: dict[int, Callable[[], tuple[F32, ...]]] = {
        0: lambda: _shape(d, near, surface.rig, screen.plane, opening_m, region, (width, height)),
        5: lambda: _doubts(disparity.cues, near, surface, inner, (width, height)),
        8: lambda: _shades(surface.bgr[inner], (width, height)),
    }
    padded = np.zeros(
        (len(CHANNELS), height + -height % STRIDE, width + -width % STRIDE), np.float32
    )

    def fill(first: int) -> None:
        for number, image in enumerate(parts[first](), first):
            padded[number, :height, :width] = image

    list(pool().map(fill, parts))
    return Channels(padded[:, :height, :width], padded, region, scale)


def _shape(
    d: F32,
    near: Mask,
    rig: Rig,
    plane: Plane,
    opening_m: float,
    region: Region,
    size: tuple[int, int],
) -> tuple[F32, ...]:
    """Height, normal, relief, and where there is a disparity."""
    share = _shrunk(near.astype(np.float32), size)
    mean = _shrunk(np.where(near, d, np.float32(0)), size) / np.maximum(share, np.float32(1e-3))
    with np.errstate(divide="ignore", invalid="ignore"):
        z = np.float32(rig.fx * rig.baseline_m) / (mean + np.float32(rig.doffs_px))
    u = (_middles(region.x0, region.x1, size[0]) - rig.cx) / rig.fx
    v = (_middles(region.y0, region.y1, size[1]) - rig.cy) / rig.fy
    axes = np.stack([*_in_plane(plane.normal), plane.normal]) / opening_m
    place = [(on_rays(axis, u, v) * z).astype(np.float32) for axis in axes]
    place[2] -= np.float32(plane.offset / opening_m)
    valid = (share > np.float32(0.3)) & (np.abs(place[2]) < BEYOND)
    weight = valid.astype(np.float32)
    height: F32 = np.where(valid, np.clip(place[2], LOWEST, HIGHEST), np.float32(0))
    around = _box(height, _WINDOW) / np.maximum(_box(weight, _WINDOW), np.float32(1e-3))
    relief = np.asarray(np.clip(height - around, -STEEPEST, STEEPEST) * weight, np.float32)
    return height, *_normal(place, weight), relief, weight


def _middles(start: int, stop: int, count: int) -> F64:
    """Middles (count,) of as many equal parts of the pixels from `start` to `stop` [px]."""
    return np.asarray((np.arange(count) + 0.5) * ((stop - start) / count) + (start + 0.5) - 1)


def _doubts(
    cues: Mapping[str, F32],
    near: Mask,
    surface: Surface,
    inner: tuple[slice, slice],
    size: tuple[int, int],
) -> tuple[F32, ...]:
    """What the matcher doubts, and what the filter kept; a matcher without doubts is sure."""
    share = cues["valid_share"][inner] if "valid_share" in cues else near.astype(np.float32)
    differ = cues["lr_diff_px"][inner] if "lr_diff_px" in cues else np.zeros(near.shape, np.float32)
    kept = np.isfinite(surface.xyz[..., 2][inner]).astype(np.float32)
    share, differ = (_shrunk(np.minimum(cue, np.float32(4)), size) for cue in (share, differ))
    differ = np.asarray(np.minimum(differ, np.float32(2)) / np.float32(2), np.float32)
    return share, differ, _shrunk(kept, size)


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


def _shrunk(image: F32, size: tuple[int, int]) -> F32:
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float32)


def _box(image: F32, side: int) -> F32:
    return np.asarray(cv2.blur(image, (side, side), borderType=cv2.BORDER_REFLECT), np.float32)


def _crop(outer: Region, inner: Region) -> tuple[slice, slice]:
    return (
        slice(inner.y0 - outer.y0, inner.y1 - outer.y0),
        slice(inner.x0 - outer.x0, inner.x1 - outer.x0),
    )


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


def _shades(bgr: U8, size: tuple[int, int]) -> tuple[F32, F32]:
    """Grey level less its mean over its spread near by, and logarithm of the spread close by."""
    grey = _shrunk(np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY), np.uint8), size)
    square = grey * grey

    def spread(side: int) -> F32:
        variance = np.maximum(_box(square, side) - _box(grey, side) ** 2, np.float32(0))
        return np.asarray(np.sqrt(variance), np.float32)

    even = np.clip((grey - _box(grey, _WINDOW)) / (spread(_WINDOW) + np.float32(3)), -3, 3)
    texture = (np.log(spread(_CLOSE) + np.float32(0.5)) - np.float32(1.5)) / np.float32(1.5)
    return np.asarray(even / np.float32(2), np.float32), np.asarray(texture, np.float32)
