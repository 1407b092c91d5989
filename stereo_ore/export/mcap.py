"""A run's results as a ROS 2 bag in MCAP, which Foxglove and ``ros2 bag`` open: clouds, lumps,
targets, overlays.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from stereo_ore.errors import MissingExtraError, OutputError
from stereo_ore.export.ros_types import VISION_MSGS
from stereo_ore.io import clouds
from stereo_ore.io.atomic import guarded
from stereo_ore.io.results import Json, Results
from stereo_ore.record import to_line
from stereo_ore.types import F64

CAMERA_FRAME, ARM_FRAME = "left_rectified", "arm"
STATIC = "/tf_static"
UNKNOWN_PERIOD_NS = 1_000_000_000
"""Frames without a stamp are put this far apart, from the beginning of time on: no stamp is made up
that looks real."""

_POINT_KINDS = {"f4": 7, "i4": 5}  # PointField.FLOAT32, INT32: four bytes each
_POINT_FIELDS = (
    ("x", "f4"),
    ("y", "f4"),
    ("z", "f4"),
    ("rgb", "f4"),
    ("ore_id", "i4"),
    ("score", "f4"),
)

Message = tuple[str, Any]
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
                        offered = _latched() if topic == STATIC else ()
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


Types = Mapping[str, Callable[..., Any]]


def _messages(results: Results, record: Json, types: Types, first: bool) -> Iterable[Message]:
    """All messages of a frame."""
    ros, frame = _Ros(types, stamp_of(record)), record["frame"]
    if first and results.site.T_arm_camera is not None:
        yield STATIC, ros.transform(results.site.T_arm_camera)
    if (cloud := results.cloud(frame)) is not None:
        yield "/stereo_ore/cloud", ros.cloud(cloud)
    yield "/stereo_ore/ores", ros.detections(record)
    yield "/stereo_ore/targets", ros.targets(record)
    if (overlay := results.overlay(frame)) is not None:
        yield "/stereo_ore/overlay", ros.picture(overlay.read_bytes())
    yield "/stereo_ore/record", types["std_msgs/msg/String"](data=to_line(record))


class _Ros:
    """Messages of one frame."""

    def __init__(self, types: Types, stamp_ns: int) -> None:
        self.types = types
        self.stamp = types["builtin_interfaces/msg/Time"](
            sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9
        )

    def header(self, frame_id: str) -> Any:
        return self.types["std_msgs/msg/Header"](stamp=self.stamp, frame_id=frame_id)

    def transform(self, T_arm_camera: F64) -> Any:
        move = self.types["geometry_msgs/msg/Transform"](
            translation=self._vector(T_arm_camera[:3, 3]),
            rotation=self._quaternion(T_arm_camera[:3, :3]),
        )
        stamped = self.types["geometry_msgs/msg/TransformStamped"](
            header=self.header(ARM_FRAME), child_frame_id=CAMERA_FRAME, transform=move
        )
        return self.types["tf2_msgs/msg/TFMessage"](transforms=[stamped])

    def cloud(self, cloud: clouds.Records) -> Any:
        table = np.zeros(len(cloud), [(name, f"<{kind}") for name, kind in _POINT_FIELDS])
        for name in ("x", "y", "z", "ore_id", "score"):
            table[name] = cloud[name]
        red, green, blue = (cloud[name].astype("<u4") for name in ("red", "green", "blue"))
        table["rgb"] = ((red << 16) | (green << 8) | blue).astype("<u4").view("<f4")
        fields = [
            self.types["sensor_msgs/msg/PointField"](
                name=name, offset=4 * place, datatype=_POINT_KINDS[kind], count=1
            )
            for place, (name, kind) in enumerate(_POINT_FIELDS)
        ]
        step = table.dtype.itemsize
        return self.types["sensor_msgs/msg/PointCloud2"](
            header=self.header(CAMERA_FRAME),
            height=1,
            width=len(table),
            fields=fields,
            is_bigendian=False,
            point_step=step,
            row_step=step * len(table),
            data=np.frombuffer(table.tobytes(), np.uint8),
            is_dense=True,
        )

    def detections(self, record: Json) -> Any:
        solids = [ore for ore in record["ores"] if ore["box"]]
        return self.types["vision_msgs/msg/Detection3DArray"](
            header=self.header(CAMERA_FRAME), detections=[self._detection(ore) for ore in solids]
        )

    def _detection(self, ore: Json) -> Any:
        box = ore["box"]["camera"]
        axes = np.array(box["axes"], np.float64).T
        axes[:, 2] *= np.sign(np.linalg.det(axes))
        pose = self._pose(box["centre"], axes)
        label = {True: "oversize", False: "passes", None: "unknown"}[ore["oversize"]]
        hypothesis = self.types["vision_msgs/msg/ObjectHypothesis"](class_id=label, score=1.0)
        centre = self.types["geometry_msgs/msg/PoseWithCovariance"](
            pose=self._pose(ore["centre_of_gravity"]["camera"], axes), covariance=_covariance(ore)
        )
        result = self.types["vision_msgs/msg/ObjectHypothesisWithPose"](
            hypothesis=hypothesis, pose=centre
        )
        bounds = self.types["vision_msgs/msg/BoundingBox3D"](
            center=pose, size=self._vector(ore["box"]["extent_m"])
        )
        return self.types["vision_msgs/msg/Detection3D"](
            header=self.header(CAMERA_FRAME), results=[result], bbox=bounds, id=str(ore["id"])
        )

    def targets(self, record: Json) -> Any:
        base = "arm" if record["arm_frame"] else "camera"
        strikes = {ore["id"]: ore["strike"] for ore in record["ores"]}
        poses = [
            self._pose(
                strikes[id]["point"][base], _x_along(np.array(strikes[id]["direction"][base]))
            )
            for id in record["targets"]
        ]
        frame_id = ARM_FRAME if base == "arm" else CAMERA_FRAME
        return self.types["geometry_msgs/msg/PoseArray"](header=self.header(frame_id), poses=poses)

    def picture(self, data: bytes) -> Any:
        return self.types["sensor_msgs/msg/CompressedImage"](
            header=self.header(CAMERA_FRAME), format="png", data=np.frombuffer(data, np.uint8)
        )

    def _pose(self, position: npt.ArrayLike, axes: F64) -> Any:
        x, y, z = (float(value) for value in np.asarray(position))
        point = self.types["geometry_msgs/msg/Point"](x=x, y=y, z=z)
        return self.types["geometry_msgs/msg/Pose"](
            position=point, orientation=self._quaternion(axes)
        )

    def _vector(self, values: npt.ArrayLike) -> Any:
        x, y, z = (float(value) for value in np.asarray(values))
        return self.types["geometry_msgs/msg/Vector3"](x=x, y=y, z=z)

    def _quaternion(self, axes: F64) -> Any:
        from scipy.spatial.transform import Rotation

        x, y, z, w = (float(value) for value in Rotation.from_matrix(axes).as_quat())
        return self.types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)


def _x_along(direction: F64) -> F64:
    """Axes (3, 3), as columns, whose first is `direction`: viewers draw a pose as an arrow along
    x.
    """
    helper = np.eye(3)[np.argmin(np.abs(direction))]
    y = np.cross(helper, direction)
    y /= np.linalg.norm(y)
    return np.stack([direction / np.linalg.norm(direction), y, np.cross(direction, y)], 1)


def _covariance(ore: Json) -> F64:
    """(36,) covariance of the centre of gravity; the rotation's is unknown, which ROS writes as −1
    at its place.
    """
    covariance = np.zeros((6, 6))
    covariance[range(3), range(3)] = np.square(ore["centre_of_gravity"]["sigma_m"])
    covariance[range(3, 6), range(3, 6)] = -1
    return covariance.ravel()
