"""Clean pieces of surface to learn from: made shapes of many kinds and crops of scans, in spacings
of their points.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from scipy.spatial import cKDTree

from stereo_ore.lab.synth import paper_cloud
from stereo_ore.lab.synth.outliers import cloud_spacing, crop_cloud, normals
from stereo_ore.types import F64

_POINTS = 4500
_Rng = np.random.Generator
Shape = Callable[[_Rng, int], F64]


def sample_surface(rng: _Rng, scans: Sequence[F64], points: int = _POINTS) -> F64:
    """A clean piece: a shape or a scan, sometimes thinned, of falling density, merged with itself,
    roughened.
    """
    if scans and rng.random() < 0.25:
        xyz = crop_cloud(rng, scans[int(rng.integers(len(scans)))], int(points * rng.uniform(1, 3)))
    else:
        xyz = SHAPES[str(rng.choice(list(SHAPES)))](rng, points)
    xyz = _worn(rng, xyz)
    return roughened(rng, crop_cloud(rng, xyz, points) if len(xyz) > points else xyz)


def _worn(rng: _Rng, xyz: F64) -> F64:
    if rng.random() < 0.4:
        xyz = xyz[rng.random(len(xyz)) < rng.uniform(0.25, 1)]
    if rng.random() < 0.25:
        along = xyz @ rng.normal(size=3)
        along = (along - along.min()) / np.ptp(along)
        xyz = xyz[rng.random(len(xyz)) < np.clip(along ** rng.uniform(0.5, 1.5) + 0.08, 0.08, 1)]
    if rng.random() < 0.2:
        xyz = np.vstack(
            [xyz, xyz + rng.normal(0, rng.uniform(0.05, 0.6) * cloud_spacing(xyz), xyz.shape)]
        )
    return xyz


def roughened(rng: _Rng, xyz: F64) -> F64:
    """Half of all pieces as they are, others moved by up to 1.1 spacings along the normal or all
    ways, or ever more.
    """
    amount = float(rng.choice([0, 0, rng.uniform(0, 0.3), rng.uniform(0, 1.1)])) * cloud_spacing(
        xyz
    )
    if rng.random() < 0.25:
        along = xyz @ rng.normal(size=3)
        part = (along - along.min()) / np.ptp(along)
        return np.asarray(
            xyz + amount * part[:, None] * normals(xyz) * rng.normal(size=(len(xyz), 1))
        )
    if rng.random() < 0.6:
        # Real ones have more far points than a normal distribution.
        tail = (
            rng.normal(size=(len(xyz), 1))
            if rng.random() < 0.5
            else rng.laplace(0, 0.7, (len(xyz), 1))
        )
        return np.asarray(xyz + amount * normals(xyz) * tail)
    return np.asarray(xyz + 0.7 * amount * rng.normal(size=xyz.shape))


def _paper(rng: _Rng, m: int) -> F64:
    return crop_cloud(
        rng,
        paper_cloud(100 + int(rng.integers(2)), noise_share=0.0)[0],
        int(m * rng.uniform(1, 2.5)),
    )


def _square(rng: _Rng, m: int, regular: bool = False) -> F64:
    side = np.sqrt(m)
    if not regular:
        return rng.uniform(-side / 2, side / 2, (m, 2))
    xy = np.indices((int(side), int(side))).reshape(2, -1).T - side / 2
    return np.asarray(xy + rng.normal(0, rng.choice([0, 0.05, 0.15]), xy.shape))


def _wave(rng: _Rng, m: int, regular: bool = False) -> F64:
    xy, side = _square(rng, m, regular), np.sqrt(m)
    a, b = rng.uniform(2, 12, 2)
    z = side * rng.uniform(0, 0.12) * np.sin(a * xy[:, 0] / side) * np.cos(b * xy[:, 1] / side)
    return np.column_stack([xy, z])


def _grid(rng: _Rng, m: int) -> F64:
    return _wave(rng, m, regular=True)


def _slab(rng: _Rng, m: int) -> F64:
    xyz = _wave(rng, m)
    xyz[:, 2] += np.where(rng.random(m) < 0.5, 0, rng.uniform(2, 8))
    return xyz


def _edge(rng: _Rng, m: int) -> F64:
    xyz = _wave(rng, m)
    xyz[:, 2] += np.abs(xyz[:, 0]) * rng.uniform(0.3, 3) + np.where(
        xyz[:, 1] > 0, rng.uniform(0, 15), 0
    )
    return xyz


def _ball(rng: _Rng, m: int) -> F64:
    x = rng.normal(size=(m, 3))
    return np.asarray(
        x / np.linalg.norm(x, axis=1)[:, None] * np.sqrt(m) / 3.5 * rng.uniform(0.5, 1, 3)
    )


def _fan(rng: _Rng, m: int) -> F64:
    """Spacing that grows with the distance from a point, as a turning scanner's."""
    r = np.exp(rng.uniform(np.log(rng.uniform(0.05, 0.3)), np.log(2), m))
    a = rng.uniform(0, rng.uniform(1, 6.3), m)
    z = 0.1 * r * np.sin(3 * a) + rng.uniform(0, 0.02) * r * rng.normal(size=m)
    return np.column_stack([r * np.cos(a), r * np.sin(a), z])


