"""A whole made-up measurement: pair, calibration, site and truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_ore.lab.synth.eye import Eye, depth_and_instance
from stereo_ore.lab.synth.families import sample_spec
from stereo_ore.lab.synth.materials import Material, make_materials
from stereo_ore.lab.synth.model import Model, build_model
from stereo_ore.lab.synth.render import radiance
from stereo_ore.lab.synth.rig import (
    Rectification,
    eyes,
    ideal_rig,
    raw_rig,
    reference_rectification,
)
from stereo_ore.lab.synth.sensor import expose, exposure_gain
from stereo_ore.lab.synth.spec import SceneSpec
from stereo_ore.lab.synth.truth import LumpTruth, lump_truths
from stereo_ore.transforms import inverse
from stereo_ore.types import F32, I32, BarLine, Plane, Site, StereoCalibration, StereoPair, Volume


@dataclass(frozen=True)
class Scene:
    """A pair with its truth.

    `depth_m` (H, W) float32, NaN where nothing was hit, and `instance` (H, W) int32 (0 background
    and pit, 1 grizzly, 2… lumps) belong to the rectified left view; `raw_depth_m` and
    `raw_instance` to the left image as recorded.
    """

    spec: SceneSpec
    pair: StereoPair
    calibration: StereoCalibration
    site: Site
    rectified: Rectification
    depth_m: F32
    instance: I32
    raw_depth_m: F32
    raw_instance: I32
    lumps: tuple[LumpTruth, ...]

    @property
    def disparity_px(self) -> F32:
        """True disparity (H, W) of the rectified left view, NaN where nothing was hit."""
        return np.asarray(self.rectified.focal_baseline / self.depth_m, np.float32)


def scene(spec: SceneSpec | int, family: str = "large", size: str = "HD720") -> Scene:
    """Make the scene of a specification, or of a seed in a family.

    Parameters
    ----------
    spec : SceneSpec or int
        What to make, or a seed for `sample_spec`.
    family : str
        large, paper, hard, raw or empty; used with a seed.
    size : str
        VGA, HD720, HD1080 or 2K; used with a seed.
    """
    if not isinstance(spec, SceneSpec):
        spec = sample_spec(spec, family, size)
    model = build_model(spec)
    calibration = raw_rig(spec) if spec.raw else ideal_rig(spec)
    rectified = reference_rectification(calibration)
    T_screen_left = inverse(spec.T_world_screen) @ spec.camera.T_world_left
    left, right, straight = eyes(calibration, rectified, T_screen_left)
    depth, instance = depth_and_instance(model, straight)
    raw_depth, raw_instance = depth_and_instance(model, left) if spec.raw else (depth, instance)
    return Scene(
        spec,
        pair_of(spec, model, left, right),
        calibration,
        site_of(spec, rectified),
        rectified,
        depth,
        instance,
        raw_depth,
        raw_instance,
        lump_truths(spec, model, left, straight, raw_depth, raw_instance, instance),
    )


def pair_of(
    spec: SceneSpec,
    model: Model,
    left: Eye,
    right: Eye,
    materials: dict[str, Material] | None = None,
) -> StereoPair:
    """What both eyes record of a model, of these materials or of some drawn for it."""
    rng = np.random.default_rng([spec.seed, 20])
    pixel_m = spec.camera.distance / left.camera.focal_px[0]
    if materials is None:
        materials = make_materials(rng, model, pixel_m, spec.wet)
    views = [radiance(model, materials, spec, eye) for eye in (left, right)]
    gain = exposure_gain(spec.sensor, views[0])
    images = [
        expose(spec.sensor, view, gain * factor, rng)
        for view, factor in zip(views, spec.sensor.gain, strict=True)
    ]
    return StereoPair(images[0], images[1], name=spec.name, index=0)


def site_of(spec: SceneSpec, rectified: Rectification) -> Site:
    """The site in the rectified left camera's frame; the arm's frame is the world."""
    T_arm_camera = spec.camera.T_world_left @ rectified.T_left_rectified
    T_ws, half = spec.T_world_screen, np.array(spec.screen.size) / 2
    corners = np.array(
        [(x, y, z) for x in (-half[0], half[0]) for y in (-half[1], half[1]) for z in (-0.15, 1.0)]
    )
    box = corners @ T_ws[:3, :3].T + T_ws[:3, 3]
    volume = Volume(T_arm_camera, box.min(0), box.max(0))
    normal = T_arm_camera[:3, :3].T @ T_ws[:3, 2]
    origin = (T_ws[:3, 3] - T_arm_camera[:3, 3]) @ T_arm_camera[:3, :3]
    plane = Plane(normal, float(normal @ origin))
    screen = spec.screen
    middle = np.array([screen.bar_centres[len(screen.bar_centres) // 2], 0, 0])
    bar = BarLine(middle, np.array([0.0, 1, 0])).seen_from(inverse(T_ws) @ T_arm_camera)
    return Site(
        T_arm_camera,
        volume,
        plane,
        screen.opening,
        screen.bar_width,
        cross_opening_m=screen.cross_opening,
        bar_profile="round" if screen.round else "flat",
        bar=bar,
    )
