"""What is in view and is no ore: places that the site names, and what stands over the screen by
itself.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from scipy.spatial import cKDTree

from stereo_ore.config import ForeignConfig
from stereo_ore.stages.foreign.places import distances, inside
from stereo_ore.stages.foreign.posture import arm_places
from stereo_ore.stages.foreign.stance import standing
from stereo_ore.types import (
    F32,
    F64,
    ForeignBody,
    Grizzly,
    KeepOut,
    Mask,
    OreMap,
    Reason,
    StrikePlan,
    Surface,
)

__all__ = [
    "Foreign",
    "arm_places",
    "clear_of",
    "cleared",
    "find_foreign",
    "foreign_doubts",
    "places",
    "without_foreign",
]

MOST_OF = 0.5
"""Share of a lump on a body from which on it is no lump but a part of the body."""
OUTLINE_PX = 1.5
"""Deviation of a reported outline from the pixels."""
_POINTS = 4000
"""Points of bodies that strikes keep clear of."""


@dataclass(frozen=True)
class Foreign:
    """Pixels of bodies in the surface: `mask` (h, w), the band around them included; `xyz` (N, 3)
    [m], points on them; what is told of each; and the site's places, for distances.
    """

    mask: Mask
    xyz: F64
    bodies: tuple[ForeignBody, ...] = ()
    places: tuple[KeepOut, ...] = ()

    @property
    def found_share(self) -> float:
        """Share of the view that bodies cover which the site does not name."""
        return sum(body.share for body in self.bodies if body.source == "image")


def places(surface: Surface, keep_out: Sequence[KeepOut]) -> Foreign:
    """What of the surface lies in the site's places, which are taken as they are."""
    masks = [inside(surface, place) for place in keep_out]
    bodies = tuple(
        _body(place.name, place.source, mask, surface)
        for place, mask in zip(keep_out, masks, strict=True)
        if mask.any()
    )
    mask = np.logical_or.reduce(masks) if masks else np.zeros(surface.sigma_z.shape, np.bool_)
    return Foreign(mask, _points(surface, mask), bodies, tuple(keep_out))


def find_foreign(
    surface: Surface, screen: Grizzly, opening_m: float, known: Foreign, config: ForeignConfig
) -> Foreign:
    """`known`, and what stands or hangs over the screen by itself.

    Parameters
    ----------
    surface : Surface
        Without what is known.
    screen : Grizzly
        Its plane.
    opening_m : float
        Clear distance between bars, or the scale that stands for it.
    known : Foreign
        Found so far.
    config : ForeignConfig
        Limits.
    """
    if not config.find:
        return known
    labels = standing(surface, screen, opening_m, config)
    count = int(labels.max(initial=0))
    bodies = tuple(
        _body(f"body {number}", "image", labels == number, surface)
        for number in range(1, count + 1)
    )
    if not bodies:
        return known
    points = _points(surface, labels > 0)
    reach = round(config.margin * opening_m * surface.rig.fx / float(np.median(points[:, 2])))
    kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    mask = cv2.dilate((labels > 0).astype(np.uint8), kernel) > 0
    return replace(
        known,
        mask=known.mask | mask,
        xyz=np.concatenate([known.xyz, points]),
        bodies=known.bodies + bodies,
    )


def without_foreign(surface: Surface, foreign: Foreign) -> Surface:
    """The surface as if the bodies had not been measured."""
    if not foreign.mask.any():
        return surface
    xyz = np.where(foreign.mask[..., None], np.float32(np.nan), surface.xyz)
    return replace(surface, xyz=xyz, sigma_z=_nan_where(foreign.mask, surface.sigma_z))


def cleared(ore_map: OreMap, foreign: Foreign, surface: Surface) -> OreMap:
    """The map without lumps that are mostly body, and without what others have of one."""
    if not foreign.mask.any():
        return ore_map
    h, w = foreign.mask.shape
    labels = ore_map.labels.copy()
    crop = labels[surface.y0 : surface.y0 + h, surface.x0 : surface.x0 + w]
    count = int(labels.max(initial=0))
    whole = np.bincount(crop.ravel(), minlength=count + 1)
    lost = np.bincount(crop[foreign.mask], minlength=count + 1)
    crop[foreign.mask] = 0
    kept = lost < MOST_OF * np.maximum(whole, 1)
    kept[0] = False
    number = np.where(kept, np.cumsum(kept), 0).astype(np.int16)
    told = {**ore_map.diagnostics, "dropped_foreign": int(count - kept.sum())}
    cut = frozenset(int(number[id]) for id in ore_map.cut if number[id])
    crop[:] = number[crop]
    return OreMap(labels, cut, told)


def clear_of(
    plans: Sequence[StrikePlan], foreign: Foreign, opening_m: float, config: ForeignConfig
) -> tuple[StrikePlan, ...]:
    """The plans without strikes near a body; NEAR_FOREIGN_BODY where none is left."""
    if not foreign.bodies and not foreign.places:
        return tuple(plans)
    tree = cKDTree(foreign.xyz) if len(foreign.xyz) else None
    return tuple(_clear(plan, foreign, tree, config.clearance * opening_m) for plan in plans)


def foreign_doubts(foreign: Foreign) -> Iterator[Reason]:
    """FOREIGN_BODY for each body that the site does not name."""
    for body in foreign.bodies:
        if body.source == "image":
            u, v = np.rint(body.outline_px.mean(0)).astype(int)
            yield Reason(
                "FOREIGN_BODY",
                f"{body.name} at ({u}, {v}) px stands or hangs over the screen, higher than wide,"
                f" and covers {100 * body.share:.1f} % of the view: no ore, and no target near it",
            )


def _clear(
    plan: StrikePlan, foreign: Foreign, tree: cKDTree | None, clearance_m: float
) -> StrikePlan:
    if not plan.strikes:
        return plan
    points = np.array([strike.point for strike in plan.strikes])
    near = distances(points, foreign.places)
    if tree is not None:
        near = np.minimum(near, tree.query(points)[0])
    left = tuple(strike for strike, d in zip(plan.strikes, near, strict=True) if d > clearance_m)
    if left:
        return replace(plan, strikes=left)
    text = f"{1000 * near.min():.0f} mm from a foreign body, {1000 * clearance_m:.0f} mm are kept"
    return StrikePlan((), (Reason("NEAR_FOREIGN_BODY", f"{text} (foreign.clearance)"),))


def _points(surface: Surface, mask: Mask) -> F64:
    """Measured points (N, 3) [m] of some pixels, `_POINTS` at most."""
    seen = surface.xyz[mask & np.isfinite(surface.xyz[..., 2])]
    return np.asarray(seen[:: 1 + len(seen) // _POINTS], np.float64)


def _body(
    name: str, source: Literal["site", "arm", "image"], mask: Mask, surface: Surface
) -> ForeignBody:
    contours = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    largest = max(contours, key=cv2.contourArea)
    outline = cv2.approxPolyDP(largest, OUTLINE_PX, True)[:, 0] + [surface.x0, surface.y0]
    return ForeignBody(name, source, int(mask.sum()), float(mask.mean()), outline.astype(np.int32))


def _nan_where(mask: Mask, values: F32) -> F32:
    return np.where(mask, np.float32(np.nan), values)
