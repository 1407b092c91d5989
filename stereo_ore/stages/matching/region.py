"""Where to match: the image rectangle and the disparities that the working volume can show."""

from __future__ import annotations

import math

import numpy as np

from stereo_ore.config import MatchingConfig
from stereo_ore.errors import ConfigError
from stereo_ore.types import F64, Region, Rig, Volume

MARGIN_PX = 8
"""Kept around the projected volume, so that the windows and paths at its rim see what is there."""

MARGIN_DISPARITY_PX = 2
MUCH_NEARER = 16
"""A volume that begins to be seen only this many times nearer is told to be too near; nearer ones
are taken for behind or beside the camera."""
_STEP = 16
"""OpenCV searches multiples of this many disparities."""

_FACES = ((0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5))
"""The sides of a box as cycles of `Volume.corners`."""


def find_region(rig: Rig, volume: Volume | None, config: MatchingConfig) -> Region:
    """The rectangle and the disparity range to search.

    Parameters
    ----------
    rig : Rig
        Geometry of the rectified pair.
    volume : Volume or None
        Working volume; None: the whole image and the default range.
    config : MatchingConfig
        Its explicit `min_disparity` and `num_disparities` win over the volume's.

    Raises
    ------
    ConfigError
        When no part of the volume is in view.
    """
    if volume is None or not config.use_region:
        x0, y0, x1, y1 = 0, 0, rig.width, rig.height
        lowest = max(0, math.floor(-rig.shift_px))
        count = default_disparities(rig.width)
    else:
        count = max(default_disparities(rig.width), config.num_disparities or 0)
        seen = visible_part(rig, volume, count)
        x0, y0, x1, y1 = _rectangle(rig, seen)
        lowest, count = _range(rig, seen)
    lowest = lowest if config.min_disparity is None else config.min_disparity
    count = count if config.num_disparities is None else config.num_disparities
    return Region(x0, y0, x1, y1, lowest, round_up(count))


def default_disparities(width: int) -> int:
    """256 disparities at 1280 px of width, in proportion at others."""
    return round_up(math.ceil(width / 5))


def nearest_m(rig: Rig, count: int) -> float:
    """Depth of the largest of `count` disparities as they are measured, which begin at 0 or, where
    those would lie behind the camera, at the first that does not.
    """
    return rig.fx * rig.baseline_m / (count + max(0.0, rig.shift_px))


def visible_part(rig: Rig, volume: Volume, count: int) -> F64:
    """Corners (n, 3) [m] of the part of the volume that is in view, as near as `count` disparities
    reach.

    The faces of the box are clipped by the planes of the view (Sutherland and Hodgman 1974).
    """
    near = nearest_m(rig, count)
    seen = _seen(rig, volume, near)
    if len(seen):
        return seen
    if len(_seen(rig, volume, near / MUCH_NEARER)):
        raise ConfigError(
            f"the working volume is in view, but nearer than the {near:.3g} m that {count}"
            " disparities reach",
            key="working_volume",
            remedy="Set matching.num_disparities, or check disparity_offset_px and baseline of the"
            " calibration",
        )
    raise ConfigError(
        "no part of the working volume is in the camera's view",
        key="working_volume",
        remedy="Check its limits and frame, and arm_from_camera",
    )


def _seen(rig: Rig, volume: Volume, near: float) -> F64:
    """Corners (n, 3) [m] of what is in view beyond z = `near`; none where nothing is."""
    planes, corners = _view_planes(rig), volume.corners
    parts = [_clip(corners[list(face)], planes, near) for face in _FACES]
    rim = rig.back_project([0, rig.width, 0, rig.width], [0, 0, rig.height, rig.height], near)
    return np.concatenate([*parts, rim[volume.contains(rim)]])


def _view_planes(rig: Rig) -> F64:
    """Inward normals (4, 3) of the view's sides; they pass through the camera."""
    left, right = (0 - rig.cx) / rig.fx, (rig.width - rig.cx) / rig.fx
    top, bottom = (0 - rig.cy) / rig.fy, (rig.height - rig.cy) / rig.fy
    return np.array([[1, 0, -left], [-1, 0, right], [0, 1, -top], [0, -1, bottom]], float)


def _clip(polygon: F64, planes: F64, near: float) -> F64:
    """The part of a convex polygon (n, 3) inside the side planes and beyond z = near."""
    for normal, offset in [*((n, 0.0) for n in planes), (np.array([0.0, 0.0, 1.0]), near)]:
        side = polygon @ normal - offset
        kept = []
        for i in range(len(polygon)):
            j = (i + 1) % len(polygon)
            if side[i] >= 0:
                kept.append(polygon[i])
            if (side[i] >= 0) != (side[j] >= 0):
                kept.append(polygon[i] + (polygon[j] - polygon[i]) * side[i] / (side[i] - side[j]))
        polygon = np.array(kept).reshape(-1, 3)
    return polygon


def _rectangle(rig: Rig, seen: F64) -> tuple[int, int, int, int]:
    uv = rig.project(seen)
    x0, y0 = np.maximum(np.floor(uv.min(0)) - MARGIN_PX, 0).astype(int)
    x1, y1 = np.minimum(np.ceil(uv.max(0)) + MARGIN_PX, [rig.width, rig.height]).astype(int)
    return int(x0), int(y0), int(x1), int(y1)


def _range(rig: Rig, seen: F64) -> tuple[int, int]:
    """Smallest disparity, before the calibration's correction, and how many."""
    d = rig.disparity(seen[:, 2]) - rig.disparity_offset_px
    lowest = math.floor(d.min()) - MARGIN_DISPARITY_PX
    return lowest, math.ceil(d.max()) + MARGIN_DISPARITY_PX - lowest + 1


def round_up(count: int) -> int:
    """The next multiple of `_STEP`, at least one."""
    count = max(count, 1)
    return -(-count // _STEP) * _STEP
