"""Lumps of scenes whose truth is known, as samples that the solids' shape prior is fitted to."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from stereo_ore.chain import Chain
from stereo_ore.config import Config, FilterConfig
from stereo_ore.io import recordings
from stereo_ore.lab import evaluate, metrics, synth
from stereo_ore.lab.bench.scene_files import load_rig
from stereo_ore.lab.synth.model import FIRST_LUMP
from stereo_ore.stages import solid
from stereo_ore.stages.solid import Cues, Sight
from stereo_ore.stages.solid.prior import TARGETS
from stereo_ore.types import (
    F64,
    I32,
    U8,
    FrameResult,
    OreMap,
    Site,
    StereoCalibration,
    StereoPair,
    Surface,
)

Appearance = Literal["measured", "unplaced", "noisy", "blurred", "outlined", "true"]
"""How a scene is seen: as the program measures it; without being told where the screen is; with
noisier or less sharp images; with true outlines; with true outlines and depth."""
WEIGHTS: Mapping[Appearance, float] = {
    "measured": 1.0, "unplaced": 1.0, "noisy": 0.5, "blurred": 0.5, "outlined": 0.3, "true": 0.3
}  # fmt: skip
"""What a lump counts in each appearance."""
_RECORDED = 2.0
"""How much more lumps of scene folders count: made-up ones are rounder and more alike."""
FIRST_SEED = 3000
"""Of the scenes made for training; nothing else uses them."""
_FAMILIES = ("large", "paper", "hard", "large", "raw", "paper")
_SIZES = ("HD720", "HD720", "HD1080", "HD720", "HD720", "VGA", "HD720")
CROWD = 8
"""Lumps at least on a crowded screen, of which there are two in five; on three screens of four they
are angular.

One ray a pixel: the images alias, and disparities err by 0.09 px, with four by 0.06 and in
path-traced scenes by 0.11. """
NOISE_LEVELS, _BLUR_PX, BLURRED_THRESHOLD = 2.5, 0.7, 0.5
"""Of noisy and blurred images; the filter passes more in the latter."""
TRUE_SIGMA_PX = 0.15
"""Disparity noise that is claimed for true depth."""
MIN_OVERLAP = 0.5
"""Intersection over union from which on a measured lump is a true one."""


@dataclass(frozen=True)
class _Body:
    """What is true of a lump: label, volume [m³], centre of mass and dimensions, longest first,
    (3,) [m].

    The centre is in the rectified left camera.
    """

    label: int
    volume: float
    centre: F64
    dimensions: F64


@dataclass(frozen=True)
class KnownLump:
    """A scene and its truth: depth (H, W) [m], 0 where nothing is, and labels (H, W) of the
    rectified left view.

    `bodies` are those of the lumps that must be found; `recorded` tells a scene folder from a
    made-up scene.
    """

    name: str
    pair: StereoPair
    calibration: StereoCalibration
    site: Site
    depth: F64
    instance: I32
    bodies: tuple[_Body, ...]
    recorded: bool = False


@dataclass(frozen=True)
class SolidSample:
    """A lump in one appearance: its cues, and what is true of it as the prior's `TARGETS` and y.

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
        return WEIGHTS[self.seen_as] * (_RECORDED if self.recorded else 1.0)


def made_solids(seed: int) -> KnownLump:
    """A synthetic scene; consecutive seeds take families, image sizes and kinds of lumps in
    turn.
    """
    spec = synth.sample_spec(seed, _FAMILIES[seed % len(_FAMILIES)], _SIZES[seed % len(_SIZES)])
    crowd = CROWD + seed % CROWD if seed % 5 < 2 else spec.lumps
    scene = synth.scene(replace(spec, lumps=crowd, angular=seed % 4 > 0, supersampling=1))
    bodies = tuple(
        _Body(
            lump.id,
            lump.volume_m3,
            lump.com_rectified,
            np.array([lump.max_calliper, *lump.box_dims[1:]]),
        )
        for lump in scene.lumps
        if evaluate.must_be_found(lump.visible_pixels_rectified, lump.visible_fraction, lump.cut)
    )
    depth = np.nan_to_num(scene.depth_m.astype(np.float64))
    return KnownLump(
        spec.name, scene.pair, scene.calibration, scene.site, depth, scene.instance, bodies
    )


def recorded(folder: Path) -> KnownLump:
    """A scene folder with truth."""
    truth, (calibration, site) = evaluate.load_truth(folder), load_rig(folder)
    pair = recordings.open_source(folder).read(0)
    bodies = []
    for label in truth.wanted:
        lump = truth.lumps[label]
        dimensions = np.array([lump["max_caliper_mm"], *lump["obb_dims_mm"][1:]]) / 1000
        bodies.append(_Body(label, lump["volume_mm3"] * 1e-9, truth.centre(label), dimensions))
    return KnownLump(
        folder.name,
        pair,
        calibration,
        site,
        truth.depth,
        truth.instance,
        tuple(bodies),
        recorded=True,
    )


