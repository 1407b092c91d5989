"""Screens that are drawn at random for the network: heaps, fines, mud, grids, tools, or nothing."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stereo_ore.lab import synth
from stereo_ore.lab.synth import screen as grizzly
from stereo_ore.lab.synth.mesh import Mesh, box, icosphere, merge, volume_and_centre
from stereo_ore.lab.synth.model import (
    BACKGROUND,
    FIRST_LUMP,
    GRIZZLY,
    ORES,
    Lump,
    Model,
    Part,
    assembled,
    surroundings,
)
from stereo_ore.lab.synth.rocks import PROPORTIONS, random_rotation, rock, roughness
from stereo_ore.lab.synth.spec import SceneSpec
from stereo_ore.lab.training.ore.tumble import TumbledBox, tumble
from stereo_ore.types import F64

EMPTY, _GRID, MUD, FINES, _TOOL, POST, ONE_COLOUR, DENTED = 0.1, 0.2, 0.25, 0.3, 0.2, 0.1, 0.2, 0.4
"""Shares of screens without lumps, of square grids, with mud, fines, a hammer, a post, all in one
colour; and of lumps with saddles."""
_SMALLEST, _LARGEST = 0.35, 3.2
"""Longest dimensions of lumps [openings]."""
STONES = 250
"""Of the rubble below."""
VIEWS = 2
"""Cameras a heap is seen by, at each of its stages."""


@dataclass(frozen=True)
class Pile:
    """A screen with what lies on it, and the specifications of the views of it."""

    model: Model
    views: tuple[SceneSpec, ...]


def piles(seed: int) -> Iterator[Pile]:
    """The heap of a seed as it grows: after a third of its lumps, and after all of them."""
    rng = np.random.default_rng([seed, 40])
    family = ("large", "large", "paper", "hard")[seed % 4]
    specs = [_view(seed * 16 + k, family, rng) for k in range(2 * VIEWS)]
    screen = replace(specs[0].screen, ties=int(rng.integers(1, 4)))
    specs = [replace(spec, screen=screen, tilt=specs[0].tilt) for spec in specs]
    others, solid = _furniture(specs[0], rng)
    meshes, ores = _lumps(screen.opening, rng)
    if not meshes:
        yield Pile(_model(specs[0], [], others, rng), tuple(specs[:VIEWS]))
        return
    half = np.array(screen.size) / 2
    spread = tuple(float(s) for s in half * rng.uniform(0.25, 0.65, 2))
    stops = [max(3, len(meshes) // 3), len(meshes)]
    fallen = tumble(meshes, solid, (spread[0], spread[1]), rng, stops)
    for stage, poses in enumerate(fallen):
        lumps = [Lump(meshes[k].moved(R, t), "", ores[k], R, t) for k, (R, t) in poses.items()]
        views = specs[stage * VIEWS : (stage + 1) * VIEWS]
        yield Pile(_model(specs[0], lumps, others, rng), tuple(views))


def _view(seed: int, family: str, rng: np.random.Generator) -> SceneSpec:
    """A camera, light and sensor; the smaller image twice as often, for time."""
    size = "HD720" if rng.random() < 0.6 else "VGA"
    return replace(synth.sample_spec(seed, family, size), supersampling=1, raw=False)


def _lumps(opening: float, rng: np.random.Generator) -> tuple[list[Mesh], list[str]]:
    """Lumps from small to large over a decade, the larger ones first more often than not."""
    count = 0 if rng.random() < EMPTY else int(np.exp(rng.uniform(np.log(10), np.log(85))))
    low, high = sorted(np.exp(rng.uniform(np.log(_SMALLEST), np.log(_LARGEST), 2)))
    low, high = max(low, 0.75) if rng.random() < 0.6 else min(low, 0.8), max(high, 1.4)
    sizes = opening * np.exp(rng.uniform(np.log(low), np.log(high), count))
    order = np.argsort(-sizes * np.exp(rng.normal(0, 0.5, count)))
    kinds = rng.choice(list(ORES), 1 if rng.random() < 0.4 else 2, replace=False)
    angular = rng.random() < 0.6
    meshes = [broken_rock(float(sizes[k]), angular, DENTED, rng) for k in order]
    return meshes, [str(ore) for ore in rng.choice(kinds, count)]


def broken_rock(longest: float, angular: bool, dented: float, rng: np.random.Generator) -> Mesh:
    """A rock of any kind, its centre of mass in the origin, with saddles by the share `dented`."""
    mesh = rock(rng, str(rng.choice(list(PROPORTIONS))), longest, 4, angular)
    if rng.random() >= dented:
        return mesh
    away = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    for _ in range(rng.integers(1, 4)):
        axis = rng.normal(size=3)
        near = away @ (axis / np.linalg.norm(axis))
        depth = rng.uniform(-0.3, 0.25)
        mesh = Mesh(mesh.vertices * (1 + depth * np.exp(5 * (near - 1)))[:, None], mesh.triangles)
    return Mesh(mesh.vertices - volume_and_centre(mesh)[1], mesh.triangles)


def _furniture(spec: SceneSpec, rng: np.random.Generator) -> tuple[list[Part], list[TumbledBox]]:
    """What else is on a screen, none of it ore; and what of it lumps come to rest on."""
    screen, parts = spec.screen, []
    half, width = np.array(screen.size) / 2, screen.bar_width / 2
    bars = [((x - width, -half[1]), (x + width, half[1])) for x in screen.bar_centres]
    if rng.random() < _GRID:
        pitch = screen.bar_width + screen.opening * rng.uniform(0.9, 2.5)
        across = np.arange(-half[1] + pitch / 2, half[1], pitch)
        level = -rng.uniform(0, 0.02) * screen.opening
        low_high = [((-half[0], y - width), (half[0], y + width)) for y in across]
        mesh = merge([_bar(*b, screen.bar_depth, level, screen.cell) for b in low_high])
        parts.append(_part(mesh, "steel", GRIZZLY))
        bars += low_high
    solid = [(np.array([*a, -screen.bar_depth]), np.array([*b, 0.0])) for a, b in bars]
    solid += [
        (np.array([*a, -screen.bar_depth]), np.array([*b, screen.rise]))
        for a, b in beams(half, screen.frame_width)
    ]
    if rng.random() < MUD:
        mud, level = _mud(screen.opening, half, rng)
        parts.append(_part(mud, str(rng.choice(["earth", "rubble"])), BACKGROUND))
        low = np.array([*mud.vertices[:, :2].min(0), level - 0.3])
        solid.append((low, np.array([*mud.vertices[:, :2].max(0), level])))
    if rng.random() < FINES:
        parts.append(_part(_fines(screen, half, rng), "rubble", BACKGROUND))
    if rng.random() < _TOOL:
        parts.append(_part(_hammer(screen.opening, half, rng), "steel", BACKGROUND))
    if rng.random() < POST:
        at = rng.uniform(-1, 1, 2) * half
        at[int(rng.integers(2))] *= 1.05 / max(float(np.abs(at / half).max()), 0.1)
        side = screen.opening * rng.uniform(0.3, 1.2, 2)
        high = screen.opening * rng.uniform(1, 4)
        mesh = box((*(at - side / 2), -0.2), (*(at + side / 2), high), screen.cell)
        parts.append(_part(mesh, str(rng.choice(["steel", "rust", "concrete"])), BACKGROUND))
    return parts, solid


def _bar(
    low: tuple[float, float], high: tuple[float, float], depth: float, top: float, cell: float
) -> Mesh:
    return box((*low, -depth), (*high, top), cell)


def beams(half: F64, width: float) -> list[tuple[tuple[float, float], tuple[float, float]]]:
    """The frame's four beams in plan."""
    x, y = float(half[0]), float(half[1])
    return [
        ((-x - width, -y - width), (-x, y + width)),
        ((x, -y - width), (x + width, y + width)),
        ((-x, y), (x, y + width)),
        ((-x, -y - width), (x, -y)),
    ]


