"""The points of a surface that a plane is looked for in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from stereo_ore.config import GrizzlyConfig
from stereo_ore.types import F32, F64, Surface

Noise = TypeVar("Noise", F32, F64)

_SAMPLE = 8_000
"""Points looked at: enough to place a plane to a tenth of the depth noise."""


@dataclass(frozen=True)
class Sample:
    """Points of a regular image grid: xyz (N, 3) [m], inlier distance (N,) [m], surface share of
    each (N,) [m²].
    """

    xyz: F64
    tolerance: F64
    area: F64

    def __len__(self) -> int:
        return len(self.xyz)


def draw_sample(surface: Surface, config: GrizzlyConfig, count: int = _SAMPLE) -> Sample:
    """Every n-th pixel in both directions, about `count`, with the distance within which it may lie
    on a plane.

    The area grows with z², so that near and far parts of an oblique screen weigh the same.
    """
    valid = np.count_nonzero(np.isfinite(surface.xyz[..., 2]))
    step = max(1, int(np.sqrt(valid / count)))
    xyz = surface.xyz[::step, ::step].reshape(-1, 3).astype(np.float64)
    sigma = surface.sigma_z[::step, ::step].reshape(-1).astype(np.float64)
    keep = np.isfinite(xyz[:, 2]) & np.isfinite(sigma)
    xyz, sigma = xyz[keep], sigma[keep]
    area = (xyz[:, 2] / surface.rig.fx * step) ** 2
    return Sample(xyz, tolerances(sigma, config), area)


def tolerances(sigma: Noise, config: GrizzlyConfig) -> Noise:
    """Inlier distance [m] by depth noise [m]: `sigmas` of it, or the configured constant."""
    return np.full_like(sigma, config.distance_m) if config.distance_m else config.sigmas * sigma
