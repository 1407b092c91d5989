"""What is true of each lump: mass, size, what of it is seen, what it touches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from stereo_ore.lab.synth.eye import Eye
from stereo_ore.lab.synth.mesh import (
    Mesh,
    callipers,
    cast,
    icosphere,
    ray_caster,
    volume_and_centre,
)
from stereo_ore.lab.synth.model import FIRST_LUMP, Lump, Model
from stereo_ore.lab.synth.spec import SceneSpec
from stereo_ore.stages.solid import over_hole
from stereo_ore.transforms import inverse, transform_points
from stereo_ore.types import F32, F64, I32, Mask

TOUCH = 0.012
"""Lumps closer than this share of the smaller one's size touch."""


@dataclass(frozen=True)
class LumpTruth:
    """A lump: centre of mass in the world and in the recorded left camera [m], and what the left
    image shows of it.
    """

    id: int
    shape: str
    ore: str
    volume_m3: float
    com_world: F64
    com_left: F64
    com_rectified: F64
    visible_pixels: int
    visible_pixels_rectified: int
    unoccluded_pixels: int
    cut: bool
    bbox_xyxy: tuple[int, int, int, int] | None
    depth_range: tuple[float, float] | None
    box_dims: F64
    max_calliper: float
    min_calliper: float
    oversize: bool
    touches: tuple[int, ...]

    @property
    def visible_fraction(self) -> float:
        """Share of the pixels it would cover alone that show it."""
        return self.visible_pixels / max(self.unoccluded_pixels, 1)


def lump_truths(
    spec: SceneSpec,
    model: Model,
    left: Eye,
    straight: Eye,
    depth: F32,
    instance: I32,
    instance_rectified: I32,
) -> tuple[LumpTruth, ...]:
    """The truth of every lump; depth and instance (H, W) are those of the recorded left image."""
    touches = _touches(model.lumps)
    found = []
    for k, lump in enumerate(model.lumps):
        id_ = FIRST_LUMP + k
        volume, centre = volume_and_centre(lump.mesh)
        dims, longest, shortest = callipers(_coarser(lump.mesh))
        seen = instance == id_
        found.append(
            LumpTruth(
                id_,
                lump.shape,
                lump.ore,
                volume,
                transform_points(spec.T_world_screen, centre),
                transform_points(inverse(left.T_screen_eye), centre),
                transform_points(inverse(straight.T_screen_eye), centre),
                int(seen.sum()),
                int((instance_rectified == id_).sum()),
                _unoccluded(lump.mesh, left),
                _at_border(seen),
                _bounds(seen),
                (float(depth[seen].min()), float(depth[seen].max())) if seen.any() else None,
                dims,
                longest,
                shortest,
                over_hole(dims, spec.screen.openings) > 1,
                tuple(FIRST_LUMP + j for j in touches[k]),
            )
        )
    return tuple(found)


def _coarser(mesh: Mesh) -> Mesh:
    """The mesh of a rock two subdivisions up: its first vertices."""
    sphere = icosphere(4)
    return Mesh(mesh.vertices[: len(sphere.vertices)], sphere.triangles)


def _unoccluded(mesh: Mesh, eye: Eye) -> int:
    """Pixels the body would cover alone."""
    xyz = transform_points(inverse(eye.T_screen_eye), mesh.vertices)
    xyz = xyz[xyz[:, 2] > 0.01]
    if not len(xyz):
        return 0
    distortion = np.array(eye.camera.distortion) if eye.camera.distortion else None
    uv = cv2.projectPoints(xyz, np.zeros(3), np.zeros(3), eye.camera.K, distortion)[0].reshape(
        -1, 2
    )
    low = np.maximum(np.floor(uv.min(0)), 0).astype(int)
    high = np.minimum(np.ceil(uv.max(0)) + 1, eye.size).astype(int)
    rows, columns = range(low[1], max(high[1], low[1])), range(low[0], max(high[0], low[0]))
    if not rows or not columns:
        return 0
    return int(np.isfinite(cast(ray_caster(mesh), eye.rays(rows, columns))["t_hit"]).sum())


def _at_border(seen: Mask) -> bool:
    return bool(seen[0].any() or seen[-1].any() or seen[:, 0].any() or seen[:, -1].any())


def _bounds(seen: Mask) -> tuple[int, int, int, int] | None:
    v, u = np.nonzero(seen)
    return (int(u.min()), int(v.min()), int(u.max()), int(v.max())) if len(u) else None


def _touches(lumps: Sequence[Lump]) -> list[list[int]]:
    """For each lump the others whose surfaces come within `TOUCH` of its size."""
    from scipy.spatial import cKDTree

    trees = [cKDTree(lump.mesh.vertices) for lump in lumps]
    sizes = [float(np.ptp(lump.mesh.vertices, axis=0).max()) for lump in lumps]
    near: list[list[int]] = [[] for _ in lumps]
    for i in range(len(lumps)):
        for j in range(i):
            limit = TOUCH * min(sizes[i], sizes[j])
            limit += 0.02 * max(
                sizes[i], sizes[j]
            )  # vertices lie up to this far from the nearest other vertex
            if (
                np.min(trees[i].query(lumps[j].mesh.vertices, distance_upper_bound=limit)[0])
                < limit
            ):
                near[i].append(j)
                near[j].append(i)
    return [sorted(n) for n in near]
