"""A run's results as a ROS 2 bag in MCAP, which Foxglove and ``ros2 bag`` open: clouds, lumps,
targets, overlays.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from stereo_ore.errors import MissingExtraError, OutputError
from stereo_ore.export.ros_types import VISION_MSGS
from stereo_ore.io.atomic import guarded
from stereo_ore.io.results import Results
from stereo_ore.io.ros_frame import Base, RosFrame, Types
from stereo_ore.record import to_line
from stereo_ore.types import Json

_STATIC = "/tf_static"
UNKNOWN_PERIOD_NS = 1_000_000_000
"""Frames without a stamp are put this far apart, from the beginning of time on: no stamp is made up
that looks real."""

_Message = tuple[str, Any]
"""Topic and message."""


def write_mcap(results: Results, path: Path) -> Path:
    """Write the frames of a run as folder `path` with a ``.mcap`` file and ``metadata.yaml``; the
    path of the former.

    Topics: ``/stereo_ore/cloud`` PointCloud2, ``/stereo_ore/ores`` Detection3DArray,
    ``/stereo_ore/targets`` PoseArray (x along the way of the tool; arm frame if known),
    ``/stereo_ore/overlay`` CompressedImage, ``/stereo_ore/record`` String (the record as JSON),
    ``/tf_static`` where the arm is known.

    Raises
    ------
    MissingExtraError
        Without the rosbags package.
    OutputError
        When the folder exists or can't be written.
    """
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError:
        raise MissingExtraError("rosbags", "bags") from None
    if path.exists():
        raise OutputError("exists already", file=path, remedy="Name another folder, or remove it")
    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, definition in VISION_MSGS.items():
        store.register(get_types_from_msg(definition, name))
    records = results.records

    def write() -> None:
        connections: dict[str, Any] = {}
        with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
            for record in records:
                stamp_ns = stamp_of(record)
                for topic, message in _messages(
                    results, record, store.types, first=record is records[0]
                ):
                    if topic not in connections:
                        offered = _latched() if topic == _STATIC else ()
                        connections[topic] = bag.add_connection(
                            topic,
                            message.__msgtype__,
                            typestore=store,
                            offered_qos_profiles=offered,
                        )
                    bag.write(
                        connections[topic],
                        stamp_ns,
                        store.serialize_cdr(message, message.__msgtype__),
                    )

    try:
        guarded(path, write)
    except BaseException:
        shutil.rmtree(path, ignore_errors=True)
        raise
    return path / f"{path.name}.mcap"


def _latched() -> tuple[Any, ...]:
    """Quality of service that listeners to static transforms ask for (REP 2003); without it they
    get none.
    """
    from rosbags.interfaces import (
        Qos,
        QosDurability,
        QosHistory,
        QosLiveliness,
        QosReliability,
        QosTime,
    )

    unlimited = QosTime(2147483647, 4294967295)
    reliable, durable = QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL
    liveliness = QosLiveliness.SYSTEM_DEFAULT
    return (
        Qos(
            QosHistory.KEEP_LAST,
            1,
            reliable,
            durable,
            unlimited,
            unlimited,
            liveliness,
            unlimited,
            False,
        ),
    )


def stamp_of(record: Json) -> int:
    """The frame's stamp [ns], or its place in time when it has none."""
    return int(
        record["stamp_ns"]
        if record["stamp_ns"] is not None
        else record["index"] * UNKNOWN_PERIOD_NS
    )


def _messages(results: Results, record: Json, types: Types, first: bool) -> Iterable[_Message]:
    """All messages of a frame."""
    ros, frame = RosFrame(types, stamp_of(record)), record["frame"]
    if first and results.site.T_arm_camera is not None:
        yield _STATIC, ros.transform(results.site.T_arm_camera)
    if (cloud := results.cloud(frame)) is not None:
        yield "/stereo_ore/cloud", ros.cloud(cloud)
    yield "/stereo_ore/ores", ros.detections(record)
    base: Base = "arm" if record["arm_frame"] else "camera"
    yield "/stereo_ore/targets", ros.targets(record, base, record["targets"])
    if (overlay := results.overlay(frame)) is not None:
        yield "/stereo_ore/overlay", ros.picture(overlay.read_bytes())
    yield "/stereo_ore/record", types["std_msgs/msg/String"](data=to_line(record))