def _mud(opening: float, half: F64, rng: np.random.Generator) -> tuple[Mesh, float]:
    """A rough sheet over part of the screen that closes its gaps, and its mean height [m]."""
    cells, level = 60, opening * rng.uniform(-0.4, 0.08)
    size = half * rng.uniform(0.3, 0.9, 2)
    middle = rng.uniform(-1, 1, 2) * (half - size)
    x, y = np.meshgrid(*[np.linspace(-1, 1, cells)] * 2, indexing="ij")
    flat = np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3)
    edge = np.clip(1.3 - np.hypot(x, y).ravel() ** 4, -2, 1)
    rough = roughness(rng, flat * 2.0, 1.0) * rng.uniform(0.05, 0.25)
    z = level + opening * (rough + 0.4 * np.minimum(edge, 0))
    i, j = (a.ravel() for a in np.meshgrid(*[np.arange(cells - 1)] * 2, indexing="ij"))
    a, b, c, d = i * cells + j, (i + 1) * cells + j, (i + 1) * cells + j + 1, i * cells + j + 1
    triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    return Mesh(np.column_stack([flat[:, :2] * size + middle, z]), triangles), float(level)


def _fines(screen: grizzly.Screen, half: F64, rng: np.random.Generator) -> Mesh:
    """Grains smaller than a quarter of the opening, in patches on the bars and the frame."""
    shapes = [rock(rng, kind, 1.0, 1) for kind in ("chunk", "block", "slab")]
    middles = rng.uniform(-1, 1, (int(rng.integers(2, 6)), 2)) * half
    grains = []
    for _ in range(int(rng.integers(60, 350))):
        xy = middles[rng.integers(len(middles))] + rng.normal(0, 0.25, 2) * half
        size = screen.opening * rng.uniform(0.04, 0.22)
        k = int(np.abs(screen.bar_centres - xy[0]).argmin())
        xy[0] = screen.bar_centres[k] + rng.uniform(-0.5, 0.5) * screen.bar_width
        at = np.array([*np.clip(xy, -half, half), 0.3 * size])
        grains.append(shapes[rng.integers(len(shapes))].moved(size * random_rotation(rng), at))
    return merge(grains)


