"""What an eye sees: radiance by ray casting, with shadows, open sky, gloss and haze."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from stereo_ore.lab.synth.eye import Eye
from stereo_ore.lab.synth.lighting import Points, lamp_light, sky_light
from stereo_ore.lab.synth.materials import Material, painted_surface
from stereo_ore.lab.synth.mesh import cast
from stereo_ore.lab.synth.model import Model
from stereo_ore.lab.synth.spec import SceneSpec
from stereo_ore.lab.synth.textures import dot
from stereo_ore.types import F32, I32

_BAND = 60
"""Rows rendered at a time; bands share two threads and don't depend on each other."""


def radiance(model: Model, materials: dict[str, Material], spec: SceneSpec, eye: Eye) -> F32:
    """Linear BGR image (H, W, 3): the mean over supersampling² rays a pixel."""
    width, height = eye.size
    steps = (np.arange(spec.supersampling) + 0.5) / spec.supersampling - 0.5
    offsets = [(float(du), float(dv)) for dv in steps for du in steps]

    def band(start: int) -> F32:
        rows = range(start, min(start + _BAND, height))
        total = np.zeros((len(rows) * width, 3), np.float32)
        for k, offset in enumerate(offsets):
            total += _shade(model, materials, spec, eye.rays(rows, offset=offset).reshape(-1, 6), k)
        return total.reshape(len(rows), width, 3) / np.float32(len(offsets))

    with ThreadPoolExecutor(min(2, os.cpu_count() or 1)) as pool:
        bands = list(pool.map(band, range(0, height, _BAND)))
    return np.concatenate(bands)[..., ::-1]


def _shade(model: Model, materials: dict[str, Material], spec: SceneSpec, rays: F32, k: int) -> F32:
    """RGB radiance (N, 3) along rays; `k` counts a pixel's samples."""
    hit = cast(model.caster, rays)
    seen = np.flatnonzero(np.isfinite(hit["t_hit"]))
    triangles, t = hit["primitive_ids"][seen].astype(np.int64), hit["t_hit"][seen, None]
    directions = np.asarray(rays[seen, 3:], np.float32)
    view = np.asarray(-directions / np.sqrt(dot(directions, directions)), np.float32)
    faces = hit["primitive_normals"][seen]
    normals = np.asarray(faces * np.where(dot(faces, view) < 0, np.float32(-1), np.float32(1)))
    xyz = np.asarray(rays[seen, :3] + t * directions, np.float32)
    rgb, bent, gloss, shininess = _surfaces(
        model, materials, model.part_of[triangles], xyz, normals
    )
    open_sky = _interpolated(
        model.sky_share, model.triangles[triangles], hit["primitive_uvs"][seen]
    )
    points = Points(xyz, view, normals, bent, open_sky[:, None], shininess)
    light, shine = sky_light(points, spec.sky)
    for lamp in spec.lights:
        diffuse, glint = lamp_light(points, lamp, model.caster, spec.T_world_screen[:3, :3].T, k)
        light, shine = light + diffuse, shine + glint
    sky = np.array(spec.sky, np.float32)
    out = np.tile(np.float32(0.3) * sky, (len(rays), 1))
    clear = np.exp(-np.float32(spec.haze_per_m) * t)
    out[seen] = (rgb * light + gloss * shine) * clear + (1 - clear) * np.float32(0.45) * (
        sky + np.float32(0.15)
    )
    return out


def _surfaces(
    model: Model, materials: dict[str, Material], part_of: I32, xyz: F32, normals: F32
) -> tuple[F32, F32, F32, F32]:
    """`materials.painted_surface` for points of all parts: reflectance, relief normals (N, 3),
    gloss and shininess (N, 1).
    """
    rgb, bent = np.empty_like(xyz), np.empty_like(xyz)
    gloss, shininess = np.empty((len(xyz), 1), np.float32), np.empty((len(xyz), 1), np.float32)
    for index in np.unique(part_of):
        here = np.flatnonzero(part_of == index)
        part = model.parts[index]
        rgb[here], bent[here], gloss[here], shininess[here] = painted_surface(
            materials, part, xyz[here], normals[here]
        )
    return rgb, bent, gloss, shininess


def _interpolated(values: F32, corners: I32, uv: F32) -> F32:
    """Vertex values (V,) at barycentric coordinates (N, 2) of triangles with vertex ids (N, 3)."""
    u, v = uv[:, 0], uv[:, 1]
    return np.asarray(
        values[corners[:, 0]] * (1 - u - v) + values[corners[:, 1]] * u + values[corners[:, 2]] * v
    )
