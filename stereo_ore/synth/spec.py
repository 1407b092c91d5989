"""What a scene is made of: screen, lumps, camera, light and sensor, drawn from a seed for each family."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from stereo_ore.errors import ConfigError
from stereo_ore.synth.screen import Screen
from stereo_ore.types import F64

FAMILIES = ("large", "paper", "hard", "raw", "empty")
SIZES: dict[str, tuple[int, int, float]] = {
    "VGA": (672, 376, 265.0),
    "HD720": (1280, 720, 530.0),
    "HD1080": (1920, 1080, 1060.0),
    "2K": (2208, 1242, 1060.0),
}
"""Width, height and focal length [px] of one eye in the modes of a ZED 2."""

BASELINE_M = 0.12


@dataclass(frozen=True)
class Light:
    """A far light from a direction in the world (`position` None) or an area light around a position [m]."""

    direction: tuple[float, float, float]
    strength: float
    rgb: tuple[float, float, float]
    position: tuple[float, float, float] | None = None
    radius: float = 0.0


@dataclass(frozen=True)
class SceneSpec:
    """All that a scene is made from; equal specs give equal scenes. Lengths in metres, angles in radians."""

    seed: int
    family: str
    size: str
    screen: Screen
    lumps: int
    lump_size: tuple[float, float]
    tilt: tuple[float, float]
    camera_height: float
    pitch: float
    yaw: float
    roll: float
    target: tuple[float, float]
    lights: tuple[Light, ...]
    sky: tuple[float, float, float]
    table: bool = False
    raw: bool = False
    wet: float = 0.0
    haze_per_m: float = 0.0
    exposure: float = 1.0
    gain: tuple[float, float] = (1.0, 1.0)
    contrast: float = 1.0
    full_well: float = 4000.0
    read_noise: float = 6.0
    supersampling: int = 2

    def __post_init__(self) -> None:
        if self.size not in SIZES:
            raise ConfigError(f"{self.size!r} is no image size", key="size", remedy=f"Choose from {', '.join(SIZES)}")

    @property
    def name(self) -> str:
        """Family and seed."""
        return f"{self.family}_{self.seed:04d}"

    @property
    def T_world_screen(self) -> F64:  # noqa: N802 - frames are named as everywhere
        """Pose of the screen: turned by the two tilts about the world's origin."""
        (sa, sb), (ca, cb) = np.sin(self.tilt), np.cos(self.tilt)
        T = np.eye(4)
        T[:3, :3] = np.array([[cb, 0, sb], [0, 1, 0], [-sb, 0, cb]]) @ np.array([[1, 0, 0], [0, ca, -sa], [0, sa, ca]])
        return T

    @property
    def T_world_left(self) -> F64:  # noqa: N802 - frames are named as everywhere
        """Pose of the left eye: `camera_height` above the target, looking at it under the pitch."""
        (sp, sy, sr), (cp, cy, cr) = (
            np.sin([self.pitch, self.yaw, self.roll]),
            np.cos([self.pitch, self.yaw, self.roll]),
        )
        forward, level = np.array([sy * cp, cy * cp, -sp]), np.array([cy, -sy, 0.0])
        down = np.cross(forward, level)
        T = np.eye(4)
        T[:3, :3] = np.stack([cr * level + sr * down, cr * down - sr * level, forward], 1)
        T[:3, 3] = np.array([*self.target, 0.0]) - forward * self.camera_height / sp
        return T


def sample_spec(seed: int, family: str = "large", size: str = "HD720") -> SceneSpec:
    """A random scene: large, paper, hard (low light, wet, dust), raw (distorted eyes) or empty (no lump)."""
    if family not in FAMILIES:
        raise ConfigError(f"{family!r} is no family", key="family", remedy=f"Choose from {', '.join(FAMILIES)}")
    rng = np.random.default_rng([seed, FAMILIES.index(family)])
    small = family == "paper" or (family in ("raw", "empty") and rng.random() < 0.35)
    spec = _paper(rng, seed, family, size) if small else _large(rng, seed, family, size)
    if family == "hard":
        return _harden(spec, rng)
    if family == "empty":
        return replace(spec, lumps=0)
    return replace(spec, raw=family == "raw", full_well=float(np.exp(rng.uniform(np.log(1500), np.log(6000)))))


