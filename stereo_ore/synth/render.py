"""What an eye sees: radiance by ray casting, with shadows, open sky, gloss and haze; and exact depth."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np

from stereo_ore.synth.materials import Material, surface
from stereo_ore.synth.mesh import blocked, cast
from stereo_ore.synth.model import Model
from stereo_ore.synth.spec import Light, SceneSpec
from stereo_ore.synth.textures import dot
from stereo_ore.types import F32, F64, I32, CameraModel

BAND = 60


@dataclass(frozen=True)
class Eye:
    """A camera of (W, H) pixels with its pose in the screen frame; distortion is that of `camera`."""

    camera: CameraModel
    size: tuple[int, int]
    T_screen_eye: F64

    def rays(self, rows: range, columns: range | None = None, offset: tuple[float, float] = (0.0, 0.0)) -> F32:
        """Rays (rows, columns, 6) in the screen frame through pixel centres moved by `offset`.

        Directions have z_eye = 1, so that the distance along a ray is depth. All columns are taken by default.
        """
        u = np.array(range(self.size[0]) if columns is None else columns, np.float64) + offset[0]
        v = np.array(rows, np.float64) + offset[1]
        R, t = self.T_screen_eye[:3, :3], self.T_screen_eye[:3, 3].astype(np.float32)
        rays = np.empty((len(v), len(u), 6), np.float32)
        rays[..., :3] = t
        if self.camera.distortion:
            pixels = np.stack(np.meshgrid(u, v), -1).reshape(-1, 1, 2)
            xy = cv2.undistortPoints(pixels, self.camera.K, np.array(self.camera.distortion))
            rays[..., 3:] = (xy.reshape(len(v), len(u), 2) @ R[:, :2].T + R[:, 2]).astype(np.float32)
        else:
            (fx, fy), (cx, cy) = self.camera.focal_px, self.camera.principal_point_px
            across, down = (u - cx)[:, None] / fx * R[:, 0], (v - cy)[:, None] / fy * R[:, 1] + R[:, 2]
            np.add(across.astype(np.float32), down.astype(np.float32)[:, None], out=rays[..., 3:])
        return rays


def depth_and_instance(model: Model, eye: Eye) -> tuple[F32, I32]:
    """Exact z [m] (H, W), NaN where nothing is hit, and instance ids (H, W) at pixel centres."""
    hit = cast(model.caster, eye.rays(range(eye.size[1])))
    seen = np.isfinite(hit["t_hit"])
    instance_of = np.array([p.instance for p in model.parts], np.int32)[model.part_of]
    triangle = np.where(seen, hit["primitive_ids"], 0).astype(np.int64)
    depth = np.where(seen, hit["t_hit"], np.nan).astype(np.float32)
    return depth, np.where(seen, instance_of[triangle], 0).astype(np.int32)


def radiance(model: Model, materials: dict[str, Material], spec: SceneSpec, eye: Eye) -> F32:
    """Linear BGR image (H, W, 3): the mean over supersampling² rays a pixel."""
    width, height = eye.size
    steps = (np.arange(spec.supersampling) + 0.5) / spec.supersampling - 0.5
    offsets = [(float(du), float(dv)) for dv in steps for du in steps]

    def band(start: int) -> F32:
        rows = range(start, min(start + BAND, height))
        total = np.zeros((len(rows) * width, 3), np.float32)
        for k, offset in enumerate(offsets):
            total += _shade(model, materials, spec, eye.rays(rows, offset=offset).reshape(-1, 6), k)
        return total.reshape(len(rows), width, 3) / np.float32(len(offsets))

    with ThreadPoolExecutor(min(2, os.cpu_count() or 1)) as pool:
        bands = list(pool.map(band, range(0, height, BAND)))
    return np.concatenate(bands)[..., ::-1]


def _shade(model: Model, materials: dict[str, Material], spec: SceneSpec, rays: F32, k: int) -> F32:
    """RGB radiance (N, 3) along rays; `k` picks the spot on an area light that casts this sample's shadow."""
    hit = cast(model.caster, rays)
    sky = np.array(spec.sky, np.float32)
    out = np.broadcast_to(0.3 * sky, (len(rays), 3)).copy()
    seen = np.flatnonzero(np.isfinite(hit["t_hit"]))
    t, triangle = hit["t_hit"][seen, None], hit["primitive_ids"][seen].astype(np.int64)
    xyz, view = rays[seen, :3] + t * rays[seen, 3:], -rays[seen, 3:]
    view /= np.sqrt(dot(view, view))
    normals = hit["primitive_normals"][seen]
    normals *= np.where(dot(normals, view) < 0, np.float32(-1), np.float32(1))
    open_sky = _interpolated(model.sky_share, model.triangles[triangle], hit["primitive_uvs"][seen])
    rgb, bent, gloss, shininess = _surfaces(model, materials, model.part_of[triangle], xyz, normals)
    upward = 0.6 + 0.4 * bent[:, 2]
    # A tenth of the light reaches every corner by way of other surfaces.
    light = (sky * ((0.08 + 0.92 * open_sky) * upward)[:, None]).astype(np.float32)
    mirror = 2 * dot(bent, view) * bent - view
    shine = 0.25 * sky * (np.clip(mirror[:, 2], 0, 1) * open_sky)[:, None]
    for lamp in spec.lights:
        direct, glint = _lamp(model, lamp, spec, xyz, normals, bent, mirror, shininess, k)
        light, shine = light + direct, shine + glint
    value = rgb * light + gloss[:, None] * shine
    clear = np.exp(-spec.haze_per_m * t)
    out[seen] = value * clear + (1 - clear) * 0.45 * (sky + 0.15)
    return out


