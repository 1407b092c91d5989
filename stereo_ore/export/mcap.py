"""A run's results as a ROS 2 bag in MCAP, which Foxglove and ``ros2 bag`` open: clouds, lumps,
targets, overlays.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from stereo_ore.errors import MissingExtraError, OutputError
from stereo_ore.io.atomic import guarded
from stereo_ore.io.results import Results
from stereo_ore.io.ros_channels import (
    STATIC_TOPIC,
    Topical,
    files_of,
    found_in,
    stamp_of,
    typestore,
)
from stereo_ore.io.ros_frame import RosFrame, Types
from stereo_ore.types import Json


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
    except ImportError:
        raise MissingExtraError("rosbags", "bags") from None
    if path.exists():
        raise OutputError("exists already", file=path, remedy="Name another folder, or remove it")
    store = typestore()
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
                        offered = _latched() if topic == STATIC_TOPIC else ()
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


def _messages(results: Results, record: Json, types: Types, first: bool) -> Iterable[Topical]:
    """All messages of a frame."""
    if first and results.site.T_arm_camera is not None:
        ros = RosFrame(types, stamp_of(record))
        yield STATIC_TOPIC, ros.transform(results.site.T_arm_camera)
    yield from files_of(results, record, types)
    yield from found_in(record, types, record["targets"])
