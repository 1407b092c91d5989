"""Clouds without one outlier, and scans with planted ones: what a filter must keep, and what it
must still find.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from stereo_ore.errors import SourceError
from stereo_ore.io import clouds
from stereo_ore.lab.bench.labelled import DIRECTIONS, LabelledCloud, bare_cloud
from stereo_ore.lab.synth.outliers import cloud_spacing, crop_cloud, normals, plant_outliers
from stereo_ore.lab.synth.paper_cloud import NOISE_SHARES
from stereo_ore.types import F64

_POINTS = 9000
_CROP = 10_000
_GAP = 0.5
"""Mean distance to the nearest neighbour of points at random, one to a unit of area: roughness is a
share of it."""

OTHER_KINDS = (
    ("clumps", 0.05),
    ("clumps", 0.15),
    ("flyers", 0.03),
    ("flyers", 0.15),
    ("dust", 0.05),
)
"""Planted besides the paper's."""

_Rng = np.random.Generator


def read_scans(folder: Path) -> list[tuple[str, F64]]:
    """Names and points, about their middle, of all clouds in a folder.

    Raises
    ------
    SourceError
        When there is none.
    """
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in clouds.CLOUD_FORMATS)
    if not files:
        raise SourceError(
            "holds no cloud",
            file=folder,
            remedy=f"Give a folder with {', '.join(clouds.CLOUD_FORMATS)}",
        )
    return [(path.stem, scan(path)) for path in files]


def scan(path: Path) -> F64:
    """Finite points (N, 3) of a cloud file, about their middle."""
    xyz = clouds.xyz(clouds.read(path))
    xyz = xyz[np.isfinite(xyz).all(1)]
    return np.asarray(xyz - np.median(xyz, axis=0), np.float64)


def clean_clouds(seeds: range, scans: Sequence[tuple[str, F64]]) -> Iterator[LabelledCloud]:
    """Made surfaces of `CLEAN`, and scans: as they are, a quarter of their points, two noisy ones
    merged.
    """
    for seed in seeds:
        for name, make in CLEAN.items():
            yield _clean(name, make(np.random.default_rng([seed, 2])))
        for name, xyz in scans:
            rng = np.random.default_rng([seed, 3])
            yield _clean(f"{name}", xyz)
            yield _clean(f"{name}, a quarter", xyz[rng.random(len(xyz)) < 0.25])
            twice = crop_cloud(rng, xyz, 2 * _CROP)
            noise = 0.3 * cloud_spacing(twice)
            yield _clean(
                f"{name}, merged",
                np.vstack([twice + rng.normal(0, noise, twice.shape) for _ in range(2)]),
            )


def planted_clouds(seeds: range, scans: Sequence[tuple[str, F64]]) -> Iterator[LabelledCloud]:
    """Crops of scans with the paper's outliers, at its three shares, and with outliers of
    `OTHER_KINDS`.
    """
    for seed in seeds:
        for name, xyz in scans:
            rng = np.random.default_rng([seed, 4])
            for share in NOISE_SHARES:
                for direction in DIRECTIONS:
                    yield _planted(
                        f"{name}, paper's, {100 * share:.1f} %", rng, xyz, share, direction
                    )
            for kind, share in OTHER_KINDS:
                yield _planted(f"{name}, {kind}, {100 * share:.0f} %", rng, xyz, share, kind)


def _clean(cell: str, xyz: F64) -> LabelledCloud:
    return LabelledCloud(
        cell, cell, bare_cloud(xyz - np.median(xyz, axis=0)), np.zeros(len(xyz), bool)
    )


def _planted(cell: str, rng: _Rng, xyz: F64, share: float, kind: str) -> LabelledCloud:
    points, noise = plant_outliers(rng, crop_cloud(rng, xyz, _CROP), share, kind)
    return LabelledCloud(
        f"{cell}, {kind}", cell, bare_cloud(points - np.median(points, axis=0)), noise
    )


