"""Where and in which direction the tool may strike a lump."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import find_objects

from stereo_ore.config.models import StrikeConfig
from stereo_ore.planes import crop_rig, fit_planes
from stereo_ore.transforms import transform_points
from stereo_ore.types import (
    F32,
    F64,
    I16,
    Grizzly,
    Mask,
    OreMap,
    Plane,
    Reason,
    Rig,
    Site,
    Solid,
    Strike,
    StrikePlan,
    Surface,
)

PATCH_PIXELS = 1500
"""Larger lumps are searched with a stride, for time."""
NOISE_SPREAD = 2.0
"""How much neighbouring pixels' common errors raise a plane's tilt over that from independent
ones."""
NORMAL_SIGMA = 0.07
"""Tilt error [rad] wanted of a fitted plane; the window grows until noise allows it."""
_LARGEST_WINDOW = 0.35
"""Largest side of the window as share of the lump's."""
CRITERIA = {
    "UNCERTAIN_DEPTH": "no patch of the tool's size is measured well enough",
    "NEAR_EDGE": "no place keeps the clearance from the lump's edge, its neighbours and the bars",
    "TOO_SMALL_PATCH": "no patch of the tool's diameter is flat enough",
    "TOO_STEEP": "no face within the permitted angle of the tool's axis",
    "OUT_OF_REACH": "no admissible face within the arm's reach",
}
"""What a place must satisfy, in the order of the tests; the first that nothing passes is the
reason."""


def plans(
    surface: Surface,
    ore_map: OreMap,
    solids: Sequence[Solid | None],
    grizzly: Grizzly,
    site: Site,
    config: StrikeConfig,
) -> tuple[StrikePlan, ...]:
    """Choose the strikes of every lump.

    A place is admissible when a patch of the tool's diameter around it is measured, flat, facing
    within the permitted angle of the tool's axis (the screen's normal), away from edges, neighbours
    and bars, and within reach. The best is flat, faces the tool and lies near the normal through
    the centre of gravity.

    Returns
    -------
    tuple
        Entry i belongs to id i + 1: strikes best first, or none and the reason, a key of
        `CRITERIA`.
    """
    h, w = surface.sigma_z.shape
    labels = ore_map.labels[surface.y0 : surface.y0 + h, surface.x0 : surface.x0 + w]
    boxes = find_objects(labels, max_label=len(solids)) if solids else []
    return tuple(
        _plan(_patches(surface, labels, box, number, config), solid, grizzly.plane, site, config)
        if solid and box
        else _none("UNCERTAIN_DEPTH")
        for number, (solid, box) in enumerate(zip(solids, boxes, strict=True), 1)
    )


@dataclass(frozen=True)
class Patches:
    """Planes around a lump's N measured pixels.

    Point (N, 3) and normal (N, 3); by pixel (N,), in metres, the residual `rms`, the distance to
    the lump's `edge` and the depth noise `sigma_z`; `share` of the window that was measured.
    """

    xyz: F64
    normal: F64
    rms: F64
    edge: F64
    sigma_z: F64
    share: F64


def _patches(
    surface: Surface, labels: I16, box: tuple[slice, ...], number: int, config: StrikeConfig
) -> Patches:
    stride = max(1, round(float(np.sqrt((labels[box] == number).sum() / PATCH_PIXELS))))
    rows, columns = (slice(s.start, s.stop, stride) for s in box)
    lump, z = labels[rows, columns] == number, np.ascontiguousarray(surface.xyz[rows, columns, 2])
    seen = lump & np.isfinite(z)
    rig = crop_rig(surface.rig, surface.x0 + columns.start, surface.y0 + rows.start, stride)
    sigma_z = surface.sigma_z[rows, columns][seen].astype(np.float64)
    side = _window(z[seen], sigma_z, int(lump.sum()), rig, config)
    field = fit_planes(z, seen.astype(np.float32), side, rig)
    rimmed = cv2.copyMakeBorder(lump.astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT)
    edge_px = cv2.distanceTransform(rimmed, cv2.DIST_L2, 3)[1:-1, 1:-1]
    v, u = np.nonzero(seen)
    depth = field.depth(seen)
    return Patches(
        rig.back_project(u, v, depth), field.normal(seen), field.rms[seen].astype(np.float64),
        edge_px[seen] * depth / rig.fx, sigma_z, field.share[seen].astype(np.float64),
    )  # fmt: skip


