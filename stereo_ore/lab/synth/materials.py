"""What surfaces look like: reflectance, relief and gloss at surface points, evaluated in the body's
own frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_ore.lab.synth.model import ORES, Model, Part
from stereo_ore.lab.synth.textures import Texture, dot, make_texture, sample
from stereo_ore.types import F32

VEIN_RGB, CRACK_RGB = np.array([[0.62, 0.60, 0.55], [0.06, 0.06, 0.055]], np.float32)


@dataclass(frozen=True)
class Material:
    """Texture, mean reflectance, contrast of its tone, gloss, strength of veins, and the colour of
    bare patches.

    Reflectance is rgb·exp(contrast·tone). Veins are light where `vein` is positive, dark cracks
    where it is negative; `second` shows through where the tone is high.
    """

    texture: Texture
    rgb: tuple[float, float, float]
    contrast: float
    gloss: float = 0.0
    shininess: float = 20.0
    vein: float = 0.0
    second: tuple[float, float, float] | None = None


def make_materials(
    rng: np.random.Generator, model: Model, pixel_m: float, wet: float
) -> dict[str, Material]:
    """Materials of a model, their texels about half a pixel (`pixel_m`) wide at the screen."""
    fine, small = 0.5 * pixel_m, pixel_m < 0.003
    steel = make_texture(rng, fine, 0.9, 14.0, 0.10)
    rust = make_texture(rng, fine, 1.1, 1.0, 0.25)
    earth = make_texture(rng, 1.6 * fine, 1.0, 1.0, 0.3)
    broken = make_texture(rng, fine, 0.9, 1.0, 0.5)
    known = {
        "steel": Material(steel, (0.42, 0.42, 0.42), 0.14, 0.35, 30.0),
        "rust": Material(rust, (0.10, 0.055, 0.035), 0.5, second=(0.20, 0.17, 0.15)),
        "earth": Material(earth, (0.33, 0.29, 0.24), 0.25, vein=0.1),
        "concrete": Material(earth, (0.33, 0.33, 0.31), 0.13, vein=-0.2),
        "rubble": Material(broken, (0.15, 0.145, 0.14) if small else (0.2, 0.18, 0.16), 0.4),
    }
    for ore in sorted({lump.ore for lump in model.lumps}):
        rgb, contrast, stretch = ORES[ore]
        texture = make_texture(rng, fine, 1.0, stretch, 0.55)
        tone = tuple(np.array(rgb) * rng.uniform(0.85, 1.15) * rng.uniform(0.96, 1.04, 3))
        known[ore] = Material(
            texture, tone, contrast, 0.04 + 0.9 * wet, 12.0 + 70.0 * wet, rng.uniform(0, 0.5)
        )
    return known


def painted_surface(
    materials: dict[str, Material], part: Part, xyz: F32, normals: F32
) -> tuple[F32, F32, float | F32, float]:
    """Reflectance (N, 3), relief normals (N, 3), gloss and shininess at points of a part."""
    material = materials[part.material]
    R = part.R.astype(np.float32)
    q, n = xyz @ R + part.offset.astype(np.float32), normals @ R
    rgb, slope = _paint(material, q, n)
    gloss: float | F32 = material.gloss
    if part.material == "steel":
        # Only the worn tops shine; sides rust.
        tops = n[:, 2:] > 0.9
        rust_rgb, rust_slope = _paint(materials["rust"], q, n)
        rgb, slope = np.where(tops, rgb, rust_rgb), np.where(tops, slope, rust_slope)
        gloss = np.where(tops, np.float32(material.gloss), np.float32(0.02))
    bent = n - (slope - dot(slope, n) * n)
    bent /= np.sqrt(dot(bent, bent))
    return rgb, np.asarray(bent @ R.T, np.float32), gloss, material.shininess


def _paint(material: Material, q: F32, n: F32) -> tuple[F32, F32]:
    """Reflectance and relief slope (N, 3) of a material at points and normals of a body's own
    frame.
    """
    tone, vein, slope = sample(material.texture, q, n)
    rgb = (
        np.array(material.rgb, np.float32) * np.exp(material.contrast * tone.clip(-3, 2.5))[:, None]
    )
    if material.second:
        bare = (1 / (1 + np.exp(-4 * (tone - 0.7))))[:, None]
        rgb = rgb * (1 - bare) + bare * np.array(material.second, np.float32)
    if material.vein:
        mix = (abs(material.vein) * vein).clip(0, 1)[:, None]
        rgb = rgb * (1 - mix) + mix * (VEIN_RGB if material.vein > 0 else CRACK_RGB)
    return np.asarray(rgb, np.float32), slope
