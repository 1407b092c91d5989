"""Evidence of a stereo cloud: what the matcher knew of each voxel, and neighbours where that leaves
a doubt.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stereo_ore.stages.filters.evidence import (
    ODDS_FEATURES,
    PLANE_FEATURES,
    Questions,
    Rows,
    mean_distances,
    mean_of,
)
from stereo_ore.stages.filters.neighbours import columns, nearest
from stereo_ore.stages.filters.surface import LEAST, fit_weighted_planes, log_odds
from stereo_ore.types import CONTEXT, CUES, F32, VoxelCloud

FLOORS = {
    "spread_px": 0.05,
    "lr_diff_px": 0.03,
    "texture": 0.3,
    "photometric": 0.03,
    "median_diff_px": 0.03,
}
"""Added before a cue's logarithm."""

DISPARITY_STRETCH = 0.3
"""Image space [px]: one standard deviation of depth noise counts as this many pixels across."""

MOST = 50.0
_NOTHING = np.zeros(0, np.float32)

SURE = 0.12
"""Below this probability of either verdict a first pass by cues alone is believed."""


def has_cues(voxels: VoxelCloud) -> bool:
    """True for a cloud that a matcher made and spoke about, with what lies around in the image."""
    return {*CUES, *CONTEXT} <= set(voxels.cues) and bool(
        (voxels.sigma_z > 0).all() and (voxels.pixel_m > 0).all()
    )


@dataclass(frozen=True)
class StereoEvidence:
    """Of a cloud with cues: points in image space in voxels (M, 3), what tells the cue features
    (n, F) of some rows, neighbours wanted.
    """

    points: F32
    cues: Callable[[slice | Rows], F32]
    k: int

    names = (
        *CUES, "points", "voxel in pixels", "depth noise in voxels", *CONTEXT,
        "mean distance, K = 3", "mean distance, K = 8", "mean distance, all K", *PLANE_FEATURES,
        *ODDS_FEATURES,
    )  # fmt: skip

    @property
    def prior(self) -> F32:
        """Nothing is known before the cues are looked at."""
        return np.full(len(self.points), 0.5, np.float32)

    def ask(self, noise: F32, number: int) -> Questions:
        """Cues in the first pass; then density and surface too, by the k nearest neighbours
        (equations 1 and 2).

        The logarithms of the mean distances to the nearest 3, 8 and k; the plane through the
        neighbours, weighted by how likely each is to be surface (`surface.fit_weighted_planes`);
        the odds of the pass before, and of the neighbours.
        """
        if number == 0 or not len(noise):
            return Questions(np.arange(len(noise)), _NOTHING, self.cues)
        rows = np.flatnonzero((noise > SURE) & (noise < 1 - SURE))
        return Questions(rows, _NOTHING, self._table(noise, rows))

    def _table(self, noise: F32, rows: Rows) -> Callable[[slice], F32]:
        if not len(rows):
            return lambda part: self.cues(rows[part])
        at = self.points[rows]
        index, distance = nearest(self.points, at, min(self.k + 1, len(self.points)))
        index, distance = index[:, 1:], distance[:, 1:]
        density = np.log(mean_distances(distance) + np.float32(LEAST))
        planes, odds = fit_weighted_planes(self.points, index, 1 - noise, at), log_odds(noise)
        found = columns(density, planes.shape, odds[rows], mean_of(odds, index))
        return lambda part: columns(self.cues(rows[part]), found[part])


def stereo_evidence(voxels: VoxelCloud, k: int) -> StereoEvidence:
    """Evidence of a cloud that `has_cues`."""
    voxel_px = float(np.median(voxels.size_m / voxels.pixel_m))
    space = image_space(voxels)
    return StereoEvidence(columns((space - np.median(space, axis=0)) / voxel_px), _cues(voxels), k)


def image_space(voxels: VoxelCloud) -> F32:
    """(u, v, disparity) of each voxel, (M, 3) [px], disparity in units of its noise times
    `DISPARITY_STRETCH`.

    u = x/z · f, v = y/z · f with f = z / pixel size; disparity over its standard deviation is
    z/σ_z. In these coordinates noise has one size everywhere, where in metres it grows with z².
    """
    z = voxels.xyz[:, 2].astype(np.float64)
    focal = np.median(z / voxels.pixel_m)
    image = np.column_stack(
        [voxels.xyz[:, :2] / z[:, None] * focal, DISPARITY_STRETCH * z / voxels.sigma_z]
    )
    return image.astype(np.float32)


def _cues(voxels: VoxelCloud) -> Callable[[slice | Rows], F32]:
    """What tells the cues (n, F) of some rows: shares as they are, offsets as
    sign(o)·log(1 + 3|o|), the confidence as log odds, logarithms of all else; what the matcher did
    not know counts as 0.

    Then the points behind a voxel over those it has room for, its edge in pixels, depth noise in
    edges, and what lies around, none of it beyond ±`MOST`. A table of all rows would cost more to
    write and read than what some rows cost again.
    """

    def features(rows: slice | Rows) -> F32:
        own = (
            _scaled(name, np.nan_to_num(voxels.cues[name][rows], nan=0.0, posinf=0.0, neginf=0.0))
            for name in CUES
        )
        room = voxels.size_m / voxels.pixel_m[rows]
        plain = (voxels.count[rows] / room**2, room, voxels.sigma_z[rows] / voxels.size_m)
        around = (voxels.cues[name][rows] for name in CONTEXT)
        table = columns(*own, *(np.log(x) for x in plain), *around)
        limited = table[:, -len(CONTEXT) :]
        np.clip(limited, -MOST, MOST, out=limited)
        return table

    return features


def _scaled(name: str, cue: F32) -> F32:
    if name == "confidence":
        return log_odds(cue)
    if name.startswith("offset"):
        return np.asarray(np.copysign(np.log1p(3 * np.abs(cue)), cue))
    if name.startswith("scatter"):
        return np.asarray(np.log(np.maximum(cue, 0) + np.float32(0.05)))
    if name in FLOORS:
        return np.asarray(np.log(np.maximum(cue, 0) + np.float32(FLOORS[name])))
    return cue