def samples(known: KnownLump) -> Iterator[SolidSample]:
    """The lumps of a scene that the program finds, in every appearance."""
    pair, site = known.pair, known.site
    measured = _process(known, pair, site)
    unplaced = _process(known, pair, replace(site, plane=None))
    noisy = _process(known, _worse(pair, NOISE_LEVELS, 0.0), site)
    blurred = _process(known, _worse(pair, 0.0, _BLUR_PX), site, threshold=BLURRED_THRESHOLD)
    seen: Sequence[tuple[Appearance, FrameResult]] = (
        ("measured", measured), ("unplaced", unplaced), ("noisy", noisy), ("blurred", blurred),
        ("outlined", _outlined(measured, known)),
        ("true", _true(_outlined(measured, known), known)),
    )  # fmt: skip
    for seen_as, result in seen:
        yield from _samples(known, seen_as, result)


def _samples(known: KnownLump, seen_as: Appearance, result: FrameResult) -> Iterator[SolidSample]:
    if result.surface is None or result.ore_map is None or result.grizzly is None:
        return
    found = solid.looks(result.surface, result.ore_map, result.grizzly, Config().solid)
    for body, label in _counterparts(known, result.ore_map):
        if looked := found[label - 1]:
            sight, cues = looked
            longest = float(body.dimensions[0] / sight.size)
            yield SolidSample(
                known.name, seen_as, known.recorded, cues, _target(body, sight, cues), longest
            )


def _target(body: _Body, sight: Sight, cues: Cues) -> dict[str, float]:
    """What is true of a lump as the prior's targets."""
    x, y, z = (sight.axes @ (body.centre - sight.origin) - [0.0, 0.0, cues.support]) / sight.size
    logarithms = np.log([body.volume / sight.size**3, *(body.dimensions / sight.size)])
    return dict(zip(TARGETS, map(float, (x, z, *logarithms)), strict=True)) | {"y": float(y)}


def _counterparts(known: KnownLump, ore_map: OreMap) -> Iterator[tuple[_Body, int]]:
    """Bodies and the ids in the map that overlap them enough to be them."""
    given = list(range(1, int(ore_map.labels.max(initial=0)) + 1))
    if not given or not known.bodies:
        return
    iou = metrics.iou_matrix(
        known.instance, ore_map.labels, [body.label for body in known.bodies], given
    )
    for row, column in metrics.best_pairs(iou):
        if iou[row, column] >= MIN_OVERLAP:
            yield known.bodies[row], given[column]


def _process(
    known: KnownLump, pair: StereoPair, site: Site, threshold: float | None = None
) -> FrameResult:
    config = Config(
        filter=FilterConfig(params={} if threshold is None else {"threshold": threshold})
    )
    return Chain(known.calibration, site, config)(pair)


def _worse(pair: StereoPair, noise: float, blur_px: float) -> StereoPair:
    rng = np.random.default_rng(0)

    def worse(image: U8) -> U8:
        smooth = cv2.GaussianBlur(image, (0, 0), blur_px) if blur_px else image
        noisy = smooth + noise * rng.standard_normal(image.shape, np.float32)
        return np.asarray(np.clip(noisy, 0, 255), np.uint8)

    return replace(pair, left=worse(pair.left), right=worse(pair.right))


def _outlined(result: FrameResult, known: KnownLump) -> FrameResult:
    """The result with true outlines."""
    return replace(
        result, ore_map=OreMap(np.maximum(known.instance - FIRST_LUMP + 1, 0).astype(np.int16))
    )


def _true(result: FrameResult, known: KnownLump) -> FrameResult:
    """The result with true depth."""
    surface = result.surface
    if surface is None:
        return result
    return replace(result, surface=_true_surface(surface, known))


def _true_surface(surface: Surface, known: KnownLump) -> Surface:
    height, width = surface.sigma_z.shape
    z = known.depth[surface.y0 : surface.y0 + height, surface.x0 : surface.x0 + width]
    z = np.where(z > 0, z, np.nan)
    u, v = np.meshgrid(np.arange(width) + surface.x0, np.arange(height) + surface.y0)
    xyz = surface.rig.back_project(u, v, z).astype(np.float32)
    return replace(
        surface, xyz=xyz, sigma_z=surface.rig.depth_sigma(z, TRUE_SIGMA_PX).astype(np.float32)
    )