def _camera(rng: np.random.Generator) -> dict[str, float]:
    return {
        "pitch": float(np.radians(rng.uniform(43, 70) if rng.random() < 0.5 else rng.uniform(70, 89.8))),
        "yaw": float(np.radians(rng.uniform(-25, 25) + 180 * rng.integers(2))),
        "roll": float(np.radians(rng.normal(0, 2))),
    }


def _large(rng: np.random.Generator, seed: int, family: str, size: str) -> SceneSpec:
    """A screen of real size over a pit, as wide as 3.4–4.4 m."""
    opening, width = int(rng.integers(20, 41)) * 0.01, int(rng.integers(12, 19)) * 0.005
    count = int(rng.uniform(3.2, 4.0) / (opening + width))
    inside = (count * width + (count + 1) * opening, int(rng.integers(30, 41)) * 0.1)
    screen = Screen(
        opening, width, float(rng.choice([0.16, 0.2])), inside, 0.16, int(rng.integers(2, 4)), 1.4, rise=0.055
    )
    camera = _camera(rng)
    return SceneSpec(
        seed, family, size, screen, int(rng.integers(5, 13)), (0.2, 0.9), _tilt(rng), rng.uniform(1.8, 3.3), **camera,
        target=tuple(rng.normal(0, 0.25, 2)), **_daylight(rng), gain=(1.0, float(rng.choice([1.0, 0.985, 1.02]))),
        contrast=float(rng.choice([1.0, 1.0, 0.75])),
    )  # fmt: skip


def _paper(rng: np.random.Generator, seed: int, family: str, size: str) -> SceneSpec:
    """The published experiment: a table of about 630 × 900 mm, lumps of 80–250 mm, the camera about 0.9 m away."""
    inside = (0.63, 0.9) if rng.random() < 0.5 else (0.9, 0.63)
    count = int(rng.integers(3, 5) if inside[0] < 0.7 else rng.integers(4, 6))
    screen = Screen((inside[0] - count * 0.04) / (count + 1), 0.04, 0.06, inside, 0.05, int(rng.integers(1, 3)), 0.5)
    lamps = tuple(
        Light(
            (0, 0, 1),
            rng.uniform(0.5, 0.9),
            (1.0, 0.97, 0.92),
            (*rng.uniform(-1.4, 1.4, 2), rng.uniform(1.9, 2.4)),
            0.3,
        )
        for _ in range(rng.integers(1, 3))
    )
    return SceneSpec(
        seed, family, size, screen, int(rng.integers(5, 12)), (0.08, 0.25), _tilt(rng), rng.uniform(0.78, 0.95),
        **_camera(rng), target=tuple(rng.normal(0, 0.05, 2)), lights=lamps, sky=(0.35, 0.34, 0.32), table=True,
        contrast=float(rng.choice([1.0, 0.7])),
    )  # fmt: skip


def _tilt(rng: np.random.Generator) -> tuple[float, float]:
    a, b = np.radians(rng.integers(-8, 10, 2))
    return float(a), float(b)


def _daylight(rng: np.random.Generator) -> dict[str, tuple]:
    """Sun and blue shade, an overcast sky, or a flood light."""
    kind = rng.integers(3)
    azimuth, side = rng.uniform(0, 2 * np.pi), rng.uniform(0.4, 0.9)
    direction = (np.cos(azimuth) * side, np.sin(azimuth) * side, 0.8)
    if kind == 0:
        return {"lights": (Light(direction, 1.0, (1.0, 0.93, 0.82)),), "sky": (0.234, 0.27, 0.336)}
    if kind == 1:
        return {"lights": (), "sky": (0.95, 1.0, 1.06)}
    lamp = Light((0, 0, 1), 1.0, (1.0, 0.97, 0.92), (3 * direction[0], 3 * direction[1], 4.5), 0.5)
    return {"lights": (lamp,), "sky": (0.4, 0.4, 0.42)}


def _harden(spec: SceneSpec, rng: np.random.Generator) -> SceneSpec:
    """Low light, wet rock or dust, in turn with the seed."""
    kind: Literal["dark", "wet", "dust"] = ("dark", "wet", "dust")[spec.seed % 3]
    if kind == "dark":
        return replace(spec, full_well=rng.uniform(300, 900), exposure=0.6)
    if kind == "dust":
        return replace(spec, haze_per_m=rng.uniform(0.12, 0.3))
    lamp = Light((0, 0, 1), 1.1, (1.0, 0.97, 0.92), (*rng.uniform(-3, 3, 2), 3.4), 0.5)
    return replace(spec, wet=1.0, lights=(lamp,), sky=(0.234, 0.27, 0.336))