def _window(z_m: F32, sigma_z: F64, pixels: int, rig: Rig, config: StrikeConfig) -> int:
    """Odd side [px] of the fitted window: the tool's diameter, or more where noise demands it.

    A slope fitted to n × n points of spacing p and noise σ has the standard deviation √12·σ/(n²·p).
    """
    if not len(z_m):
        return 3
    pixel_m = float(np.median(z_m)) / rig.fx
    steady = np.sqrt(
        np.sqrt(12.0) * NOISE_SPREAD * float(np.median(sigma_z)) / (NORMAL_SIGMA * pixel_m)
    )
    side = min(max(config.tool_diameter_m / pixel_m, steady), _LARGEST_WINDOW * np.sqrt(pixels))
    return 2 * int(max(side, 3.0) / 2) + 1


def _plan(
    patches: Patches, solid: Solid, plane: Plane, site: Site, config: StrikeConfig
) -> StrikePlan:
    cos = patches.normal @ plane.normal
    passes = _tests(patches, cos, plane, site, config)
    admissible = np.ones(len(cos), bool)
    for code in CRITERIA:
        admissible &= passes[code]
        if not admissible.any():
            return _none(code)
    left = Patches(*(value[admissible] for value in vars(patches).values()))
    score = _scores(left, cos[admissible], solid, plane, config)
    return StrikePlan(tuple(_ranked(left, score, cos[admissible], config)))


def _none(code: str) -> StrikePlan:
    return StrikePlan((), (Reason(code, CRITERIA[code]),))


def _tests(
    patches: Patches, cos: F64, plane: Plane, site: Site, config: StrikeConfig
) -> dict[str, Mask]:
    """Which pixels (N,) pass each of `CRITERIA`."""
    keep_off = 0.5 * config.tool_diameter_m + config.clearance_m
    above_bars = plane.height(patches.xyz) > config.clearance_m
    return {
        "UNCERTAIN_DEPTH": (patches.share > config.min_measured)
        & (patches.sigma_z < config.max_depth_sigma * patches.xyz[:, 2]),
        "NEAR_EDGE": (patches.edge >= keep_off) & above_bars,
        "TOO_SMALL_PATCH": patches.rms <= _flat_enough(patches, config),
        "TOO_STEEP": cos >= np.cos(config.max_slope_rad),
        "OUT_OF_REACH": _within_reach(patches.xyz, site),
    }


def _flat_enough(patches: Patches, config: StrikeConfig) -> F64:
    """Residual allowed [m]: the tool's tolerance, with the depth noise that no face can be free of.

    More than a depth may be unsure by is allowed for roughness only: what scatters further was
    measured worse than its noise foretells.
    """
    noisy = np.hypot(config.max_roughness_m, 2.0 * patches.sigma_z)
    sure = np.maximum(config.max_roughness_m, config.max_depth_sigma * patches.xyz[:, 2])
    return np.asarray(np.minimum(noisy, sure))


def _within_reach(xyz: F64, site: Site) -> Mask:
    inside = np.ones(xyz.shape[:-1], bool)
    if site.T_arm_camera is None or (site.reach_min_m is None and site.reach_max_m is None):
        return inside
    arm = transform_points(site.T_arm_camera, xyz)
    if site.reach_min_m is not None:
        inside &= (arm >= site.reach_min_m).all(-1)
    if site.reach_max_m is not None:
        inside &= (arm <= site.reach_max_m).all(-1)
    return inside


def _scores(patches: Patches, cos: F64, solid: Solid, plane: Plane, config: StrikeConfig) -> F64:
    """0…1 by slope, lever about the centre of gravity and roughness, each a bell curve of its own
    width.
    """
    offset = patches.xyz - solid.centre_of_gravity
    lever = np.sqrt(np.maximum((offset**2).sum(1) - (offset @ plane.normal) ** 2, 0.0))
    slope = np.arccos(np.clip(cos, -1.0, 1.0))
    terms = (
        (slope, config.max_slope_rad),
        (lever, config.lever_share * float(solid.size_m[0])),
        (patches.rms, 2.0 * _flat_enough(patches, config)),
    )
    return np.asarray(np.exp(-0.5 * sum((value / width) ** 2 for value, width in terms)))


def _ranked(patches: Patches, score: F64, cos: F64, config: StrikeConfig) -> list[Strike]:
    """The best strike and alternates, each at least a tool's diameter and a half from those
    before.
    """
    found: list[Strike] = []
    free = np.ones(len(score), bool)
    while len(found) <= config.alternates and free.any():
        at = int(np.where(free, score, -1.0).argmax())
        slope = float(np.arccos(np.clip(cos[at], -1.0, 1.0)))
        rms = float(patches.rms[at])
        found.append(Strike(patches.xyz[at], -patches.normal[at], slope, rms, float(score[at])))
        free &= ((patches.xyz - patches.xyz[at]) ** 2).sum(1) >= (1.5 * config.tool_diameter_m) ** 2
    return found