def _stairs(rng: _Rng, m: int) -> F64:
    """Treads, and risers with few points."""
    xy, steps, thin = (
        rng.uniform(0, 1, (m, 2)),
        int(rng.integers(2, 9)),
        rng.random(m) < rng.uniform(0.03, 0.5),
    )
    rise, foot = rng.uniform(0.3, 1.2) / steps, np.floor(xy[:, 0] * steps)
    xy[thin, 0] = np.ceil(xy[thin, 0] * steps) / steps
    return np.column_stack([xy, (foot + thin * rng.uniform(0, 1, m)) * rise])


def _scan_lines(rng: _Rng, m: int) -> F64:
    """Lines that are 2 to 8 times as far apart as their points, over a wave."""
    ratio = rng.uniform(2, 8)
    lines = max(int(np.sqrt(m / ratio)), 4)
    along = np.arange(m) // lines + rng.normal(0, 0.1, m)
    xy = np.column_stack([along, (np.arange(m) % lines) * ratio + rng.normal(0, 0.05, m)])
    z = (
        rng.uniform(0, 6)
        * np.sin(xy[:, 0] / rng.uniform(8, 40))
        * np.cos(xy[:, 1] / rng.uniform(8, 40))
    )
    return np.column_stack([xy, z])


def _depth_steps(rng: _Rng, m: int) -> F64:
    """A slope whose heights are whole multiples of a step, as whole disparities make them."""
    xyz = _wave(rng, m)
    xyz[:, 2] += xyz[:, 0] * rng.uniform(0.1, 0.8)
    step = rng.uniform(0.3, 3)
    xyz[:, 2] = np.round(xyz[:, 2] / step) * step + rng.uniform(0, 0.1) * rng.normal(size=m)
    return xyz


def _rods(rng: _Rng, m: int) -> F64:
    """Thin straight rods, some over a floor."""
    count, floor = int(rng.integers(3, 15)), rng.random() < 0.5
    side, on_rod = np.sqrt(m), rng.random(m) < (0.4 if floor else 1.0)
    centre, axis = (
        rng.uniform(-side / 2, side / 2, (count, 3)) * [1, 1, 0.3],
        rng.normal(size=(count, 3)) * [1, 1, 0.2],
    )
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    rod, along = rng.integers(count, size=m), rng.uniform(-side / 3, side / 3, (m, 1))
    around = rng.normal(size=(m, 3))
    around /= np.linalg.norm(around, axis=1, keepdims=True)
    xyz = centre[rod] + axis[rod] * along + around * rng.uniform(0.3, 2)
    return np.where(
        on_rod[:, None], xyz, np.column_stack([_square(rng, m), np.full(m, -0.3 * side)])
    )


