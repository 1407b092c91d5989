"""Examples for the network: what it is given of a scene, and the lumps that are there."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from stereo_ore.chain import Chain
from stereo_ore.errors import FrameError
from stereo_ore.io import recordings
from stereo_ore.lab import evaluate
from stereo_ore.lab.bench.scene_files import load_rig
from stereo_ore.lab.synth.eye import depth_and_instance
from stereo_ore.lab.synth.foreign import TOOL
from stereo_ore.lab.synth.materials import Material, make_materials
from stereo_ore.lab.synth.model import FIRST_LUMP, Model
from stereo_ore.lab.synth.rig import eyes, ideal_rig, reference_rectification
from stereo_ore.lab.synth.scene import pair_of, site_of
from stereo_ore.lab.synth.spec import SceneSpec
from stereo_ore.lab.training.ore.piles import piles
from stereo_ore.stages.segment import channels
from stereo_ore.transforms import inverse
from stereo_ore.types import (
    F32,
    I32,
    U8,
    Disparity,
    Grizzly,
    OreMap,
    Site,
    StereoCalibration,
    StereoPair,
    Surface,
)


@dataclass(frozen=True)
class Example:
    """Channels x (C, h, w) float16 and the lump (h, w) that each pixel shows, 0 for none."""

    x: F32
    lump: U8


class UpToTheScreen(Chain):
    """The chain as far as the network needs it."""

    def _segment(self, disparity: Disparity, surface: Surface, screen: Grizzly) -> OreMap:
        raise FrameError("the chain ends here", code="ENOUGH", remedy="none is needed")


def example_of(
    pair: StereoPair, calibration: StereoCalibration, site: Site, instance: I32
) -> Example | None:
    """The example that a pair makes, None where the chain does not find a screen in it."""
    seen = UpToTheScreen(calibration, site)(pair)
    if seen.surface is None or seen.grizzly is None or seen.disparity is None:
        return None
    region, opening = seen.disparity.region, seen.grizzly.opening_m or 0.3
    x = channels.measure_channels(seen.disparity, seen.surface, seen.grizzly, opening, region).x
    ore = (instance >= FIRST_LUMP) & (instance != TOOL)
    lump = np.where(ore, instance - FIRST_LUMP + 1, 0)[region.slices]
    size = x.shape[2], x.shape[1]
    small = cv2.resize(lump.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST_EXACT)
    return Example(x.astype(np.float16), np.asarray(small, np.uint8))


def of_folder(folder: Path) -> Example | None:
    """The example of a scene folder with truth."""
    calibration, site = load_rig(folder)
    pair = recordings.open_source(folder).read(0)
    return example_of(pair, calibration, site, evaluate.load_truth(folder).instance)


def of_seed(seed: int) -> Iterator[Example]:
    """The examples of a drawn screen: its views at each stage of its heap."""
    for pile in piles(seed):
        rng = np.random.default_rng([seed, 41])
        first = pile.views[0]
        pixel_m = first.camera.distance / ideal_rig(first).left.focal_px[0]
        materials = make_materials(rng, pile.model, pixel_m, first.wet)
        for spec in pile.views:
            if (made := _of_view(spec, pile.model, materials)) is not None:
                yield made


def _of_view(spec: SceneSpec, model: Model, materials: dict[str, Material]) -> Example | None:
    calibration = ideal_rig(spec)
    rectified = reference_rectification(calibration)
    T_screen_left = inverse(spec.T_world_screen) @ spec.camera.T_world_left
    left, right, straight = eyes(calibration, rectified, T_screen_left)
    instance = depth_and_instance(model, straight)[1]
    pair = pair_of(spec, model, left, right, materials)
    return example_of(pair, calibration, site_of(spec, rectified), instance)


def save_example(example: Example, path: Path) -> None:
    """Write an example; a file that is there is whole."""
    part = path.with_suffix(".part.npz")
    np.savez(part, x=example.x, lump=example.lump)
    part.rename(path)


def load_example(path: Path) -> Example:
    """Read an example."""
    with np.load(path) as data:
        return Example(data["x"], data["lump"])
