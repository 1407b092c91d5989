"""Scenes drawn from a seed: real-size screens, the published experiment's table, and harder cases
of both.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stereo_ore.errors import ConfigError
from stereo_ore.lab.synth.lighting import Light
from stereo_ore.lab.synth.screen import Screen
from stereo_ore.lab.synth.spec import Camera, SceneSpec, Sensor

FAMILIES = ("large", "paper", "hard", "raw", "empty", "grid", "round")
SMALL_SHARE = 0.35
"""Share of raw and empty scenes that are of the table's size."""

WARM, SUN = (1.0, 0.97, 0.92), (1.0, 0.93, 0.82)
SHADE, OVERCAST, INDOORS = (0.234, 0.27, 0.336), (0.95, 1.0, 1.06), (0.4, 0.4, 0.42)


def sample_spec(seed: int, family: str = "large", size: str = "HD720") -> SceneSpec:
    """A random scene: large, paper, hard (low light, wet, dust in turn), raw (distorted eyes),
    empty (no lump), grid (bars both ways) or round (round bars), both large.
    """
    if family not in FAMILIES:
        raise ConfigError(
            f"{family!r} is no family", key="family", remedy=f"Choose from {', '.join(FAMILIES)}"
        )
    rng = np.random.default_rng([seed, FAMILIES.index(family)])
    small = family == "paper" or (family in ("raw", "empty") and rng.random() < SMALL_SHARE)
    spec = (_paper if small else _large)(rng, seed, family, size)
    if family == "hard":
        return _harden(spec, rng)
    if family == "grid":
        cross = spec.screen.opening * (1.0 if seed % 2 else float(rng.uniform(1.1, 1.6)))
        return replace(spec, screen=replace(spec.screen, cross_opening=round(cross, 2), ties=0))
    if family == "round":
        return replace(spec, screen=replace(spec.screen, round=True))
    return replace(spec, raw=family == "raw", lumps=0 if family == "empty" else spec.lumps)


def _large(rng: np.random.Generator, seed: int, family: str, size: str) -> SceneSpec:
    """A screen of real size over a pit, 3–4 m wide, the camera 1.8–3.3 m above it."""
    opening, width = int(rng.integers(20, 41)) * 0.01, int(rng.integers(12, 19)) * 0.005
    bars = int(rng.uniform(3.2, 4.0) / (opening + width))
    inside = (bars * width + (bars + 1) * opening, int(rng.integers(30, 41)) * 0.1)
    depth, ties = float(rng.choice([0.16, 0.2])), int(rng.integers(2, 4))
    screen = Screen(opening, width, depth, inside, 0.16, ties, pit_depth=1.4, rise=0.055)
    lights, sky = _daylight(rng)
    camera, sensor = _camera(rng, (1.8, 3.3), 0.25), _sensor(rng)
    lumps = int(rng.integers(5, 13))
    return SceneSpec(
        seed, family, size, screen, lumps, (0.2, 0.9), _tilt(rng), camera, lights, sky, sensor
    )


def _paper(rng: np.random.Generator, seed: int, family: str, size: str) -> SceneSpec:
    """A table of 630 × 900 mm with lumps of 80–250 mm, the camera about 0.9 m above it."""
    inside = (0.63, 0.9) if rng.random() < 0.5 else (0.9, 0.63)
    bars = int(rng.integers(3, 5)) + (inside[0] > inside[1])
    opening, ties = (inside[0] - bars * 0.04) / (bars + 1), int(rng.integers(1, 3))
    screen = Screen(opening, 0.04, 0.06, inside, 0.05, ties, pit_depth=0.5)
    lights, sky = tuple(_lamp(rng) for _ in range(rng.integers(1, 3))), (0.35, 0.34, 0.32)
    camera, sensor = _camera(rng, (0.78, 0.95), 0.05), _sensor(rng)
    lumps, sizes = int(rng.integers(5, 12)), (0.08, 0.25)
    return SceneSpec(
        seed,
        family,
        size,
        screen,
        lumps,
        sizes,
        _tilt(rng),
        camera,
        lights,
        sky,
        sensor,
        table=True,
    )


def _harden(spec: SceneSpec, rng: np.random.Generator) -> SceneSpec:
    kind = spec.seed % 3
    if kind == 0:
        dark = replace(spec.sensor, full_well=float(rng.uniform(300, 900)), exposure=0.6)
        return replace(spec, sensor=dark)
    if kind == 1:
        return replace(spec, haze_per_m=float(rng.uniform(0.06, 0.15)))
    x, y = rng.uniform(-3, 3, 2)
    lamp = Light(_times(WARM, 1.1), position=(float(x), float(y), 3.4), radius=0.5)
    return replace(spec, wet=1.0, lights=(lamp,), sky=SHADE)


def _camera(rng: np.random.Generator, height: tuple[float, float], wander: float) -> Camera:
    """Half the cameras look down steeply; any may look from either side of the screen."""
    pitch = rng.uniform(43, 70) if rng.random() < 0.5 else rng.uniform(70, 89.8)
    yaw, roll = rng.uniform(-25, 25) + 180 * rng.integers(2), rng.normal(0, 2)
    x, y = rng.normal(0, wander, 2)
    angles = [float(a) for a in np.radians([pitch, yaw, roll])]
    return Camera(
        float(rng.uniform(*height)), angles[0], angles[1], angles[2], (float(x), float(y))
    )


def _sensor(rng: np.random.Generator) -> Sensor:
    full_well = float(np.exp(rng.uniform(np.log(700), np.log(3500))))
    gain, contrast = float(rng.choice([1.0, 0.985, 1.02])), float(rng.choice([1.0, 1.0, 0.75]))
    return Sensor(gain=(1.0, gain), contrast=contrast, full_well=full_well)


def _tilt(rng: np.random.Generator) -> tuple[float, float]:
    a, b = np.radians(rng.integers(-8, 10, 2))
    return float(a), float(b)


def _daylight(rng: np.random.Generator) -> tuple[tuple[Light, ...], tuple[float, float, float]]:
    """Sun and blue shade, an overcast sky, or a flood light indoors; lights and sky."""
    kind, azimuth, slant = rng.integers(3), rng.uniform(0, 2 * np.pi), rng.uniform(0.4, 0.9)
    x, y = float(np.cos(azimuth) * slant), float(np.sin(azimuth) * slant)
    if kind == 0:
        return (Light(SUN, direction=(x, y, 0.8)),), SHADE
    if kind == 1:
        return (), OVERCAST
    return (Light(WARM, position=(3 * x, 3 * y, 4.5), radius=0.5),), INDOORS


def _lamp(rng: np.random.Generator) -> Light:
    """A lamp about two metres above a table."""
    x, y = rng.uniform(-1.4, 1.4, 2)
    position = (float(x), float(y), float(rng.uniform(1.9, 2.4)))
    return Light(_times(WARM, float(rng.uniform(0.5, 0.9))), position=position, radius=0.3)


def _times(rgb: tuple[float, float, float], factor: float) -> tuple[float, float, float]:
    return rgb[0] * factor, rgb[1] * factor, rgb[2] * factor
