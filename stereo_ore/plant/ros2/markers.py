"""Lumps, their labels, the screen and the strikes of a frame as markers of RViz and Foxglove."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from stereo_ore.io.ros_frame import RosFrame, box_axes, x_along
from stereo_ore.types import JsonMapping, Rig

CUBE, _ARROW, TEXT, TRIANGLES = 1, 0, 9, 11
ADD, DELETE_ALL = 0, 3
Colour = tuple[float, float, float, float]
_OVERSIZE: dict[bool | None, Colour] = {
    True: (1.0, 0.24, 0.24, 0.45),
    False: (0.35, 0.86, 0.43, 0.45),
    None: (1.0, 0.7, 0.16, 0.45),
}
"""Colours of lumps that are oversize, that pass, and of which that is not known: red, green, amber
as in the overlay; red, green, blue, opacity."""
SCREEN_COLOUR: Colour = (0.6, 0.65, 0.7, 0.25)
STRIKE_COLOUR: Colour = (0.1, 0.9, 1.0, 1.0)
_WHITE: Colour = (1.0, 1.0, 1.0, 1.0)
LETTER_SHARE, LEAST_LETTER_M = 0.4, 0.02
"""Height of a label: a share of the lump's middle dimension."""
ARROW_M, SHAFT_M = 0.15, 0.015
_FARTHEST_M = 100.0
"""A screen whose corners lie beyond is seen edge on and not drawn."""


def lump_markers(ros: RosFrame, record: JsonMapping, rig: Rig, lifetime_s: float) -> Any:
    """MarkerArray of boxes (``lumps``), numbers and sizes (``labels``) and the part of the
    screen that is seen (``screen``), in the camera's frame.
    """
    found = [_clear(ros)]
    if (corners := screen_corners(record, rig)) is not None:
        found.append(_screen(ros, corners, lifetime_s))
    for ore in record["ores"]:
        if ore["box"]:
            found += [_lump(ros, ore, lifetime_s), _label(ros, ore, lifetime_s)]
    return ros.types["visualization_msgs/msg/MarkerArray"](markers=found)


def strikes(ros: RosFrame, record: JsonMapping, ids: Sequence[int], lifetime_s: float) -> Any:
    """MarkerArray of arrows that end where the tool is to hit (``strikes``), best first, in the
    camera's frame.
    """
    found = [_clear(ros)]
    plans = {ore["id"]: ore["strike"] for ore in record["ores"]}
    for rank, id in enumerate(ids):
        point = np.array(plans[id]["point"]["camera"])
        direction = np.array(plans[id]["direction"]["camera"])
        pose = ros.pose(point - ARROW_M * direction, x_along(direction))
        scale = (ARROW_M, SHAFT_M, SHAFT_M)
        found.append(_marker(ros, "strikes", rank, _ARROW, pose, scale, STRIKE_COLOUR, lifetime_s))
    return ros.types["visualization_msgs/msg/MarkerArray"](markers=found)


def no_markers(ros: RosFrame) -> Any:
    """MarkerArray that removes what is shown."""
    return ros.types["visualization_msgs/msg/MarkerArray"](markers=[_clear(ros)])


def screen_corners(record: JsonMapping, rig: Rig) -> npt.NDArray[np.float64] | None:
    """Where the rays of the image's corners (4, 3) meet the screen's plane [m], in the camera's
    frame; None where there is no plane, or where it is seen edge on.
    """
    plane = record["grizzly"]
    if plane is None or plane["normal"] is None or plane["offset_m"] is None:
        return None
    u, v = np.array([0, rig.width, rig.width, 0]), np.array([0, 0, rig.height, rig.height])
    rays = rig.back_project(u, v, 1.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = plane["offset_m"] / (rays @ np.array(plane["normal"]))
    seen = bool(np.all((depth > 0) & (depth < _FARTHEST_M)))
    return rays * depth[:, None] if seen else None


def _screen(ros: RosFrame, corners: npt.NDArray[np.float64], lifetime_s: float) -> Any:
    pose = ros.pose((0, 0, 0), np.eye(3))
    marker = _marker(ros, "screen", 0, TRIANGLES, pose, (1, 1, 1), SCREEN_COLOUR, lifetime_s)
    marker.points = [
        ros.types["geometry_msgs/msg/Point"](
            **dict(zip("xyz", map(float, corners[i]), strict=True))
        )
        for i in (0, 1, 2, 0, 2, 3)
    ]
    return marker


def _lump(ros: RosFrame, ore: JsonMapping, lifetime_s: float) -> Any:
    pose = ros.pose(ore["box"]["camera"]["centre"], box_axes(ore))
    colour = _OVERSIZE[ore["oversize"]]
    return _marker(ros, "lumps", ore["id"], CUBE, pose, ore["box"]["extent_m"], colour, lifetime_s)


def _label(ros: RosFrame, ore: JsonMapping, lifetime_s: float) -> Any:
    pose = ros.pose(ore["box"]["camera"]["centre"], np.eye(3))
    height = max(LEAST_LETTER_M, LETTER_SHARE * sorted(ore["box"]["extent_m"])[1])
    marker = _marker(ros, "labels", ore["id"], TEXT, pose, (0, 0, height), _WHITE, lifetime_s)
    size = " × ".join(f"{length:.2f}" for length in ore["size_m"]) if ore["size_m"] else ""
    marker.text = f"{ore['id']}\n{size} m" if size else str(ore["id"])
    return marker


def _clear(ros: RosFrame) -> Any:
    """Removes what an earlier frame has shown."""
    return ros.types["visualization_msgs/msg/Marker"](
        header=ros.header(ros.camera_frame), action=DELETE_ALL
    )


def _marker(
    ros: RosFrame,
    namespace: str,
    id: int,
    kind: int,
    pose: Any,
    scale: Iterable[float],
    colour: Colour,
    lifetime_s: float,
) -> Any:
    red, green, blue, opacity = colour
    seconds, rest = divmod(max(1, round(lifetime_s * 1e9)), 10**9)  # a lifetime of 0 is for ever
    return ros.types["visualization_msgs/msg/Marker"](
        header=ros.header(ros.camera_frame),
        ns=namespace,
        id=id,
        type=kind,
        action=ADD,
        pose=pose,
        scale=ros.vector(list(scale)),
        color=ros.types["std_msgs/msg/ColorRGBA"](r=red, g=green, b=blue, a=opacity),
        lifetime=ros.types["builtin_interfaces/msg/Duration"](sec=seconds, nanosec=rest),
    )