def _rough(rng: _Rng, roughness: float, regular: bool = False) -> F64:
    """A bent surface, at random or on a grid, with normal noise along the normal, in point
    distances.
    """
    side = int(np.sqrt(_POINTS))
    grid = np.indices((side, side)).reshape(2, -1).T.astype(float)
    xy = grid if regular else rng.uniform(0, side, (_POINTS, 2))
    xyz = np.column_stack(
        [xy, 0.06 * side * np.sin(5 * xy[:, 0] / side) * np.cos(4 * xy[:, 1] / side)]
    )
    amount = roughness * (1 if regular else _GAP)
    return np.asarray(xyz + normals(xyz) * rng.normal(0, amount, (len(xyz), 1)))


def _unit(rng: _Rng, count: int) -> F64:
    axis = rng.normal(size=(count, 3))
    return np.asarray(axis / np.linalg.norm(axis, axis=1, keepdims=True))


def _torus(rng: _Rng) -> F64:
    """Ten times as dense on one side as on the other."""
    around = (
        2
        * np.pi
        * np.where(rng.random(_POINTS) < 0.1, rng.random(_POINTS), 0.5 * rng.random(_POINTS))
    )
    tube = rng.uniform(0, 2 * np.pi, _POINTS)
    ring = 40 + 12 * np.cos(tube)
    return np.column_stack([ring * np.cos(around), ring * np.sin(around), 12 * np.sin(tube)])


def _cylinder(rng: _Rng) -> F64:
    """Standing on a floor."""
    turn, side = rng.uniform(0, 2 * np.pi, _POINTS // 3), np.sqrt(_POINTS)
    standing = np.column_stack(
        [12 * np.cos(turn), 12 * np.sin(turn), rng.uniform(0, 30, len(turn))]
    )
    floor = np.column_stack([rng.uniform(-side / 2, side / 2, (_POINTS, 2)), np.zeros(_POINTS)])
    return np.vstack([standing, floor])


def _balls(rng: _Rng) -> F64:
    """Forty, that touch nothing."""
    centre = rng.uniform(-60, 60, (40, 3))
    return np.asarray(centre[rng.integers(40, size=_POINTS)] + 6 * _unit(rng, _POINTS))


def _patches(rng: _Rng) -> F64:
    """Twenty-five of them, each of its own density."""
    patch = np.minimum(rng.integers(25, size=_POINTS), rng.integers(25, size=_POINTS))
    xy = np.column_stack([patch % 5, patch // 5]) * 20 + rng.uniform(0, 20, (_POINTS, 2))
    return np.column_stack([xy, rng.normal(0, 0.05, _POINTS)])


def _ribbon(rng: _Rng) -> F64:
    turn = rng.uniform(0, 6, _POINTS)
    return np.column_stack(
        [20 * np.cos(turn), 20 * np.sin(turn), 5 * turn + rng.uniform(0, 4, _POINTS)]
    )


def _corner(rng: _Rng) -> F64:
    """Three walls."""
    return np.vstack(
        [np.insert(rng.uniform(0, 55, (_POINTS // 3, 2)), axis, 0, axis=1) for axis in range(3)]
    )


def _growing(rng: _Rng) -> F64:
    """Roughness from nothing to a whole point distance across."""
    xyz = _rough(rng, 0.0)
    part = xyz[:, :1] / xyz[:, 0].max()
    return np.asarray(xyz + normals(xyz) * rng.normal(0, _GAP, (len(xyz), 1)) * part)


CLEAN: Mapping[str, Callable[[_Rng], F64]] = {
    "roughness 0": lambda rng: _rough(rng, 0.0),
    "roughness 0.3": lambda rng: _rough(rng, 0.3),
    "roughness 0.6": lambda rng: _rough(rng, 0.6),
    "roughness 1": lambda rng: _rough(rng, 1.0),
    "grid, roughness 0.1": lambda rng: _rough(rng, 0.1, regular=True),
    "grid, roughness 0.6": lambda rng: _rough(rng, 0.6, regular=True),
    "roughness 0 to 1": _growing,
    "ball": lambda rng: 50 * _unit(rng, _POINTS),
    "torus, density 1:10": _torus,
    "cylinder on a floor": _cylinder,
    "forty balls": _balls,
    "patches": _patches,
    "ribbon": _ribbon,
    "corner": _corner,
}
"""Surfaces; but for waves and balls no training has their kind."""
