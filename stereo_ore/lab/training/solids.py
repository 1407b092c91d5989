"""Lumps whose truth is known, as samples that the solids' shape prior is fitted to."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from stereo_ore.chain import Chain
from stereo_ore.config import Config
from stereo_ore.io import recordings
from stereo_ore.lab import evaluate, metrics
from stereo_ore.lab.bench.scene_files import load_rig
from stereo_ore.lab.synth.foreign import TOOL
from stereo_ore.lab.synth.model import FIRST_LUMP
from stereo_ore.stages import solid
from stereo_ore.stages.solid import Cues, Sight
from stereo_ore.stages.solid.prior import TARGETS
from stereo_ore.types import F32, F64, I16, I32, Grizzly, OreMap, Rig, Site, Surface

Appearance = Literal["measured", "unplaced", "outlined", "true"]
"""How a scene is seen: as the program measures it; without being told where the screen is; with
true outlines; with true outlines and depth."""
JUDGED: tuple[Appearance, ...] = ("measured", "unplaced")
"""Appearances as the program has them: sigmas describe their errors."""
_RECORDED, _TRUE = 6.0, 2.0
"""How much more than made-up ones lumps of scene folders count, as the program sees them and
otherwise: they are few, and their errors are those of the whole chain."""
TRUE_SIGMA_PX = 0.15
"""Disparity noise that is claimed for true depth."""
MIN_OVERLAP = 0.5
"""Intersection over union from which on a measured lump is a true one."""


@dataclass(frozen=True)
class KnownBody:
    """What is true of a lump: label, volume [m³], centre of mass and dimensions, longest first,
    (3,) [m].

    The centre is in the rectified left camera.
    """

    label: int
    volume: float
    centre: F64
    dimensions: F64


@dataclass(frozen=True)
class KnownLumps:
    """Labels (h, w) of the rectified left view, or of a crop of it, and the `bodies` of the lumps
    that must be found; `recorded` tells a scene folder from a made-up scene.
    """

    name: str
    instance: I32
    bodies: tuple[KnownBody, ...]
    recorded: bool = False

    @property
    def outlines(self) -> I16:
        """Labels (h, w) of the lumps, 1 for the first."""
        lump = (self.instance >= FIRST_LUMP) & (self.instance != TOOL)
        return np.where(lump, self.instance - FIRST_LUMP + 1, 0).astype(np.int16)


@dataclass(frozen=True)
class SolidSample:
    """A lump in one appearance: its cues, and what is true of it as the prior's `TARGETS`.

    `size` is its longest dimension over the size that cues are measured in.
    """

    scene: str
    seen_as: Appearance
    recorded: bool
    cues: Cues
    truth: Mapping[str, float]
    size: float

    @property
    def weight(self) -> float:
        """What it counts in training."""
        return 1.0 if not self.recorded else _RECORDED if self.seen_as in JUDGED else _TRUE


def recorded(folder: Path) -> Iterator[SolidSample]:
    """The lumps of a scene folder with truth that the program finds, in every appearance."""
    known, (calibration, site) = evaluate.load_truth(folder), load_rig(folder)
    pair = recordings.open_source(folder).read(0)
    truth = KnownLumps(folder.name, known.instance, tuple(_bodies(known)), recorded=True)
    sites: Mapping[Appearance, Site] = {"measured": site, "unplaced": replace(site, plane=None)}
    for seen_as, told in sites.items():
        result = Chain(calibration, told)(pair)
        surface, screen = result.surface, result.grizzly
        if surface is None or screen is None or result.ore_map is None:
            continue
        yield from seen(truth, seen_as, surface, result.ore_map, screen)
        if seen_as == "measured":
            outlines = OreMap(truth.outlines)
            yield from seen(truth, "outlined", surface, outlines, screen)
            h, w = surface.sigma_z.shape
            depth = known.depth[surface.y0 : surface.y0 + h, surface.x0 : surface.x0 + w]
            exact = surface_of(depth, surface.x0, surface.y0, surface.rig, TRUE_SIGMA_PX)
            yield from seen(truth, "true", exact, outlines, screen)


def _bodies(truth: evaluate.Truth) -> Iterator[KnownBody]:
    for label in truth.wanted:
        lump = truth.lumps[label]
        dimensions = np.array([lump["max_caliper_mm"], *lump["obb_dims_mm"][1:]]) / 1000
        yield KnownBody(label, lump["volume_mm3"] * 1e-9, truth.centre(label), dimensions)


def surface_of(depth: F32 | F64, x0: int, y0: int, rig: Rig, sigma_px: float) -> Surface:
    """Depth (h, w) [m] of the image's part from (x0, y0) on, 0 or NaN where nothing is known, as a
    surface without colours.
    """
    z = np.where(depth > 0, depth, np.nan)
    u, v = np.meshgrid(np.arange(z.shape[1]) + x0, np.arange(z.shape[0]) + y0)
    xyz = rig.back_project(u, v, z).astype(np.float32)
    sigma = rig.depth_sigma(z, sigma_px).astype(np.float32)
    return Surface(xyz, np.zeros(xyz.shape, np.uint8), sigma, x0, y0, rig)


def seen(
    truth: KnownLumps, seen_as: Appearance, surface: Surface, ore_map: OreMap, screen: Grizzly
) -> Iterator[SolidSample]:
    """Samples of the lumps in a map that overlap true ones enough to be them."""
    found = solid.looks(surface, ore_map, screen, Config().solid)
    for body, label in _counterparts(truth, ore_map):
        if looked := found[label - 1]:
            sight, cues = looked
            longest = float(body.dimensions[0] / sight.size)
            target = _target(body, sight, cues)
            yield SolidSample(truth.name, seen_as, truth.recorded, cues, target, longest)


def _target(body: KnownBody, sight: Sight, cues: Cues) -> dict[str, float]:
    """What is true of a lump as the prior's targets."""
    x, y, z = (sight.axes @ (body.centre - sight.origin) - [0.0, 0.0, cues.support]) / sight.size
    logarithms = np.log([body.volume / sight.size**3, *(body.dimensions / sight.size)])
    return dict(zip(TARGETS, map(float, (x, z, *logarithms, y)), strict=True))


def _counterparts(truth: KnownLumps, ore_map: OreMap) -> Iterator[tuple[KnownBody, int]]:
    """Bodies and the ids in the map that overlap them enough to be them."""
    given = list(range(1, int(ore_map.labels.max(initial=0)) + 1))
    if not given or not truth.bodies:
        return
    labels = [body.label for body in truth.bodies]
    iou = metrics.iou_matrix(truth.instance, ore_map.labels, labels, given)
    for row, column in metrics.best_pairs(iou):
        if iou[row, column] >= MIN_OVERLAP:
            yield truth.bodies[row], given[column]
