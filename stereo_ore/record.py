"""The record of a frame: `FrameResult` → the JSON object that other programs read
(schema/frame-2.json).
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable

import numpy.typing as npt

from stereo_ore.losses import losses
from stereo_ore.types import (
    ForeignBody,
    FrameResult,
    Grizzly,
    Json,
    Ore,
    Reason,
    Registration,
    Site,
    Solid,
    Strike,
)

SCHEMA = "stereo_ore/frame/2"
DECIMALS = 6
"""Metres are written to the micrometre: finer digits are noise, and would differ between
machines."""


def record(result: FrameResult, site: Site) -> Json:
    """The record of one frame; lengths in metres, camera frame and, where the site gives it, arm
    frame.
    """
    return {
        "schema": SCHEMA,
        "frame": result.name,
        "index": result.index,
        "stamp_ns": result.stamp_ns,
        "stamp_source": result.stamp_source,
        "status": result.status,
        "reasons": _reasons(result.reasons),
        "units": "m",
        "camera_frame": "left_rectified",
        "arm_frame": "arm" if site.T_arm_camera is not None else None,
        "counts": dict(result.counts),
        "losses": [vars(loss) for loss in losses(result)],
        "grizzly": _grizzly(result.grizzly, result.fines_share),
        "foreign": [_foreign(body) for body in result.foreign],
        "ores": [_ore(ore) for ore in result.ores],
        "targets": list(result.targets),
        "withheld": list(result.withheld),
        "tracks": {"started": [], "ended": []},
    }


def to_line(data: Json) -> str:
    """One line of JSON without spaces; raises ValueError for a NaN, which JSON does not have."""
    return json.dumps(data, ensure_ascii=False, allow_nan=False, separators=(",", ":"))


def number(value: float) -> float | None:
    """A rounded number; null for what is not finite. Minus zero becomes zero."""
    return round(float(value), DECIMALS) + 0.0 if math.isfinite(value) else None


def _numbers(values: npt.ArrayLike | Iterable[float]) -> list[float | None]:
    """Rounded numbers of a vector."""
    return [number(value) for value in values]  # type: ignore[union-attr,arg-type]


def _reasons(reasons: Iterable[Reason]) -> list[Json]:
    return [{"code": reason.code, "detail": reason.detail} for reason in reasons]


def _grizzly(grizzly: Grizzly | None, fines_share: float | None) -> Json | None:
    if grizzly is None:
        return None
    rms = None if grizzly.rms_m is None else number(grizzly.rms_m)
    plane = grizzly.plane
    return {
        "normal": _numbers(plane.normal),
        "offset_m": number(plane.offset),
        "source": grizzly.source,
        "rms_m": rms,
        "openings_m": None if grizzly.openings_m is None else _numbers(grizzly.openings_m),
        "registration": _registration(grizzly.registration),
        "fines_share": None if fines_share is None else number(fines_share),
    }


def _registration(moved: Registration | None) -> Json | None:
    """How far from their place the bars were measured, and what was taken off the disparity; null
    where unknown.
    """
    if moved is None:
        return None
    return {
        "offset_m": number(moved.offset_m),
        "tilt_deg": number(math.degrees(moved.tilt_rad)),
        "worst_m": number(moved.worst_m),
        "sigma_m": number(moved.sigma_m),
        "slide_m": None if moved.slide_m is None else number(moved.slide_m),
        "turn_deg": None if moved.turn_rad is None else number(math.degrees(moved.turn_rad)),
        "field_px": _numbers(moved.field_px),
    }


def _foreign(body: ForeignBody) -> Json:
    return {
        "name": body.name,
        "source": body.source,
        "pixels": body.pixels,
        "share": number(body.share),
        "outline_px": body.outline_px.tolist(),
    }


def _in_frames(part: Ore | Solid | Strike, vector: str) -> Json:
    """A vector of a lump in the camera's and, where it is known, the arm's frame."""
    arm = None if part.arm is None else _numbers(getattr(part.arm, vector))
    return {"camera": _numbers(getattr(part, vector)), "arm": arm}


def _ore(ore: Ore) -> Json:
    best, *others = ore.plan.strikes or (None,)
    strike = None
    if best is not None:
        strike = _strike(best) | {"alternates": [_strike(other) for other in others]}
    solid = ore.solid
    return {
        "id": ore.id,
        "track": None,
        "points": ore.points,
        "pixels": ore.pixels,
        "cut": ore.cut,
        "carries": list(ore.carries),
        "carried_by": list(ore.carried_by),
        "surface_centroid": _in_frames(ore, "surface_centroid"),
        **_solid(solid),
        "strike": strike,
        "reasons": _reasons((*ore.reasons, *(solid.reasons if solid else ()), *ore.plan.reasons)),
    }


def _solid(solid: Solid | None) -> Json:
    if solid is None:
        keys = ("centre_of_gravity", "volume_m3", "volume_bounds_m3", "size_m", "box", "oversize")
        return dict.fromkeys(keys)
    centre = _in_frames(solid, "centre_of_gravity")
    centre |= {"sigma_m": _numbers(solid.sigma_m), "method": solid.method}
    axes = [_numbers(axis) for axis in solid.axes]
    return {
        "centre_of_gravity": centre,
        "volume_m3": number(solid.volume_m3),
        "volume_bounds_m3": _numbers(solid.volume_bounds_m3),
        "size_m": _numbers(solid.size_m),
        "box": {
            "camera": {"centre": _numbers(solid.box_centre), "axes": axes},
            "extent_m": _numbers(solid.extent_m),
        },
        "oversize": solid.oversize,
    }


def _strike(strike: Strike) -> Json:
    return {
        "point": _in_frames(strike, "point"),
        "direction": _in_frames(strike, "direction"),
        "slope_deg": number(math.degrees(strike.slope_rad)),
        "flatness_m": number(strike.flatness_m),
        "score": number(strike.score),
    }