def _blobs(rng: _Rng, m: int) -> F64:
    """Stones of many sizes in a heap: ellipsoids that hide each other's parts."""
    count, side = int(rng.integers(5, 40)), np.sqrt(m)
    centre = rng.uniform(-side / 2, side / 2, (count, 3)) * [1, 1, 0.15]
    size = side * rng.uniform(0.06, 0.25, (count, 1)) * rng.uniform(0.5, 1, (count, 3))
    area = (size.prod(1) ** (2 / 3)) / (size.prod(1) ** (2 / 3)).sum()
    stone, x = rng.choice(count, m, p=area), rng.normal(size=(m, 3))
    xyz = centre[stone] + x / np.linalg.norm(x, axis=1)[:, None] * size[stone]
    inside = [(((xyz - c) / s) ** 2).sum(1) < 0.98 for c, s in zip(centre, size, strict=True)]
    return np.asarray(xyz[~np.any(inside, axis=0)])


def _gravel(rng: _Rng, m: int) -> F64:
    """Stones down to the spacing of the points, seen from above: rough, yet without an outlier."""
    xy, side, count = (
        _square(rng, m, bool(rng.random() < 0.3)),
        np.sqrt(m),
        int(rng.integers(100, 1500)),
    )
    size = np.minimum(rng.uniform(0.8, 4) * (1 + rng.pareto(rng.uniform(1, 2.5), count)), side / 5)
    centre, flat = rng.uniform(-side / 2, side / 2, (count, 2)), rng.uniform(0.3, 1)
    below = ((xy[:, None] - centre) ** 2).sum(2)
    top = np.sqrt(np.maximum(size**2 - below, 0)) * flat + np.where(
        below < size**2, rng.normal(0, 0.3, count) * size, 0
    )
    return np.column_stack(
        [xy, top.max(1) + 0.05 * side * np.sin(xy[:, 0] / side * rng.uniform(1, 6))]
    )


def _fractal(rng: _Rng, m: int, waves: int = 150) -> F64:
    """Ground that is rough at every scale: waves whose height falls with a power of their
    length.
    """
    xy, side = _square(rng, m, bool(rng.random() < 0.3)), np.sqrt(m)
    length = side * np.exp(rng.uniform(np.log(2 / side), 0, waves))
    turn, phase = rng.uniform(0, 2 * np.pi, (2, waves))
    height = rng.uniform(0.05, 0.5) * (length / 2) ** rng.uniform(0.6, 1) / np.sqrt(waves / 6)
    along = xy[:, :1] * np.cos(turn) + xy[:, 1:] * np.sin(turn)
    return np.column_stack([xy, (np.sin(2 * np.pi * along / length + phase) * height).sum(1)])


def _tufts(rng: _Rng, m: int) -> F64:
    """Grass, twigs and rubbish: short blades in patches on uneven ground."""
    ground = _fractal(rng, m)
    m = len(ground)
    share, side, count = rng.uniform(0.1, 0.7), np.sqrt(m), int(rng.integers(40, 500))
    patch = rng.uniform(-side / 2, side / 2, (int(rng.integers(1, 12)), 2))
    foot = patch[rng.integers(len(patch), size=count)] + rng.normal(
        0, side * rng.uniform(0.05, 0.3), (count, 2)
    )
    axis = rng.normal(size=(count, 3)) * [1, 1, 0.5] + [0, 0, rng.uniform(0, 1.5)]
    axis *= rng.uniform(1, 8) / np.linalg.norm(axis, axis=1, keepdims=True)
    blade = rng.integers(count, size=m)
    height = ground[cKDTree(ground[:, :2]).query(foot)[1], 2]
    bent = rng.random((m, 1))
    blades = (
        np.column_stack([foot, height])[blade]
        + axis[blade] * bent
        + rng.normal(0, rng.uniform(0, 0.3), (m, 3))
    )
    return np.where(rng.random((m, 1)) < share, blades, ground)


SHAPES: Mapping[str, Shape] = {
    "paper": _paper, "wave": _wave, "grid": _grid, "slab": _slab, "edge": _edge, "ball": _ball,
    "fan": _fan,
    "stairs": _stairs, "scan lines": _scan_lines, "depth steps": _depth_steps, "rods": _rods,
    "stones": _blobs,
    "gravel": _gravel, "fractal": _fractal, "tufts": _tufts,
}  # fmt: skip
