"""The scene as one triangle mesh whose triangles know their part: material, instance, texture
frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereo_ore.lab.synth import screen as grizzly
from stereo_ore.lab.synth.foreign import TOOL, foreign_body
from stereo_ore.lab.synth.mesh import Mesh, RayCaster, blocked, merge, ray_caster, rectangle
from stereo_ore.lab.synth.placing import HeightField, pile
from stereo_ore.lab.synth.rocks import PROPORTIONS, rock, roughness
from stereo_ore.lab.synth.spec import SceneSpec
from stereo_ore.transforms import inverse
from stereo_ore.types import F32, F64, I32

BACKGROUND, GRIZZLY, FIRST_LUMP = 0, 1, 2
ORES = {
    "granite": ((0.42, 0.40, 0.38), 0.30, 1.0),
    "gneiss": ((0.40, 0.40, 0.40), 0.28, 3.0),
    "limestone": ((0.50, 0.50, 0.44), 0.22, 1.0),
    "basalt": ((0.17, 0.17, 0.18), 0.34, 1.0),
    "sulphide": ((0.36, 0.32, 0.20), 0.40, 1.5),
    "quartz_vein": ((0.46, 0.42, 0.40), 0.30, 1.3),
}
"""Mean albedo, its contrast, and how much longer its pattern is along the bedding."""


@dataclass(frozen=True)
class Part:
    """A body of one material; texture coordinates of a point p are p·R + offset."""

    mesh: Mesh
    material: str
    instance: int
    R: F64
    offset: F64


@dataclass(frozen=True)
class Lump:
    """A lump as made: its mesh at rest in the screen frame, kind, rock and texture pose."""

    mesh: Mesh
    shape: str
    ore: str
    R: F64
    t: F64


@dataclass(frozen=True)
class Model:
    """All parts merged, in the screen frame, with a ray caster and the open sky seen from each
    vertex (V,) 0…1.
    """

    parts: tuple[Part, ...]
    lumps: tuple[Lump, ...]
    vertices: F32
    triangles: I32
    part_of: I32
    sky_share: F32
    caster: RayCaster


def build_model(spec: SceneSpec) -> Model:
    """The geometry of a scene; equal specs give equal models."""
    rng = np.random.default_rng([spec.seed, 10])
    steel = [grizzly.bars(spec.screen), grizzly.frame(spec.screen)]
    lumps = _lumps(spec, merge(steel), rng)
    if spec.table:
        steel.append(grizzly.legs(spec.screen))
    parts = [_part(merge(steel), "steel", GRIZZLY)]
    parts += [_part(mesh, material, BACKGROUND) for mesh, material in surroundings(spec, rng)]
    for k, lump in enumerate(lumps):
        parts.append(Part(lump.mesh, lump.ore, FIRST_LUMP + k, lump.R, rng.uniform(0, 5, 3)))
    parts += _foreign(spec)
    return assembled(parts, lumps, rng, reach=2.0 * max(spec.screen.size))


def assembled(
    parts: Sequence[Part], lumps: Sequence[Lump], rng: np.random.Generator, reach: float
) -> Model:
    """The model of parts, lumps among them; the sky is looked for within `reach` [m]."""
    whole = merge([p.mesh for p in parts])
    part_of = np.repeat(
        np.arange(len(parts), dtype=np.int32), [len(p.mesh.triangles) for p in parts]
    )
    caster = ray_caster(whole)
    sky = _sky_share(whole, caster, rng, reach)
    return Model(
        tuple(parts),
        tuple(lumps),
        whole.vertices.astype(np.float32),
        whole.triangles,
        part_of,
        sky,
        caster,
    )


def _part(mesh: Mesh, material: str, instance: int) -> Part:
    return Part(mesh, material, instance, np.eye(3), np.zeros(3))


def _foreign(spec: SceneSpec) -> list[Part]:
    """Foreign bodies; they have numbers of their own, so that the rest is as without them."""
    eye = (inverse(spec.T_world_screen) @ spec.camera.T_world_left)[:3, 3]
    rng = np.random.default_rng([spec.seed, 30])
    return [
        _part(foreign_body(kind, spec.screen, eye, rng), "steel", TOOL) for kind in spec.foreign
    ]


def _lumps(spec: SceneSpec, steel: Mesh, rng: np.random.Generator) -> list[Lump]:
    """Lumps at rest, largest first; most of one or two kinds of rock."""
    low, high = spec.lump_size
    sizes = np.sort(low + (high - low) * rng.beta(1.1, 1.9, spec.lumps))[::-1]
    shapes = [str(s) for s in rng.choice(list(PROPORTIONS), spec.lumps)]
    kinds = [str(s) for s in rng.choice(list(ORES), 2, replace=False)]
    ores = [str(s) for s in rng.choice(kinds, spec.lumps, p=[0.65, 0.35])]
    meshes = [
        rock(rng, shape, size, angular=spec.angular)
        for shape, size in zip(shapes, sizes, strict=True)
    ]
    half, beam = np.array(spec.screen.size) / 2, spec.screen.frame_width
    field = HeightField.over((half[0] + beam, half[1] + beam), 0.1 * spec.screen.bar_width)
    field.add(steel)
    spread = (float(0.64 * half[0]), float(0.64 * half[1]))
    poses = pile(meshes, field, spread, rng, sink_m=-0.3 * spec.screen.opening)
    return [Lump(meshes[k].moved(R, t), shapes[k], ores[k], R, t) for k, R, t in poses]


def surroundings(
    spec: SceneSpec, rng: np.random.Generator, stones: int | None = None
) -> list[tuple[Mesh, str]]:
    """Floor, walls of the hall, pit and rubble of so many stones."""
    screen, reach = spec.screen, 3.2 * max(spec.screen.size)
    stone = (0.035 if spec.table else 0.16) * rng.uniform(0.8, 1.2)
    rubble = grizzly.rubble(
        screen,
        rng,
        stone,
        stones or (500 if spec.table else 700),
        heap=0.12 if spec.table else 0.35,
    )
    corners = np.array([(-1.0, -1), (-1, 1), (1, 1), (1, -1)]) * reach
    low, up = -screen.pit_depth - 0.1, np.array([0, 0, reach])
    walls = [
        rectangle(np.array([*a, low]), np.array([*(b - a), 0.0]), up, reach / 10)
        for a, b in zip(corners, np.roll(corners, -1, 0), strict=True)
    ]
    if spec.table:
        floor = [
            rectangle(
                np.array([-reach, -reach, -screen.pit_depth]),
                np.array([2 * reach, 0, 0]),
                np.array([0, 2 * reach, 0]),
                0.1,
            )
        ]
        return [(merge(floor + walls), "concrete"), (rubble, "rubble")]
    ground = grizzly.ground(screen, 0.005, reach)
    sunk = 0.012 * (roughness(rng, ground.vertices * 1.5, 1.0) - 1)
    ground = Mesh(ground.vertices + np.array([0, 0, 1.0]) * sunk[:, None], ground.triangles)
    return [(merge([ground, *walls]), "earth"), (grizzly.pit(screen), "rust"), (rubble, "rubble")]


def _sky_share(
    mesh: Mesh, caster: RayCaster, rng: np.random.Generator, reach: float, rays: int = 16
) -> F32:
    """Cosine-weighted share of unblocked directions above each vertex, within `reach`."""
    normals = vertex_normals(mesh)
    directions = rng.normal(size=(rays, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    lit = np.zeros(len(normals), np.float32)
    start = mesh.vertices + normals * 2e-3
    for d in directions:
        towards = normals + 0.999 * d
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        lit += ~blocked(caster, np.concatenate([start, towards], 1), reach)
    return lit / np.float32(rays)


def vertex_normals(mesh: Mesh) -> F64:
    """Unit normals (V, 3): the area-weighted mean over a vertex's triangles."""
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    face, total = np.cross(b - a, c - a), np.zeros_like(mesh.vertices)
    for axis in range(3):
        for corner in range(3):
            total[:, axis] += np.bincount(mesh.triangles[:, corner], face[:, axis], len(total))
    return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12))
