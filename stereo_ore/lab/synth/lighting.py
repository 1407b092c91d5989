"""Lights of a scene, and how they fall on surface points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_ore.lab.synth.mesh import RayCaster, blocked
from stereo_ore.lab.synth.textures import dot
from stereo_ore.types import F32, F64

FAR_M = 100.0
INDIRECT = 0.08
"""Share of the sky's light that reaches every corner by way of other surfaces."""


@dataclass(frozen=True)
class Light:
    """A light of strength rgb: far, in a direction of the world, or an area of a radius around a
    position [m].
    """

    rgb: tuple[float, float, float]
    direction: tuple[float, float, float] | None = None
    position: tuple[float, float, float] = (0.0, 0.0, 2.0)
    radius: float = 0.0

    def towards(self, xyz: F32, R_screen_world: F64, k: int) -> tuple[F32, F32]:
        """Unit vectors (N, 3) from points to the light and its strength there (N, 1), in the screen
        frame.

        Sample `k` of a pixel looks at the `k`-th of four spots of an area light, which makes
        shadows soft. The strength of an area light falls with the square of the distance and is
        that of `rgb` in the world's origin.
        """
        if self.direction is not None:
            to = R_screen_world @ (np.array(self.direction) / np.linalg.norm(self.direction))
            return np.tile(to.astype(np.float32), (len(xyz), 1)), np.ones((len(xyz), 1), np.float32)
        angle = np.pi / 2 * (k + 0.5)
        spot = np.array(self.position) + 0.7 * self.radius * np.array(
            [np.cos(angle), np.sin(angle), 0]
        )
        to = (R_screen_world @ spot).astype(np.float32) - xyz
        distance = np.sqrt(dot(to, to))
        fall = (np.float32(np.linalg.norm(self.position)) / distance) ** 2
        return np.asarray(to / distance, np.float32), np.asarray(fall, np.float32)


@dataclass(frozen=True)
class Points:
    """Surface points that are seen: place, unit vector to the eye, normal and relief normal (N, 3),
    screen frame.

    `open_sky` (N, 1) is the share of the sky above them; `shininess` (N, 1) the exponent of their
    gloss.
    """

    xyz: F32
    view: F32
    normals: F32
    bent: F32
    open_sky: F32
    shininess: F32

    @property
    def mirrored(self) -> F32:
        """Directions (N, 3) that the eye sees mirrored."""
        return np.asarray(2 * dot(self.bent, self.view) * self.bent - self.view, np.float32)


def sky_light(points: Points, rgb: tuple[float, float, float]) -> tuple[F32, F32]:
    """Diffuse and mirrored light (N, 3) of an even sky; less of it falls on surfaces that don't
    face up.
    """
    sky = np.array(rgb, np.float32)
    upward = 0.6 + 0.4 * points.bent[:, 2:]
    diffuse = sky * ((INDIRECT + (1 - INDIRECT) * points.open_sky) * upward)
    mirrored = 0.25 * sky * (points.mirrored[:, 2:].clip(0, 1) * points.open_sky)
    return np.asarray(diffuse, np.float32), np.asarray(mirrored, np.float32)


def lamp_light(
    points: Points, lamp: Light, caster: RayCaster, R_screen_world: F64, k: int
) -> tuple[F32, F32]:
    """Diffuse and mirrored light (N, 3) of one light, with cast shadows; Phong's glint, normalised
    by its exponent.
    """
    to, strength = lamp.towards(points.xyz, R_screen_world, k)
    facing = np.flatnonzero(dot(points.normals, to)[:, 0] > 0)
    start = points.xyz[facing] + np.float32(1e-3) * points.normals[facing]
    lit = np.zeros((len(to), 1), np.float32)
    lit[facing, 0] = ~blocked(caster, np.concatenate([start, to[facing]], 1), FAR_M)
    colour = np.array(lamp.rgb, np.float32) * (lit * strength)
    glint = dot(points.mirrored, to).clip(0, 1) ** points.shininess * (0.04 * points.shininess)
    return np.asarray(colour * dot(points.bent, to).clip(0, None), np.float32), np.asarray(
        colour * glint, np.float32
    )
