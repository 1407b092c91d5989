"""The published experiment's test cloud, as far as it is described, with the truth it came
without.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Literal

import numpy as np

from stereo_ore.lab.synth.mesh import Mesh, cast, merge, ray_caster
from stereo_ore.lab.synth.placing import HeightField, pile
from stereo_ore.lab.synth.rocks import PROPORTIONS, rock
from stereo_ore.lab.synth.screen import Screen, bars, frame
from stereo_ore.types import F64, Mask

_POINTS = 18_809
EXTENT_M = (0.62883, 0.90148, 0.19665)
OFFSET_MEAN_M, OFFSET_SIGMA_M, OFFSET_MAX_M = 0.016039, 0.008019, 0.04812
NOISE_SHARES = (0.099, 0.148, 0.564)
"""What P_r, Recall and Retain of the paper's three filters imply, each for its own row."""

EYE_M = (0.05, -0.12, 1.1)
Direction = Literal["isotropic", "normal", "ray"]


def paper_cloud(
    seed: int,
    direction: Direction = "isotropic",
    noise_share: float = 0.148,
    min_offset_m: float = 0.0,
) -> tuple[F64, Mask]:
    """Ore on bars as one camera sees it, some points moved off the surface.

    Parameters
    ----------
    seed : int
        Of surface and noise; the surface is the same for any direction and share.
    direction : "isotropic", "normal" or "ray"
        Where noisy points go: anywhere, along the surface normal or along the view ray (both ways).
    noise_share : float
        Share of noisy points, 0…1.
    min_offset_m : float
        Offsets below it are drawn again: separable noise [m].

    Returns
    -------
    xyz : (18809, 3) float64
        Points [m]; z up, the clean surface spans `EXTENT_M`. In random order.
    is_noise : (18809,) bool
        True where the point was moved by N(16.039, 8.019) mm cut to (0, 48.12] mm.
    """
    if direction not in ("isotropic", "normal", "ray"):
        raise ValueError(f"direction must be isotropic, normal or ray, not {direction!r}")
    if not 0 <= noise_share <= 1:
        raise ValueError(f"noise_share must lie in 0…1, not {noise_share}")
    surface, normals, rays = _surface(seed)
    rng = np.random.default_rng([seed, 1])
    is_noise = np.zeros(_POINTS, bool)
    is_noise[rng.permutation(_POINTS)[: round(noise_share * _POINTS)]] = True
    isotropic = rng.normal(size=(_POINTS, 3))
    axis = {"isotropic": isotropic, "normal": normals, "ray": rays}[direction]
    axis = (
        axis / np.linalg.norm(axis, axis=1, keepdims=True) * rng.choice([-1.0, 1.0], (_POINTS, 1))
    )
    offset = _offsets(rng, _POINTS, min_offset_m)
    return surface + np.where(is_noise[:, None], offset[:, None] * axis, 0.0), is_noise


def _offsets(rng: np.random.Generator, count: int, least: float) -> F64:
    """Truncated normal offsets [m], by rejection."""
    drawn = rng.normal(OFFSET_MEAN_M, OFFSET_SIGMA_M, 64 * count)
    return np.asarray(drawn[(drawn > least) & (drawn <= OFFSET_MAX_M)][:count])


@lru_cache(maxsize=4)
def _surface(seed: int) -> tuple[F64, F64, F64]:
    """Clean points, unit normals and view rays, (18809, 3) each."""
    rng = np.random.default_rng([seed, 0])
    scene = _ore_on_bars(rng)
    spacing = 0.006
    points = np.empty((0, 9))
    while len(points) < _POINTS:
        points = _cast(scene, spacing)
        spacing *= min(0.99, float(np.sqrt(len(points) / _POINTS)))
    points = points[rng.permutation(len(points))[:_POINTS]]
    low, span = points[:, :3].min(0), np.ptp(points[:, :3], axis=0)
    stretch = np.array(EXTENT_M) / span
    normals = points[:, 3:6] / stretch
    return (
        (points[:, :3] - low) * stretch,
        normals / np.linalg.norm(normals, axis=1, keepdims=True),
        points[:, 6:],
    )


def _ore_on_bars(rng: np.random.Generator) -> Mesh:
    """Lumps of 80–250 mm resting on bars, stretched so that their top is right."""
    screen = Screen(0.075, 0.04, 0.06, (EXTENT_M[0] - 0.08, EXTENT_M[1] - 0.08), 0.04, 2, 0.6)
    steel = merge([bars(screen), frame(screen)])
    sizes = np.sort(rng.uniform(0.08, 0.25, 14))[::-1]
    lumps = [rock(rng, str(rng.choice(list(PROPORTIONS))), s) for s in sizes]
    field = HeightField.over((EXTENT_M[0] / 2, EXTENT_M[1] / 2), 0.004)
    field.add(steel)
    poses = pile(lumps, field, (0.2, 0.33), rng, sink_m=0.01)
    ore = merge([lumps[k].moved(R, t) for k, R, t in poses])
    stones = ore.vertices * [1, 1, (EXTENT_M[2] - 0.04) / ore.vertices[:, 2].max()]
    return merge([steel, Mesh(stones, ore.triangles)])


def _cast(surface: Mesh, spacing: float) -> F64:
    """Points, normals and rays (N, 9) seen through a grid in the bar tops' plane, no deeper than 40
    mm.
    """
    half = np.array(EXTENT_M[:2]) / 2 - 1e-5
    x, y = (np.linspace(-h, h, round(2 * h / spacing) + 1) for h in half)
    target = np.stack([*np.meshgrid(x, y, indexing="ij"), np.zeros((len(x), len(y)))], -1).reshape(
        -1, 3
    )
    rays = target - EYE_M
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    origin = np.broadcast_to(EYE_M, rays.shape)
    hit = cast(ray_caster(surface), np.concatenate([origin, rays], 1))
    points = origin + rays * hit["t_hit"][:, None].astype(float)
    seen = np.isfinite(points[:, 2]) & (points[:, 2] > -0.04)
    return np.asarray(np.concatenate([points, hit["primitive_normals"], rays], 1)[seen], np.float64)
