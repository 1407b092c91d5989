"""Outliers planted on clean clouds, in units of the cloud's own spacing: the published
experiment's, and others.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
from scipy.spatial import cKDTree

from stereo_ore.lab.synth.paper_cloud import OFFSET_MAX_M, OFFSET_MEAN_M, OFFSET_SIGMA_M
from stereo_ore.types import F64, Mask

PAPER_SPACING_M = 0.00596
"""Median over the paper's clean surface of the mean distance to 8 neighbours: what its offsets are
measured in here."""

_Rng = np.random.Generator


def plant_outliers(rng: _Rng, xyz: F64, share: float, kind: str) -> tuple[F64, Mask]:
    """A cloud with a share of outliers.

    Parameters
    ----------
    rng : numpy.random.Generator
    xyz : (N, 3) array
        Clean points; the viewer is over the middle of their least extent.
    share : float
        Of outliers among all points, 0…1.
    kind : str
        "isotropic", "normal", "ray": points moved by the offsets of `paper_cloud`; "flyers": by far
        more along the ray; "clumps", "dust", "ghost": points added.

    Returns
    -------
    xyz : (M, 3) float64
    is_noise : (M,) bool
    """
    if kind in ADDED:
        more = ADDED[kind](rng, xyz, cloud_spacing(xyz), round(share / (1 - share) * len(xyz)))
        return np.vstack([xyz, more]), np.r_[np.zeros(len(xyz), bool), np.ones(len(more), bool)]
    is_noise = np.zeros(len(xyz), bool)
    is_noise[rng.permutation(len(xyz))[: round(share * len(xyz))]] = True
    count = int(is_noise.sum())
    axis = _axes(rng, xyz, kind)[is_noise]
    axis = axis / np.linalg.norm(axis, axis=1, keepdims=True) * rng.choice([-1.0, 1.0], (count, 1))
    far = 2 + rng.exponential(6, count) if kind == "flyers" else _paper_offsets(rng, count)
    out = xyz.copy()
    out[is_noise] += axis * far[:, None] * cloud_spacing(xyz)
    return out, is_noise


def crop_cloud(rng: _Rng, xyz: F64, count: int) -> F64:
    """`count` points around a random one, as seen along the cloud's least extent."""
    axes = np.argsort(np.ptp(xyz, axis=0))[1:]
    far = np.abs(xyz[:, axes] - xyz[rng.integers(len(xyz))][axes]).max(1)
    return xyz[np.argpartition(far, min(count, len(xyz) - 1))[:count]]


def cloud_spacing(xyz: F64, sample: int = 1500) -> float:
    """Median of the mean distance to 8 neighbours, over points spread through the cloud."""
    some = xyz[:: max(1, len(xyz) // sample)]
    distance = np.asarray(cKDTree(xyz).query(some, k=9)[0])
    return float(np.median(distance[:, 1:].mean(1)))


def normals(xyz: F64, k: int = 16) -> F64:
    """Unit normals (N, 3) of the planes through k neighbours each."""
    near = xyz[cKDTree(xyz).query(xyz, k=min(k, len(xyz)))[1]]
    away = near - near.mean(1, keepdims=True)
    return np.asarray(np.linalg.eigh(np.einsum("nki,nkj->nij", away, away))[1][..., 0])


def view_rays(xyz: F64) -> F64:
    """Unit vectors (N, 3) from a viewer in front of the cloud, a bit beside its middle."""
    extent = np.ptp(xyz, axis=0)
    out_of = np.eye(3)[int(np.argmin(extent))]
    rays = xyz - (
        np.median(xyz, axis=0) + (out_of * 1.3 + np.roll(out_of, 1) * 0.15) * extent.max()
    )
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def _axes(rng: _Rng, xyz: F64, kind: str) -> F64:
    if kind == "isotropic":
        return rng.normal(size=xyz.shape)
    if kind == "normal":
        return normals(xyz)
    if kind in ("ray", "flyers"):
        return view_rays(xyz)
    raise ValueError(f"no outliers are called {kind!r}")


def _paper_offsets(rng: _Rng, count: int) -> F64:
    """N(16.039, 8.019) mm cut to (0, 48.12] mm, in spacings."""
    drawn = rng.normal(OFFSET_MEAN_M, OFFSET_SIGMA_M, 2 * count + 64)
    return np.asarray(drawn[(drawn > 0) & (drawn <= OFFSET_MAX_M)][:count] / PAPER_SPACING_M)


def _clumps(rng: _Rng, xyz: F64, unit: float, count: int) -> F64:
    """Balls of 4 to 40 points, 4 to 15 spacings off the cloud."""
    parts: list[F64] = []
    while sum(map(len, parts)) < count:
        size, axis = int(rng.integers(4, 41)), rng.normal(size=3)
        centre = (
            xyz[rng.integers(len(xyz))] + axis / np.linalg.norm(axis) * rng.uniform(4, 15) * unit
        )
        parts.append(
            centre + rng.normal(size=(size, 3)) * unit * rng.uniform(0.4, 1.2) * np.cbrt(size) / 2
        )
    return np.vstack([np.empty((0, 3)), *parts])[:count]


def _dust(rng: _Rng, xyz: F64, unit: float, count: int, margin: float = 20.0) -> F64:
    """Evenly in a box that is some spacings wider than the cloud."""
    return rng.uniform(xyz.min(0) - margin * unit, xyz.max(0) + margin * unit, (count, 3))


def _ghost(rng: _Rng, xyz: F64, unit: float, count: int) -> F64:
    """A thin copy of parts of the cloud, 4 to 8 spacings in front of it, as multiple paths of light
    make.
    """
    rows = rng.integers(len(xyz), size=count)
    return (
        xyz[rows]
        - view_rays(xyz)[rows] * rng.uniform(4, 8, (count, 1)) * unit
        + rng.normal(size=(count, 3)) * unit
    )


ADDED: Mapping[str, Callable[[_Rng, F64, float, int], F64]] = {
    "clumps": _clumps,
    "dust": _dust,
    "haze": partial(_dust, margin=2.0),
    "ghost": _ghost,
}
MOVED = ("isotropic", "normal", "ray", "flyers")
"""Kinds that move points of the surface itself."""
