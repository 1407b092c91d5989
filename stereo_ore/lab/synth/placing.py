"""Laying lumps on the screen: each falls until it touches, then rolls downhill until its centre
can't sink further.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereo_ore.lab.synth.mesh import Mesh, cast, icosphere, ray_caster
from stereo_ore.lab.synth.rocks import random_rotation
from stereo_ore.types import F64, I32

_ROUNDS, PROPOSALS = 30, 12


@dataclass
class HeightField:
    """Height [m] of what lies highest above each cell of a grid in the screen's plane; −1 where
    nothing does.
    """

    x0: float
    y0: float
    cell: float
    heights: F64

    @classmethod
    def over(cls, half_size: tuple[float, float], cell: float) -> HeightField:
        """An empty field over |x| ≤ half_size[0], |y| ≤ half_size[1]."""
        nx, ny = (int(np.ceil(2 * h / cell)) + 1 for h in half_size)
        return cls(-half_size[0], -half_size[1], cell, np.full((nx, ny), -1.0))

    def at(self, xy: F64) -> F64:
        """Height at (..., 2) points; outside the field the bars' level."""
        i = np.rint((xy[..., 0] - self.x0) / self.cell).astype(int)
        j = np.rint((xy[..., 1] - self.y0) / self.cell).astype(int)
        inside = (i >= 0) & (i < self.heights.shape[0]) & (j >= 0) & (j < self.heights.shape[1])
        clipped = i.clip(0, self.heights.shape[0] - 1), j.clip(0, self.heights.shape[1] - 1)
        return np.where(inside, self.heights[clipped], 0.0)

    def add(self, mesh: Mesh) -> None:
        """Raise the field to the top of a mesh, seen by rays from above."""
        low, high = mesh.vertices.min(0), mesh.vertices.max(0)
        i = self._cells(low[0], high[0], self.x0, self.heights.shape[0])
        j = self._cells(low[1], high[1], self.y0, self.heights.shape[1])
        if not len(i) or not len(j):
            return
        x, y = np.meshgrid(self.x0 + i * self.cell, self.y0 + j * self.cell, indexing="ij")
        top = float(high[2]) + 0.01
        down = np.broadcast_to([0.0, 0.0, -1.0], (*x.shape, 3))
        rays = np.concatenate([np.stack([x, y, np.full_like(x, top)], -1), down], -1).astype(
            np.float32
        )
        height = top - cast(ray_caster(mesh), rays)["t_hit"]
        patch = np.ix_(i, j)
        self.heights[patch] = np.maximum(
            self.heights[patch], np.where(np.isfinite(height), height, -1.0)
        )

    def _cells(self, low: float, high: float, start: float, count: int) -> I32:
        first, last = np.floor((low - start) / self.cell), np.ceil((high - start) / self.cell)
        return np.asarray(np.arange(max(0, first), min(count - 1, last) + 1), np.int32)


def drop(points: F64, field: HeightField) -> F64:
    """How far down (...,) each body of (..., V, 3) points may move until one point touches the
    field [m].
    """
    return np.asarray((points[..., 2] - field.at(points[..., :2])).min(-1))


def settle(
    mesh: Mesh, field: HeightField, R: F64, xy: F64, rng: np.random.Generator
) -> tuple[F64, F64]:
    """Rotation and position (3,) of a body, centre of mass in its origin, that came to rest on the
    field.

    Potential energy is the height of the centre; a body rests where no small turn or shift lowers
    it. Proposals shrink from 12° and 6 % of the size to a tenth of that, and lower ones are taken.
    """
    coarse = mesh.vertices[: len(icosphere(3).vertices)]
    size = float(np.linalg.norm(np.ptp(coarse, axis=0)))
    z = -float(drop(_placed(coarse, R[None], xy[None]), field)[0])
    for step in range(_ROUNDS):
        scale = 0.1 ** (step / (_ROUNDS - 1))
        turns = _small_rotations(rng, np.radians(12) * scale, PROPOSALS) @ R
        places = xy + rng.normal(0, 0.06 * size * scale / 2, (PROPOSALS, 2))
        heights = -drop(_placed(coarse, turns, places), field)
        best = int(heights.argmin())
        if heights[best] < z:
            R, xy, z = turns[best], places[best], float(heights[best])
    z = -float(drop(_placed(mesh.vertices, R[None], xy[None]), field)[0])
    return R, np.array([*xy, z])


