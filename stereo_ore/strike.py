"""Where and in which direction the tool may strike a lump."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from stereo_ore.config.models import StrikeConfig
from stereo_ore.types import F64, Grizzly, Mask, OreMap, Reason, Rig, Site, Solid, Strike, StrikePlan, Surface


def plans(
    surface: Surface,
    ore_map: OreMap,
    solids: Sequence[Solid | None],
    grizzly: Grizzly,
    site: Site,
    config: StrikeConfig,
) -> tuple[StrikePlan, ...]:
    """The strikes of every lump, best first; entry i belongs to id i + 1."""
    h, w = surface.sigma_z.shape
    labels = ore_map.labels[surface.y0 : surface.y0 + h, surface.x0 : surface.x0 + w]
    up = grizzly.plane.normal
    return tuple(_plan(surface, labels == i + 1, solid, up, config) for i, solid in enumerate(solids))


@dataclass(frozen=True)
class Faces:
    """Planes fitted around every pixel: depth (h, w) [m], unit normal (h, w, 3), rms (h, w) [m], share (h, w)."""

    depth: F64
    normal: F64
    rms: F64
    share: F64


def fit_faces(inverse_depth: F64, mask: Mask, side: int, rig: Rig, x0: int, y0: int) -> Faces:
    """Plane around every pixel by regression of inverse depth, which is linear in the pixel on a plane.

    1/z = a·u + b·v + c gives the normal −(a·fx, b·fy, c + a·cx + b·cy) up to scale.
    """
    h, w = mask.shape
    m = mask.astype(np.float64)
    q = np.where(mask, inverse_depth, 0.0)
    u = np.broadcast_to(np.arange(w) - 0.5 * w, (h, w))
    v = np.broadcast_to((np.arange(h) - 0.5 * h)[:, None], (h, w))

    def mean(x: F64) -> F64:
        return np.asarray(cv2.boxFilter(x, -1, (side, side), normalize=True, borderType=cv2.BORDER_CONSTANT))

    n = np.maximum(mean(m), 1e-12)
    mu, mv, mq = mean(m * u) / n, mean(m * v) / n, mean(q) / n
    uu, vv, uv = mean(m * u * u) / n - mu**2, mean(m * v * v) / n - mv**2, mean(m * u * v) / n - mu * mv
    uq, vq, qq = mean(q * u) / n - mu * mq, mean(q * v) / n - mv * mq, mean(q * q) / n - mq**2
    det = np.maximum(uu * vv - uv**2, 1e-9)
    a, b = (uq * vv - vq * uv) / det, (vq * uu - uq * uv) / det
    here = np.maximum(mq + a * (u - mu) + b * (v - mv), 1e-6)
    rms = np.sqrt(np.maximum(qq - a * uq - b * vq, 0.0)) / here**2
    c = here - a * (u + 0.5 * w + x0) - b * (v + 0.5 * h + y0)
    normal = -np.stack([a * rig.fx, b * rig.fy, c + a * rig.cx + b * rig.cy], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return Faces(1.0 / here, normal, rms, n)


def _plan(surface: Surface, mask: Mask, solid: Solid | None, up: F64, config: StrikeConfig) -> StrikePlan:
    seen = mask & np.isfinite(surface.xyz[..., 2])
    if solid is None or not seen.any():
        return StrikePlan((), (Reason("UNCERTAIN_DEPTH", "too few points to place a strike"),))
    x, y, w, h = cv2.boundingRect(seen.astype(np.uint8))
    crop = np.s_[y : y + h, x : x + w]
    seen, xyz = seen[crop], surface.xyz[crop].astype(np.float64)
    side = 2 * int(0.5 * surface.rig.fx * config.tool_diameter_m / np.nanmedian(xyz[..., 2])) + 1
    faces = fit_faces(1.0 / xyz[..., 2], seen, max(side, 7), surface.rig, surface.x0 + x, surface.y0 + y)
    cos = faces.normal @ up
    inside = cv2.erode(seen.astype(np.uint8), np.ones((side, side), np.uint8)) > 0
    admissible = seen & inside & (cos > np.cos(config.max_slope_rad))
    if not admissible.any():
        return StrikePlan((), (Reason("TOO_STEEP", "no face within the permitted angle"),))
    offset = xyz - solid.centre_of_gravity
    lever = np.linalg.norm(offset - (offset @ up)[..., None] * up, axis=-1) / solid.size_m[0]
    score = np.where(admissible, cos - lever, -np.inf)
    row, column = np.unravel_index(int(score.argmax()), score.shape)
    normal, depth = faces.normal[row, column], faces.depth[row, column]
    point = surface.rig.back_project(surface.x0 + x + column, surface.y0 + y + row, depth)
    slope = float(np.arccos(np.clip(cos[row, column], -1, 1)))
    best = float(np.clip(score[row, column], 0, 1))
    return StrikePlan((Strike(point, -normal, slope, float(faces.rms[row, column]), best),))
