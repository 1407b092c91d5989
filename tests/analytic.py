"""Ellipsoids on a screen seen by a camera: surface, labels and truth in closed form, without a ray
caster."""

from dataclasses import dataclass

import numpy as np

from stereo_ore.types import F64, Bars, Grizzly, OreMap, Plane, Rig, Surface


@dataclass(frozen=True)
class Ellipsoid:
    """Semi-axes (3,) [m] along the screen's x, y, z and centre (3,) in the screen's frame."""

    radii: tuple[float, float, float]
    centre: tuple[float, float, float]


@dataclass(frozen=True)
class View:
    """What a camera `distance_m` from the screen's origin sees, looking down `pitch_deg` below the
    screen's plane."""

    surface: Surface
    ore_map: OreMap
    grizzly: Grizzly
    T_camera_screen: F64

    def to_camera(self, xyz: tuple[float, ...]) -> F64:
        return self.T_camera_screen[:3, :3] @ np.array(xyz) + self.T_camera_screen[:3, 3]


def look_down(
    lumps: list[Ellipsoid],
    pitch_deg: float = 70.0,
    distance_m: float = 1.0,
    scale: float = 1.0,
    bars: bool = False,
) -> View:
    """A 640×480 view with f = 500 px; `scale` multiplies every length."""
    rig = Rig(640, 480, 500.0, 500.0, 320.0, 240.0, 0.12 * scale)
    T = _pose(np.radians(pitch_deg), distance_m * scale)
    v, u = np.mgrid[:480, :640]
    rays = rig.back_project(u, v, np.ones(u.shape))
    eye, ray = -T[:3, :3].T @ T[:3, 3], rays @ T[:3, :3]
    depth, labels = -eye[2] / ray[..., 2], np.zeros(u.shape, np.int16)
    for number, lump in enumerate(lumps, 1):
        hit = _enter(ray, eye, scale * np.array(lump.radii), scale * np.array(lump.centre))
        nearer = np.isfinite(hit) & (hit < depth)
        depth, labels = (
            np.where(nearer, hit, depth),
            np.where(nearer, number, labels).astype(np.int16),
        )
    xyz = (rays * depth[..., None]).astype(np.float32)
    sigma_z = rig.depth_sigma(depth, 0.15).astype(np.float32)
    surface = Surface(xyz, np.zeros((480, 640, 3), np.uint8), sigma_z, 0, 0, rig)
    plane = Plane(T[:3, 2], float(T[:3, 2] @ T[:3, 3]))
    known = Bars(T[:3, 1], T[:3, 0], 0.17 * scale, 0.0, 0.04 * scale) if bars else None
    return View(
        surface, OreMap(labels), Grizzly(plane, "site", bars=known, opening_m=0.13 * scale), T
    )


def _pose(pitch: float, distance: float) -> F64:
    forward = np.array([0.0, np.cos(pitch), -np.sin(pitch)])
    right = np.array([1.0, 0.0, 0.0])
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    T[:3, 3] = [0.0, 0.0, distance]
    return T


def _enter(ray: F64, eye: F64, radii: F64, centre: F64) -> F64:
    """Ray parameter, which is depth, at which rays (..., 3) from `eye` enter an ellipsoid; NaN
    where they miss."""
    d, o = ray / radii, (eye - centre) / radii
    a, b, c = (d * d).sum(-1), (d * o).sum(-1), (o * o).sum() - 1.0
    discriminant = b * b - a * c
    return np.where(discriminant >= 0, (-b - np.sqrt(np.maximum(discriminant, 0))) / a, np.nan)