def _placed(points: F64, turns: F64, places: F64) -> F64:
    placed: F64 = np.einsum("nij,vj->nvi", turns, points)
    placed[..., :2] += places[:, None]
    return placed


def _small_rotations(rng: np.random.Generator, angle: float, count: int) -> F64:
    """Rotations (count, 3, 3) about random axes by normally distributed angles (Rodrigues'
    formula).
    """
    axis = rng.normal(size=(count, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    a = rng.normal(0, angle, count)[:, None, None]
    K = np.zeros((count, 3, 3))
    K[:, [0, 1, 2], [1, 2, 0]], K[:, [1, 2, 0], [0, 1, 2]] = -axis[:, [2, 0, 1]], axis[:, [2, 0, 1]]
    return np.eye(3) + np.sin(a) * K + (1 - np.cos(a)) * (K @ K)


def supported(mesh: Mesh, field: HeightField, R: F64, t: F64) -> bool:
    """Whether the centre of mass lies over the hull of the points that touch the field, within 3 %
    of the size.

    The hull is tested by its reach in 16 directions from the centre.
    """
    points = mesh.vertices @ R.T + t
    size = float(np.ptp(points, axis=0).max())
    gap = points[:, 2] - field.at(points[:, :2])
    angle = np.arange(16) * np.pi / 8
    reach = (points[gap < 0.03 * size, :2] - t[:2]) @ np.stack([np.cos(angle), np.sin(angle)])
    return bool((reach.max(0, initial=-np.inf) > -0.03 * size).all())


def pile(
    meshes: Sequence[Mesh],
    field: HeightField,
    spread: tuple[float, float],
    rng: np.random.Generator,
    sink_m: float,
) -> list[tuple[int, F64, F64]]:
    """Index and rest pose (R, t) of meshes laid one after another within |x|, |y| ≤ spread; the
    field grows with them.

    A body that rolls off the screen, falls between the bars (its centre lower than `sink_m` above
    them) or finds no support is dropped again; one that does so six times is left out.
    """
    poses = []
    for index, mesh in enumerate(meshes):
        for _ in range(6):
            R, t = _come_to_rest(
                mesh, field, _flat_rotation(rng), _spot(mesh, field, spread, rng), rng
            )
            inside = bool((np.abs(t[:2]) <= np.array(spread)).all())
            if inside and t[2] > sink_m and supported(mesh, field, R, t):
                field.add(mesh.moved(R, t))
                poses.append((index, R, t))
                break
    return poses


def _come_to_rest(
    mesh: Mesh, field: HeightField, R: F64, xy: F64, rng: np.random.Generator
) -> tuple[F64, F64]:
    """Settle, and settle on from there, up to four times, while the body finds no support."""
    for _ in range(4):
        R, t = settle(mesh, field, R, xy, rng)
        xy = t[:2]
        if supported(mesh, field, R, t):
            break
    return R, t


def _spot(
    mesh: Mesh, field: HeightField, spread: tuple[float, float], rng: np.random.Generator
) -> F64:
    """Where to drop a body: two of three on the emptiest of some random places, the rest
    anywhere.
    """
    places = rng.uniform(-1, 1, (12, 2)) * np.array(spread)
    if rng.random() < 1 / 3:
        return np.asarray(places[0])
    radius = 0.4 * float(np.ptp(mesh.vertices, axis=0).max())
    angle = np.arange(8) * np.pi / 4
    ring = places[:, None] + radius * np.stack([np.cos(angle), np.sin(angle)], -1)
    return np.asarray(places[field.at(ring).clip(0).mean(1).argmin()])


def _flat_rotation(rng: np.random.Generator) -> F64:
    """A rotation as lumps land: two of three lie down, any way round and tilted a little, the rest
    as they come.
    """
    if rng.random() < 1 / 3:
        return random_rotation(rng)
    a = rng.uniform(0, 2 * np.pi)
    turn = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    return np.asarray(turn @ _small_rotations(rng, 0.25, 1)[0])
