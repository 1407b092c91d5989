"""Scale-free cues to a lump's hidden side: all lengths over the square root of its silhouette's
area.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from stereo_ore.stages.solid.measure import (
    Body,
    Box,
    convex_body,
    extremes,
    longest_calliper,
    smallest_box,
)
from stereo_ore.stages.solid.sight import NEAR, STEP, Sight
from stereo_ore.types import F64, Bars

FOOTPRINT = 0.6
"""Shrinking of the visible outline, seen from above, to what the lump stands on."""
LONGEST_SHADOW, LEAST_SLOPE = 1.5, 0.3
"""How deep a body may be behind its surface, as share of its size, and the least slope of a line of
sight."""
DIMENSIONS = ("longest", "middle", "shortest")


@dataclass(frozen=True)
class Cues:
    """Named cues: `even` ones do not change when the lump is mirrored sideways, `odd` ones change
    sign.

    `support` [m] is the height that seems to carry the lump; heights among the cues, and the
    estimate's, are over it. `body` is the hull of the visible surface and a shrunken footprint on
    the screen, the closed form that the cues correct, `box` its box; lump frame, metres.
    """

    even: dict[str, float]
    odd: dict[str, float]
    support: float
    body: Body
    box: Box


def gather_cues(sight: Sight, bars: Bars | None, opening_m: float | None) -> Cues | None:
    """Cues of a lump, or None when its visible points span no volume."""
    s = sight.size
    points = extremes(sight.points)
    corners = cv2.convexHull(sight.points[:, :2].astype(np.float32), returnPoints=False)
    if len(corners) < 3:
        return None
    outline = sight.points[corners[:, 0], :2]
    low, top = _percentiles(sight.points[:, 2], 0.5, 99.5)
    support = _support(sight, low)
    bodies = {
        "grounded": convex_body(np.vstack([points, _footprint(outline, min(0.0, low))])),
        "shadow": convex_body(np.vstack([points, _shadow(sight, points, support)])),
    }
    found = {name: body for name, body in bodies.items() if body is not None}
    if len(found) < len(bodies):
        return None
    even: dict[str, float] = {
        "top": (top - support) / s,
        "low": (low - support) / s,
        "support": support / s,
    }
    places = {name: body.centroid for name, body in found.items()}
    places |= {"outline": sight.outline.mean(0), "silhouette": sight.silhouette}
    for name, place in places.items():
        even |= {f"{name}_x": place[0] / s, f"{name}_z": (place[2] - support) / s}
    even["surface_z"] = (float(sight.points[:, 2].mean()) - support) / s
    grounded = found["grounded"]
    box = smallest_box(grounded)
    dims = (longest_calliper(grounded.vertices), *box.extent[1:])
    even |= {
        f"grounded_{key}": float(np.log(d / s)) for key, d in zip(DIMENSIONS, dims, strict=True)
    }
    even |= {f"{name}_volume": float(np.log(body.volume / s**3)) for name, body in found.items()}
    facing = sight.normals.mean(0)
    even |= {"tilt": sight.tilt, "solidity": sight.solidity, "normal_x": float(facing[0])}
    even |= (
        _view_cues(sight, points)
        | _ring_cues(sight, top, support)
        | _bar_cues(sight, outline, bars, opening_m)
    )
    odd = {name: float(place[1] / s) for name, place in places.items()} | {
        "normal": float(facing[1])
    }
    return Cues(even, odd, support, grounded, box)


def _footprint(outline: F64, height: float) -> F64:
    """Outline (K, 2) shrunk about its middle and laid at a height."""
    middle = outline.mean(0)
    return np.column_stack([middle + FOOTPRINT * (outline - middle), np.full(len(outline), height)])


def _shadow(sight: Sight, points: F64, support: float) -> F64:
    """Points (N, 3) moved on along the line of sight to what carries the lump: the most that they
    can hide.
    """
    way = (points[:, 2] - support) / max(-float(sight.view[2]), LEAST_SLOPE)
    return points + np.clip(way, 0.0, LONGEST_SHADOW * sight.size)[:, None] * sight.view


def _support(sight: Sight, low: float) -> float:
    """Height that the surroundings suggest for what carries the lump, between the screen and its
    lowest point.
    """
    ring = sight.ring
    near = (ring.gap < NEAR * sight.size) & (ring.step >= -STEP * sight.size)
    return _percentiles(np.clip(ring.outside[near], 0.0, max(low, 0.0)), 75)[0]


def _view_cues(sight: Sight, points: F64) -> dict[str, float]:
    """How the surface and its outline lie along the line of sight."""
    s, view = sight.size, sight.view
    up = np.array([0.0, 0.0, 1.0]) if sight.tilt > 0.15 else np.array([1.0, 0.0, 0.0])
    up = up - (up @ view) * view
    offset = sight.outline - sight.outline.mean(0)
    across, along = offset @ up, offset @ view / s
    far, near = across > 0.25 * across.max(), across < 0.25 * across.min()
    facing = sight.normals[:, 2]
    extent = np.ptp(points, axis=0) / s
    return {
        "extent_x": extent[0], "extent_y": extent[1], "extent_z": extent[2],
        "outline_far": _mean(along[far]), "outline_near": _mean(along[near]),
        "outline_side": _mean(along[~far & ~near]),
        "front": float((points @ view).min() - sight.outline.mean(0) @ view) / s,
        "back": float(along.max()),
        "facing": float(facing.mean()), "facing_spread": float(facing.std()),
        "frontal": float(-(sight.normals @ view).mean()),
    }  # fmt: skip


def _ring_cues(sight: Sight, top: float, support: float) -> dict[str, float]:
    """What lies around the outline: contact, occluders, gaps, neighbours, and how high."""
    ring, s, n = sight.ring, sight.size, max(sight.ring.count, 1)
    hides = ring.step < -STEP * s
    near = ~hides & (ring.gap < NEAR * s)
    heights = (np.clip(ring.outside[near], -0.2 * s, top) - support) / s
    carrying = ring.other & near
    share = carrying.sum() / n
    neighbour = (np.clip(ring.outside[carrying], 0.0, top) - support) / s
    found = {
        "contact": (np.abs(ring.step) <= STEP * s).sum() / n, "hidden": hides.sum() / n,
        "near": near.sum() / n,
        "others": ring.other.sum() / n, "others_near": share,
        "neighbour": _percentiles(neighbour, 50)[0] * min(1.0, 5.0 * share),
    }  # fmt: skip
    low, middle, high, highest = _percentiles(heights, 25, 50, 75, 90)
    return found | {"ring_25": low, "ring_50": middle, "ring_75": high, "ring_90": highest}


def _bar_cues(
    sight: Sight, outline: F64, bars: Bars | None, opening_m: float | None
) -> dict[str, float]:
    """How the lump's width compares with the opening, and how it lies over bars and gaps; neutral
    when unknown.
    """
    if opening_m is None:
        return {
            "opening": 0.9,
            "across": 1.5,
            "along": 1.5,
            "on_bars": 0.2,
            "off_bar": 0.25,
            "turn": 0.4,
        }
    found = {"opening": min(opening_m / sight.size, 2.5)}
    if bars is None:
        width = float(np.ptp(outline, axis=0).mean()) / opening_m
        return found | {
            "across": min(width, 3.0),
            "along": min(width, 3.0),
            "on_bars": 0.2,
            "off_bar": 0.25,
            "turn": 0.4,
        }
    across, along = sight.axes @ bars.across, sight.axes @ bars.direction
    phase = (sight.origin @ bars.across - bars.phase_m) / bars.pitch_m
    at = sight.points[:, :2] @ across[:2] / bars.pitch_m + phase
    return found | {
        "across": min(float(np.ptp(outline @ across[:2])) / opening_m, 3.0),
        "along": min(float(np.ptp(outline @ along[:2])) / opening_m, 3.0),
        "on_bars": float((np.abs(at - np.round(at)) * bars.pitch_m < 0.5 * bars.width_m).mean()),
        "off_bar": float(abs(phase - np.round(phase))),
        "turn": float(across[0] ** 2),
    }


def _percentiles(values: F64, *shares: float) -> list[float]:
    """Percentiles of values, zeros when there are none."""
    if not len(values):
        return [0.0] * len(shares)
    places = np.array(shares) / 100 * (len(values) - 1)
    return [float(value) for value in np.interp(places, np.arange(len(values)), np.sort(values))]


def _mean(values: F64) -> float:
    return float(values.mean()) if len(values) else 0.0
