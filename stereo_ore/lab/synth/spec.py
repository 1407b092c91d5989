"""What a scene is made of: screen, lumps, camera, light and sensor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_ore.errors import ConfigError
from stereo_ore.lab.synth.foreign import Kind
from stereo_ore.lab.synth.lighting import Light
from stereo_ore.lab.synth.screen import Screen
from stereo_ore.types import F64

SIZES: dict[str, tuple[int, int, float]] = {
    "VGA": (672, 376, 265.0),
    "HD720": (1280, 720, 530.0),
    "HD1080": (1920, 1080, 1060.0),
    "2K": (2208, 1242, 1060.0),
}
"""Width, height and focal length [px] of one eye in the modes of a ZED 2."""

BASELINE_M = 0.12


@dataclass(frozen=True)
class Camera:
    """Where the left eye is: so high above the world's origin, looking under a pitch below the
    horizon at a target.

    `target` is a place (x, y) at height 0; yaw 0 looks along y; lengths in metres, angles in
    radians.
    """

    height: float
    pitch: float
    yaw: float = 0.0
    roll: float = 0.0
    target: tuple[float, float] = (0.0, 0.0)

    @property
    def distance(self) -> float:
        """From the eye to its target [m]."""
        return float(self.height / np.sin(self.pitch))

    @property
    def T_world_left(self) -> F64:  # noqa: N802 - frames are named as everywhere
        """Pose of the left eye."""
        sin_pitch, sin_yaw, sin_roll = np.sin([self.pitch, self.yaw, self.roll])
        cos_pitch, cos_yaw, cos_roll = np.cos([self.pitch, self.yaw, self.roll])
        forward = np.array([sin_yaw * cos_pitch, cos_yaw * cos_pitch, -sin_pitch])
        level = np.array([cos_yaw, -sin_yaw, 0.0])
        down = np.cross(forward, level)
        T = np.eye(4)
        T[:3, :3] = np.stack(
            [cos_roll * level + sin_roll * down, cos_roll * down - sin_roll * level, forward], 1
        )
        T[:3, 3] = np.array([*self.target, 0.0]) - forward * self.distance
        return T


@dataclass(frozen=True)
class Sensor:
    """Exposure relative to a well lit picture, gain of the eyes, contrast, electrons at white and
    read noise.
    """

    exposure: float = 1.0
    gain: tuple[float, float] = (1.0, 1.0)
    contrast: float = 1.0
    full_well: float = 4000.0
    read_noise: float = 6.0


@dataclass(frozen=True)
class SceneSpec:
    """All that a scene is made from; equal specs give equal scenes.

    `lump_size` are the least and greatest longest dimension [m], `tilt` the screen's two tilts
    [rad], `sky` its light. A `table` stands on a floor; otherwise there is a pit. `raw` eyes are
    distorted. `wet` 0…1 makes rock shine. `angular` lumps are bounded by fewer and less equal
    faces: see `rocks.rock`. `foreign` bodies are over the screen: see `foreign.foreign_body`.
    """

    seed: int
    family: str
    size: str
    screen: Screen
    lumps: int
    lump_size: tuple[float, float]
    tilt: tuple[float, float]
    camera: Camera
    lights: tuple[Light, ...]
    sky: tuple[float, float, float]
    sensor: Sensor = Sensor()
    table: bool = False
    raw: bool = False
    wet: float = 0.0
    haze_per_m: float = 0.0
    supersampling: int = 2
    angular: bool = False
    foreign: tuple[Kind, ...] = ()

    def __post_init__(self) -> None:
        if self.size not in SIZES:
            raise ConfigError(
                f"{self.size!r} is no image size",
                key="size",
                remedy=f"Choose from {', '.join(SIZES)}",
            )

    @property
    def name(self) -> str:
        """Family and seed."""
        return f"{self.family}_{self.seed:04d}"

    @property
    def T_world_screen(self) -> F64:  # noqa: N802 - frames are named as everywhere
        """Pose of the screen: turned by the two tilts about the world's origin."""
        (sa, sb), (ca, cb) = np.sin(self.tilt), np.cos(self.tilt)
        T = np.eye(4)
        T[:3, :3] = np.array([[cb, 0, sb], [0, 1, 0], [-sb, 0, cb]]) @ np.array(
            [[1, 0, 0], [0, ca, -sa], [0, sa, ca]]
        )
        return T
