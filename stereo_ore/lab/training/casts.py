"""Made-up lumps at rest, seen by rays alone: depth as a matcher errs, outlines as a network does.

Without pictures a screen takes seconds, and shapes are what an unseen side is learned from.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from stereo_ore.lab import evaluate, synth
from stereo_ore.lab.synth import screen as grizzly
from stereo_ore.lab.synth.eye import Eye
from stereo_ore.lab.synth.mesh import (
    Mesh,
    RayCaster,
    callipers,
    cast,
    merge,
    ray_caster,
    rectangle,
    volume_and_centre,
)
from stereo_ore.lab.synth.model import FIRST_LUMP, GRIZZLY
from stereo_ore.lab.synth.rig import eyes, ideal_rig, reference_rectification
from stereo_ore.lab.synth.spec import SceneSpec
from stereo_ore.lab.training.ore.piles import beams, broken_rock
from stereo_ore.lab.training.ore.tumble import Pose, TumbledBox, tumble
from stereo_ore.lab.training.solids import (
    TRUE_SIGMA_PX,
    Appearance,
    KnownBody,
    KnownLumps,
    SolidSample,
    seen,
    surface_of,
)
from stereo_ore.planes import crop_rig
from stereo_ore.transforms import inverse
from stereo_ore.types import F32, F64, I16, I32, Bars, Grizzly, OreMap, Plane, Rig

FIRST_SEED, _SPECS = 400, 8
"""Of the screens made for training, and how many cameras are drawn for each: specifications from
3200 on, which nothing else uses."""
_VIEWS = 3
"""Cameras a heap is seen by, at each of its stages."""
_GRID, _HEAP, _ANGULAR, _DENTED = 0.15, 0.45, 0.93, 0.15
"""Shares of grids and heaps among screens, of angular rocks, as crushed rock is, and of dented
ones."""
_NOISE = ((0.11, 3.0), (0.05, 0.0), (0.05, 0.35))
"""Disparity noise [px], and its grain: in pixels, none, and in openings."""
_EDGE_STEP, _EDGE_PX = 1.5, 7
"""Step of disparity [px] beside which a matcher's window sees two surfaces, and the window's
side."""
_WARP = ((0.027, 0.25), (0.018, 0.1))
"""How far outlines are off, and the grain of that [openings]."""
_LEAST_PIXELS, _LOST = 250, 0.03
"""Smaller lumps are not found, nor is this share of those that need not be."""
_LOWEST_M = -0.15
"""What lies deeper below the bars is outside the working volume."""


@dataclass(frozen=True)
class _Heap:
    """Lumps at rest as made, with poses, volumes, centres of mass and dimensions."""

    meshes: Sequence[Mesh]
    poses: Sequence[Pose]
    volumes: Sequence[float]
    centres: Sequence[F64]
    dimensions: Sequence[F64]


def made_up(seed: int) -> Iterator[SolidSample]:
    """The lumps of the screens of a seed, as they are and as they would be measured."""
    rng = np.random.default_rng([seed, 50])
    family = ("large", "large", "paper", "hard")[seed % 4]
    specs = [
        synth.sample_spec(_SPECS * seed + k, family, str(size))
        for k, size in enumerate(
            rng.choice(["HD720", "VGA", "HD1080"], _SPECS, p=[0.55, 0.35, 0.1])
        )
    ]
    screen = specs[0].screen
    if rng.random() < _GRID:
        screen = replace(screen, cross_opening=screen.opening * rng.uniform(1, 1.6), ties=0)
    specs = [replace(each, screen=screen, tilt=specs[0].tilt, raw=False) for each in specs]
    reach = 3 * max(screen.size)
    corner = np.array([-reach, -reach, -screen.pit_depth * rng.uniform(0.5, 1)])
    floor = rectangle(corner, reach * np.array([2, 0, 0]), reach * np.array([0, 2, 0]), reach / 4)
    steel = merge([grizzly.bars(screen), grizzly.frame(screen)])
    for stage, heap in enumerate(_heaps(specs[0], rng)):
        whole = [m.moved(*pose) for m, pose in zip(heap.meshes, heap.poses, strict=True)]
        parts = [steel, floor, *whole]
        labels = [GRIZZLY, 0, *range(FIRST_LUMP, FIRST_LUMP + len(whole))]
        of_triangle = np.repeat(labels, [len(part.triangles) for part in parts])
        caster = ray_caster(merge(parts))
        for spec in specs[stage * _VIEWS : (stage + 1) * _VIEWS]:
            yield from _view(spec, heap, caster, of_triangle, rng)


def _heaps(spec: SceneSpec, rng: np.random.Generator) -> Iterator[_Heap]:
    """A screen's lumps as they come to rest, after a third of them and after all."""
    meshes = [
        broken_rock(float(size), rng.random() < _ANGULAR, _DENTED, rng)
        for size in rng.permutation(_sizes(spec, rng))
    ]
    masses = [volume_and_centre(mesh) for mesh in meshes]
    boxes = [callipers(mesh) for mesh in meshes]
    dimensions = [np.array([longest, *box[1:]]) for box, longest, _ in boxes]
    spread = np.array(spec.screen.size) / 2 * rng.uniform(0.3, 0.64, 2)
    stops = sorted({max(3, len(meshes) // 3), len(meshes)})
    for poses in tumble(meshes, _boxes(spec.screen), (spread[0], spread[1]), rng, stops):
        yield _Heap(
            [meshes[k] for k in poses],
            list(poses.values()),
            [masses[k][0] for k in poses],
            [masses[k][1] for k in poses],
            [dimensions[k] for k in poses],
        )


def _sizes(spec: SceneSpec, rng: np.random.Generator) -> F64:
    """Longest dimensions [m] of a few lumps as screens have them, or of a heap."""
    if rng.random() >= _HEAP:
        low, high = spec.lump_size
        return np.asarray(low + (high - low) * rng.beta(1.1, 1.9, int(rng.integers(4, 14))))
    count = int(np.exp(rng.uniform(np.log(10), np.log(45))))
    low, high = np.sort(rng.uniform(np.log(0.5), np.log(3.0), 2))
    return spec.screen.opening * np.exp(rng.uniform(low, max(high, np.log(1.4)), count))


def _boxes(screen: grizzly.Screen) -> list[TumbledBox]:
    """What of a screen lumps come to rest on."""
    (x, y), w, deep = np.array(screen.size) / 2, screen.bar_width / 2, -screen.bar_depth
    bars = [((at - w, -y), (at + w, y), 0.0) for at in screen.bar_centres]
    bars += [((-x, at - w), (x, at + w), 0.0) for at in screen.cross_centres]
    bars += [(*beam, screen.rise) for beam in beams(np.array([x, y]), screen.frame_width)]
    return [(np.array([*low, deep]), np.array([*high, top])) for low, high, top in bars]


def _view(
    spec: SceneSpec, heap: _Heap, caster: RayCaster, of_triangle: I32, rng: np.random.Generator
) -> Iterator[SolidSample]:
    """What a camera sees of a heap, twice."""
    calibration = ideal_rig(spec)
    rectified = reference_rectification(calibration)
    T_screen_left = inverse(spec.T_world_screen) @ spec.camera.T_world_left
    eye = eyes(calibration, rectified, T_screen_left)[2]
    hit = cast(caster, eye.rays(range(eye.size[1])))
    known = np.isfinite(hit["t_hit"])
    instance = np.where(known, of_triangle[np.where(known, hit["primitive_ids"], 0)], 0)
    bodies = tuple(_bodies(heap, eye, instance))
    if not bodies:
        return
    rows, columns = _around(instance)
    truth = KnownLumps(f"made {spec.seed // _SPECS}", instance[rows, columns], bodies)
    K = rectified.K
    baseline = rectified.focal_baseline / K[0, 0]
    whole = Rig(*eye.size, K[0, 0], K[1, 1], K[0, 2], K[1, 2], baseline)
    rig = crop_rig(whole, columns.start, rows.start)
    screen = _screen(spec, eye)
    depth = np.where(known, hit["t_hit"], np.nan)[rows, columns]
    opening_px = rig.fx * spec.screen.opening / spec.camera.distance
    measured, outlines = _measured(rig, depth, opening_px, rng), _drawn(truth, opening_px, rng)
    looks: tuple[tuple[Appearance, F32, I16], ...] = (
        ("true", depth, truth.outlines),
        ("measured", measured, outlines),
    )
    for seen_as, z, labels in looks:
        surface = surface_of(z, 0, 0, rig, TRUE_SIGMA_PX)
        low = surface.xyz @ screen.plane.normal - screen.plane.offset < _LOWEST_M
        surface.xyz[low] = np.nan
        yield from seen(truth, seen_as, surface, OreMap(labels), screen)


def _bodies(heap: _Heap, eye: Eye, instance: I32) -> Iterator[KnownBody]:
    """Lumps that must be found; the hull of its vertices stands for a lump that nothing hides."""
    T = inverse(eye.T_screen_eye)
    f, c = np.array(eye.camera.focal_px), np.array(eye.camera.principal_point_px)
    for k, (mesh, (R, t)) in enumerate(zip(heap.meshes, heap.poses, strict=True)):
        lump = instance == FIRST_LUMP + k
        xyz = (mesh.vertices[::7] @ R.T + t) @ T[:3, :3].T + T[:3, 3]
        uv = xyz[:, :2] / xyz[:, 2:] * f + c
        alone = cv2.contourArea(cv2.convexHull(uv.astype(np.float32)))
        cut = bool(np.concatenate([lump[[0, -1]].ravel(), lump[:, [0, -1]].ravel()]).any())
        if evaluate.must_be_found(int(lump.sum()), float(lump.sum()) / max(alone, 1.0), cut):
            centre = T[:3, :3] @ (R @ heap.centres[k] + t) + T[:3, 3]
            yield KnownBody(FIRST_LUMP + k, heap.volumes[k], centre, heap.dimensions[k])


def _around(instance: I32) -> tuple[slice, slice]:
    """Rows and columns of the lumps and what lies around them."""
    v, u = np.nonzero(instance >= FIRST_LUMP)
    rows, columns = (slice(max(int(a.min()) - 30, 0), int(a.max()) + 31) for a in (v, u))
    return rows, columns


def _screen(spec: SceneSpec, eye: Eye) -> Grizzly:
    """The screen as the program finds it."""
    T, made = inverse(eye.T_screen_eye), spec.screen
    across, along, normal = T[:3, :3].T
    plane = Plane(normal, float(normal @ T[:3, 3]))
    phase = float(made.bar_centres[0] + across @ T[:3, 3])
    bars = Bars(along, across, made.opening + made.bar_width, phase, made.bar_width)
    return Grizzly(
        plane, "site", bars=bars, opening_m=made.opening, cross_opening_m=made.cross_opening
    )


def _measured(rig: Rig, depth: F32, opening_px: float, rng: np.random.Generator) -> F32:
    """Depth (h, w) as a matcher has it: noise of several grains, and holes beside steps."""
    disparity = rig.fx * rig.baseline_m / depth
    level = rng.uniform(0.4, 1.6)
    for sigma, grain in _NOISE:
        cells = grain * opening_px if grain < 1 else grain
        disparity = disparity + level * sigma * _noise(depth.shape, cells, rng)
    near = np.nan_to_num(rig.fx * rig.baseline_m / depth).astype(np.float32)
    step = cv2.morphologyEx(near, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > _EDGE_STEP
    beside = cv2.dilate(step.astype(np.uint8), np.ones((_EDGE_PX, _EDGE_PX), np.uint8)) > 0
    disparity[beside & (_noise(depth.shape, 4.0, rng) > 0.2)] = np.nan
    return np.asarray(rig.fx * rig.baseline_m / disparity, np.float32)


def _drawn(truth: KnownLumps, opening_px: float, rng: np.random.Generator) -> I16:
    """Labels (h, w) of lumps with outlines that are a little off."""
    shape, level = truth.instance.shape, rng.uniform(0.4, 1.6)
    u, v = (a.astype(np.float32) for a in np.meshgrid(*map(np.arange, shape[::-1])))
    for share, grain in _WARP:
        cells = max(grain * opening_px, 4.0)
        u += np.float32(level * share * opening_px) * _noise(shape, cells, rng)
        v += np.float32(level * share * opening_px) * _noise(shape, cells, rng)
    labels = cv2.remap(truth.outlines.astype(np.float32), u, v, cv2.INTER_NEAREST)
    drawn = np.asarray(labels, np.int16)
    wanted = {body.label - FIRST_LUMP + 1 for body in truth.bodies}
    for label, pixels in enumerate(np.bincount(drawn.ravel())):
        missed = pixels < _LEAST_PIXELS or rng.random() < _LOST
        if missed and label and label not in wanted:
            drawn[drawn == label] = 0
    return drawn


def _noise(shape: tuple[int, ...], cells: float, rng: np.random.Generator) -> F32:
    """Noise (h, w) of about unit deviation, smooth over so many pixels."""
    if cells < 1:
        return rng.standard_normal(shape, np.float32)
    small = [int(side / cells) + 3 for side in shape]
    noise = rng.standard_normal(small, np.float32)
    return np.asarray(cv2.resize(noise, shape[::-1], interpolation=cv2.INTER_CUBIC), np.float32)
