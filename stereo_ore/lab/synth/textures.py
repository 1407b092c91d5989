"""Tileable multi-scale textures and their lookup on a surface from three sides."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from stereo_ore.types import F32

_SIDE = 1024


@dataclass(frozen=True)
class Texture:
    """A periodic map: image (SIDE, SIDE, 4) float32 of tone, vein strength, and relief slope along
    u and v.

    Tone has mean 0 and variance 1; `texel_m` is the size of a texel.
    """

    image: F32
    texel_m: float


def make_texture(
    rng: np.random.Generator,
    texel_m: float,
    slope: float = 1.0,
    stretch: float = 1.0,
    bump: float = 0.5,
) -> Texture:
    """A texture with amplitude falling as 1 / frequency^slope, `stretch` times longer along v;
    relief follows tone.
    """
    tone = spectral_noise(rng, slope, stretch)
    fine = spectral_noise(rng, 0.6, stretch)
    vein = np.maximum(0, 1 - np.abs(spectral_noise(rng, 1.9, stretch)) * 14)
    patches = np.tanh(1.5 * spectral_noise(rng, 1.6, stretch))
    relief = spectral_noise(rng, 1.25, stretch)
    slopes = [np.roll(relief, -1, k) - np.roll(relief, 1, k) for k in (1, 0)]
    scale = bump / max(float(np.std(slopes)), 1e-6)
    mixed = 0.5 * tone + 0.5 * patches + 0.42 * fine
    layers = [mixed / mixed.std(), vein, slopes[0] * scale, slopes[1] * scale]
    return Texture(np.stack(layers, -1).astype(np.float32), texel_m)


def spectral_noise(rng: np.random.Generator, slope: float, stretch: float = 1.0) -> F32:
    """Periodic Gaussian noise (SIDE, SIDE) of variance 1 whose amplitude falls as 1 /
    frequency^slope.
    """
    from scipy import fft

    fy, fx = np.fft.fftfreq(_SIDE)[:, None] * stretch, np.fft.rfftfreq(_SIDE)[None]
    frequency = np.hypot(fx, fy).astype(np.float32)
    frequency[0, 0] = 1
    spectrum = fft.rfft2(
        rng.standard_normal((_SIDE, _SIDE), dtype=np.float32)
    ) * frequency ** np.float32(-slope)
    spectrum[0, 0] = 0
    noise = fft.irfft2(spectrum, s=(_SIDE, _SIDE))
    return np.asarray(noise / noise.std(), np.float32)


def dot(a: F32, b: F32) -> F32:
    """Scalar products of the rows of (N, 3) arrays, as a column (N, 1)."""
    return np.asarray(np.einsum("ij,ij->i", a, b)[:, None])


def sample(texture: Texture, xyz: F32, normals: F32) -> tuple[F32, F32, F32]:
    """Tone (N,), vein strength (N,) and relief slope (N, 3) at surface points, blended from three
    projections.

    The weight of the projection along an axis is the fourth power of the normal's component along
    it.
    """
    weight = normals**2
    weight = weight * weight
    weight /= np.maximum(weight @ np.ones((3, 1), np.float32), np.float32(1e-9))
    total, slope = np.zeros((len(xyz), 2), np.float32), np.zeros_like(xyz)
    for axis in range(3):
        u, v = [(1, 2), (0, 2), (0, 1)][axis]
        value = lookup(texture, xyz[:, u], xyz[:, v] + 0.37 * axis)
        value *= weight[:, axis : axis + 1]
        total += value[:, :2]
        slope[:, u] += value[:, 2]
        slope[:, v] += value[:, 3]
    return total[:, 0], total[:, 1], slope


def lookup(texture: Texture, u: F32, v: F32) -> F32:
    """The four layers (N, 4) at texture coordinates in metres, bilinear, periodic."""
    width = 1024
    rows = -(-len(u) // width)
    maps = np.zeros((2, rows * width), np.float32)
    maps[0, : len(u)], maps[1, : len(u)] = u, v
    maps = np.mod(maps / np.float32(texture.texel_m), _SIDE).reshape(2, rows, width)
    found = cv2.remap(texture.image, maps[0], maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return np.asarray(found.reshape(-1, 4)[: len(u)], np.float32)
