"""Labelled clouds without cues to learn from; a good third of them has no outlier at all."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from stereo_ore.lab.bench.labelled import DIRECTIONS, LabelledCloud, bare_cloud, paper_clouds
from stereo_ore.lab.synth import paper_cloud
from stereo_ore.lab.synth.outliers import plant_outliers
from stereo_ore.lab.training.surfaces import sample_surface
from stereo_ore.types import F64, Mask

PIECES_A_SEED = 240
CLEAN_SHARE = 0.45
"""Of the pieces: with fewer, a scorer takes roughness for noise."""

_KINDS = (*DIRECTIONS, *DIRECTIONS, "clumps", "clumps", "clumps", "flyers", "dust")
"""Planted kinds. Sheets beside a surface are none of them: pieces of real stones are sheets."""

_CROP = 6000


def bare_clouds(seeds: range, scans: Sequence[F64]) -> Iterator[LabelledCloud]:
    """For each seed: the paper's protocol and variants of it, cropped, and `PIECES_A_SEED` pieces
    of other surfaces.
    """
    for seed in seeds:
        for labelled in _protocol(seed):
            xyz = labelled.voxels.xyz
            near = np.argsort(np.abs(xyz[:, :2] - xyz[len(xyz) // 2, :2]).max(1))[:_CROP]
            yield LabelledCloud(
                labelled.name, "paper", bare_cloud(xyz[near]), labelled.is_noise[near]
            )
        for piece in range(PIECES_A_SEED):
            yield _piece(np.random.default_rng([seed, piece]), scans, f"piece {seed}.{piece}")


def clouds_a_seed() -> int:
    """How many clouds `bare_clouds` makes of a seed."""
    return PIECES_A_SEED + 15


def _piece(rng: np.random.Generator, scans: Sequence[F64], name: str) -> LabelledCloud:
    xyz = sample_surface(rng, scans)
    kind, clean = str(rng.choice(_KINDS)), rng.random() < CLEAN_SHARE
    # Moved points are many or few; scanners' own outliers mostly few, yet no less to be found.
    moved, added = (0.005, 0.1) if rng.random() < 0.5 else (0.05, 0.6), np.log([0.002, 0.25])
    share = float(rng.uniform(*moved) if kind in DIRECTIONS else np.exp(rng.uniform(*added)))
    xyz, noise = (xyz, np.zeros(len(xyz), bool)) if clean else plant_outliers(rng, xyz, share, kind)
    return LabelledCloud(
        name, "clean" if clean else kind, bare_cloud(xyz - np.median(xyz, axis=0)), noise
    )


def _protocol(seed: int) -> Iterator[LabelledCloud]:
    """The paper's nine clouds, and six with other spacing, roughness, share and offsets."""
    yield from paper_clouds(range(seed, seed + 1))
    for variant in range(6):
        yield varied(seed, variant)


def varied(seed: int, variant: int) -> LabelledCloud:
    """A thinned, roughened and sometimes voxelised cloud, so that the scorer does not learn one
    scanner's pattern.
    """
    rng = np.random.default_rng([seed, variant])
    share, least = float(rng.uniform(0.03, 0.6)), float(rng.choice([0, 0.008, 0.012]))
    xyz, noise = paper_cloud(seed, DIRECTIONS[variant % 3], share, least)
    kept = rng.random(len(xyz)) < rng.uniform(0.35, 1)
    xyz, noise = xyz[kept], noise[kept]
    xyz = xyz + rng.normal(size=xyz.shape) * rng.uniform(0, 0.0012)
    if rng.random() < 0.4:
        xyz, noise = _voxelised(xyz, noise, rng.uniform(0.004, 0.007))
    return LabelledCloud(f"varied {seed}.{variant}", "varied", bare_cloud(xyz), noise)


def _voxelised(xyz: F64, noise: Mask, size: float) -> tuple[F64, Mask]:
    _, inverse, count = np.unique(
        np.floor(xyz / size), axis=0, return_inverse=True, return_counts=True
    )
    inverse = inverse.ravel()
    means = np.stack([np.bincount(inverse, xyz[:, axis]) / count for axis in range(3)], 1)
    return means, np.bincount(inverse, noise) / count > 0.5