def _hammer(opening: float, half: F64, rng: np.random.Generator) -> Mesh:
    """A chisel under a box, held from above at any slant."""
    length, thick = opening * rng.uniform(1.5, 4), opening * rng.uniform(0.15, 0.4)
    chisel = icosphere(3)
    tip = Mesh(chisel.vertices * [thick / 2, thick / 2, length / 2], chisel.triangles)
    tip = tip.moved(np.eye(3), np.array([0, 0, length / 2]))
    body = box(
        (-1.6 * thick, -1.2 * thick, 0.7 * length), (1.6 * thick, 1.2 * thick, 3 * length), 0.1
    )
    tilt = rng.normal(0, 0.35, 2)
    (sa, sb), (ca, cb) = np.sin(tilt), np.cos(tilt)
    R = np.array([[cb, 0, sb], [0, 1, 0], [-sb, 0, cb]]) @ np.array(
        [[1, 0, 0], [0, ca, -sa], [0, sa, ca]]
    )
    at = np.array([*(rng.uniform(-0.8, 0.8, 2) * half), opening * rng.uniform(-0.1, 1.5)])
    return merge([tip, body]).moved(R, at)


def _part(mesh: Mesh, material: str, instance: int) -> Part:
    return Part(mesh, material, instance, np.eye(3), np.zeros(3))


def _model(
    spec: SceneSpec, lumps: Sequence[Lump], others: Sequence[Part], rng: np.random.Generator
) -> Model:
    steel = [grizzly.bars(spec.screen), grizzly.frame(spec.screen)]
    parts = [_part(merge(steel), "steel", GRIZZLY), *others]
    parts += [_part(m, name, BACKGROUND) for m, name in surroundings(spec, rng, STONES)]
    parts += [
        Part(lump.mesh, lump.ore, FIRST_LUMP + k, lump.R, rng.uniform(0, 5, 3))
        for k, lump in enumerate(lumps)
    ]
    if rng.random() < ONE_COLOUR:
        dust = str(rng.choice(["earth", "rubble", "concrete"]))
        parts = [replace(part, material=dust) for part in parts]
    return assembled(parts, lumps, rng, reach=2.0 * max(spec.screen.size))