def _surfaces(
    model: Model, materials: dict[str, Material], part_of: I32, xyz: F32, normals: F32
) -> tuple[F32, F32, F32, F32]:
    """`materials.surface` for points of all parts: reflectance, relief normals, gloss (N,), shininess (N, 1)."""
    rgb, bent = np.empty_like(xyz), np.empty_like(xyz)
    gloss, shininess = np.empty(len(xyz), np.float32), np.empty((len(xyz), 1), np.float32)
    for index in np.unique(part_of):
        here = np.flatnonzero(part_of == index)
        part = model.parts[index]
        rgb[here], bent[here], gloss[here], shininess[here] = surface(materials, part, xyz[here], normals[here])
    return rgb, bent, gloss, shininess


def _interpolated(values: F32, corners: I32, uv: F32) -> F32:
    """Vertex values (V,) at barycentric coordinates (N, 2) of triangles with vertex ids (N, 3)."""
    u, v = uv[:, 0], uv[:, 1]
    return values[corners[:, 0]] * (1 - u - v) + values[corners[:, 1]] * u + values[corners[:, 2]] * v


def _lamp(
    model: Model, lamp: Light, spec: SceneSpec, xyz: F32, normals: F32, bent: F32, mirror: F32, shininess: F32, k: int
) -> tuple[F32, F32]:
    """Diffuse light (N, 3) and glint (N, 3) of one light at surface points, shadows cast."""
    R = spec.T_world_screen[:3, :3]
    if lamp.position is None:
        to = np.broadcast_to(np.array(lamp.direction) / np.linalg.norm(lamp.direction) @ R, xyz.shape).astype(
            np.float32
        )
        far, strength = 100.0, np.float32(lamp.strength)
    else:
        angle = 2 * np.pi * (k + 0.5) / 4
        spot = np.array(lamp.position) + 0.7 * lamp.radius * np.array([np.cos(angle), np.sin(angle), 0])
        to = (spot @ R - xyz).astype(np.float32)
        distance = np.sqrt(dot(to, to))
        to /= distance
        reference = np.linalg.norm(lamp.position)
        far, strength = 100.0, lamp.strength * (reference / distance) ** 2
    facing = dot(normals, to)[:, 0] > 0
    lit = np.zeros((len(xyz), 1), np.float32)
    at = np.flatnonzero(facing)
    query = np.concatenate([xyz[at] + 1e-3 * normals[at], to[at]], 1)
    lit[at, 0] = ~blocked(model.caster, query, far)
    colour = np.array(lamp.rgb, np.float32) * (lit * strength)
    diffuse = colour * np.clip(dot(bent, to), 0, None)
    glint = colour * np.clip(dot(mirror, to), 0, 1) ** shininess * (0.04 * shininess)
    return diffuse.astype(np.float32), glint.astype(np.float32)
