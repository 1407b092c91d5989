"""What a frame's results are as ROS messages on topics, where there is no ROS: in bags and for
Foxglove.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from stereo_ore.errors import MissingExtraError
from stereo_ore.io.results import Results
from stereo_ore.io.ros_frame import Base, RosFrame, Types
from stereo_ore.record import to_line
from stereo_ore.types import JsonMapping

Topical = tuple[str, Any]
"""Topic and message."""
STATIC_TOPIC = "/tf_static"
UNKNOWN_PERIOD_NS = 1_000_000_000
"""Frames without a stamp are put this far apart, from the beginning of time on: no stamp is made up
that looks real."""

_VISION_MSGS = {
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score\n",
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n"
    ),
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "vision_msgs/msg/Detection3D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox3D bbox\nstring id\n"
    ),
    "vision_msgs/msg/Detection3DArray": (
        "std_msgs/Header header\nvision_msgs/Detection3D[] detections\n"
    ),
}
"""Definitions that rosbags does not ship: vision_msgs 4, as ROS 2 Humble and later publish it."""


def typestore() -> Any:
    """The types of all messages here; ``types`` makes them, ``serialize_cdr`` makes octets.

    Raises
    ------
    MissingExtraError
        Without the rosbags package.
    """
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError:
        raise MissingExtraError("rosbags", "bags") from None
    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, definition in _VISION_MSGS.items():
        store.register(get_types_from_msg(definition, name))
    return store


def stamp_of(record: JsonMapping) -> int:
    """The frame's stamp [ns], or its place in time when it has none."""
    stamp_ns = record["stamp_ns"]
    return int(record["index"] * UNKNOWN_PERIOD_NS if stamp_ns is None else stamp_ns)


def found_in(record: JsonMapping, types: Types, targets: Sequence[int]) -> Iterator[Topical]:
    """What was found in a frame; `targets` are the lumps to strike, best first."""
    ros = RosFrame(types, stamp_of(record))
    yield "/stereo_ore/ores", ros.detections(record)
    base: Base = "arm" if record["arm_frame"] else "camera"
    yield "/stereo_ore/targets", ros.targets(record, base, targets)
    yield "/stereo_ore/record", types["std_msgs/msg/String"](data=to_line(dict(record)))


def files_of(results: Results, record: JsonMapping, types: Types) -> Iterator[Topical]:
    """Cloud and overlay of a frame, as far as the run's folder has them."""
    ros, frame = RosFrame(types, stamp_of(record)), record["frame"]
    if (cloud := results.cloud(frame)) is not None:
        yield "/stereo_ore/cloud", ros.cloud(cloud)
    if (overlay := results.overlay(frame)) is not None:
        yield "/stereo_ore/overlay", ros.picture(overlay.read_bytes())
