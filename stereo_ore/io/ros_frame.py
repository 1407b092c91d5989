"""A frame's results as ROS messages, for bags and for live topics alike."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from stereo_ore.io import clouds
from stereo_ore.types import F64, JsonMapping

_CAMERA_FRAME, ARM_FRAME = "left_rectified", "arm"
Base = Literal["camera", "arm"]

_POINT_KINDS = {"f4": 7, "i4": 5}  # PointField.FLOAT32, INT32: four bytes each
_POINT_FIELDS = (
    ("x", "f4"),
    ("y", "f4"),
    ("z", "f4"),
    ("rgb", "f4"),
    ("ore_id", "i4"),
    ("score", "f4"),
)

Types = Mapping[str, Callable[..., Any]]
"""Makers of messages by their type's full name, such as ``std_msgs/msg/Header``."""


def as_array(data: bytes | memoryview) -> npt.NDArray[np.uint8]:
    """Octets as rosbags wants them."""
    return np.frombuffer(data, np.uint8)


class RosFrame:
    """Messages of one frame.

    Parameters
    ----------
    types
        Makers of messages.
    stamp_ns : int
        Stamp of all headers [ns].
    frames
        Names of the camera's frame (x right, y down, z forward) and of the arm's.
    octets
        Makes of bytes what the messages' arrays of octets take.
    """

    def __init__(
        self,
        types: Types,
        stamp_ns: int,
        frames: tuple[str, str] = (_CAMERA_FRAME, ARM_FRAME),
        octets: Callable[[bytes | memoryview], Any] = as_array,
    ) -> None:
        self.types, self.octets = types, octets
        self.camera_frame, self.arm_frame = frames
        self.stamp = types["builtin_interfaces/msg/Time"](
            sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9
        )

    def header(self, frame_id: str) -> Any:
        """Header in a frame."""
        return self.types["std_msgs/msg/Header"](stamp=self.stamp, frame_id=frame_id)

    def transform(self, T_arm_camera: F64) -> Any:
        """TFMessage of the camera in the arm's frame."""
        move = self.types["geometry_msgs/msg/Transform"](
            translation=self.vector(T_arm_camera[:3, 3]),
            rotation=self.quaternion(T_arm_camera[:3, :3]),
        )
        stamped = self.types["geometry_msgs/msg/TransformStamped"](
            header=self.header(self.arm_frame), child_frame_id=self.camera_frame, transform=move
        )
        return self.types["tf2_msgs/msg/TFMessage"](transforms=[stamped])

    def cloud(self, cloud: clouds.Records) -> Any:
        """PointCloud2 with x y z [m], rgb, ore_id, score of each point, in the camera's frame."""
        table = np.empty(len(cloud), [(name, f"<{kind}") for name, kind in _POINT_FIELDS])
        table["rgb"] = 0  # its fourth octet belongs to no colour
        for name in ("x", "y", "z", "ore_id", "score"):
            table[name] = cloud[name]
        octets = table.view(np.uint8).reshape(len(table), table.dtype.itemsize)
        for place, name in enumerate(("blue", "green", "red"), table.dtype.fields["rgb"][1]):  # type: ignore[index]
            octets[:, place] = cloud[name]
        fields = [
            self.types["sensor_msgs/msg/PointField"](
                name=name, offset=4 * place, datatype=_POINT_KINDS[kind], count=1
            )
            for place, (name, kind) in enumerate(_POINT_FIELDS)
        ]
        step = table.dtype.itemsize
        return self._with_data(
            "sensor_msgs/msg/PointCloud2",
            octets.data,
            header=self.header(self.camera_frame),
            height=1,
            width=len(table),
            fields=fields,
            is_bigendian=False,
            point_step=step,
            row_step=step * len(table),
            is_dense=True,
        )

    def detections(self, record: JsonMapping) -> Any:
        """Detection3DArray of the lumps' boxes, in the camera's frame."""
        solids = [ore for ore in record["ores"] if ore["box"]]
        return self.types["vision_msgs/msg/Detection3DArray"](
            header=self.header(self.camera_frame),
            detections=[self._detection(ore) for ore in solids],
        )

    def _detection(self, ore: JsonMapping) -> Any:
        box = ore["box"]["camera"]
        axes = box_axes(ore)
        pose = self.pose(box["centre"], axes)
        label = {True: "oversize", False: "passes", None: "unknown"}[ore["oversize"]]
        hypothesis = self.types["vision_msgs/msg/ObjectHypothesis"](class_id=label, score=1.0)
        centre = self.types["geometry_msgs/msg/PoseWithCovariance"](
            pose=self.pose(ore["centre_of_gravity"]["camera"], axes), covariance=_covariance(ore)
        )
        result = self.types["vision_msgs/msg/ObjectHypothesisWithPose"](
            hypothesis=hypothesis, pose=centre
        )
        bounds = self.types["vision_msgs/msg/BoundingBox3D"](
            center=pose, size=self.vector(ore["box"]["extent_m"])
        )
        return self.types["vision_msgs/msg/Detection3D"](
            header=self.header(self.camera_frame),
            results=[result],
            bbox=bounds,
            id=_lasting_id(ore),
        )

    def targets(self, record: JsonMapping, base: Base, ids: Sequence[int]) -> Any:
        """PoseArray of the strikes of the lumps `ids` in the frame of `base`; x along the way of
        the tool.
        """
        strikes = {ore["id"]: ore["strike"] for ore in record["ores"]}
        poses = [
            self.pose(strikes[id]["point"][base], x_along(strikes[id]["direction"][base]))
            for id in ids
        ]
        frame_id = self.arm_frame if base == "arm" else self.camera_frame
        return self.types["geometry_msgs/msg/PoseArray"](header=self.header(frame_id), poses=poses)

    def picture(self, data: bytes) -> Any:
        """CompressedImage of a PNG file."""
        header = self.header(self.camera_frame)
        return self._with_data("sensor_msgs/msg/CompressedImage", data, header=header, format="png")

    def _with_data(self, kind: str, data: bytes | memoryview, **fields: Any) -> Any:
        """A message; its octets are put in when it is made: rclpy's makers copy them one by one."""
        message = self.types[kind](**fields, data=self.octets(b""))
        message.data = self.octets(data)
        return message

    def pose(self, position: npt.ArrayLike, axes: F64) -> Any:
        """Pose at a position [m] with axes (3, 3), as columns."""
        return self.types["geometry_msgs/msg/Pose"](
            position=self.point(position), orientation=self.quaternion(axes)
        )

    def point(self, position: npt.ArrayLike) -> Any:
        """Point [m]."""
        x, y, z = (float(value) for value in np.asarray(position))
        return self.types["geometry_msgs/msg/Point"](x=x, y=y, z=z)

    def vector(self, values: npt.ArrayLike) -> Any:
        """Vector3."""
        x, y, z = (float(value) for value in np.asarray(values))
        return self.types["geometry_msgs/msg/Vector3"](x=x, y=y, z=z)

    def quaternion(self, axes: F64) -> Any:
        """Quaternion of a rotation (3, 3)."""
        x, y, z, w = quaternion(axes)
        return self.types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)


def _lasting_id(ore: JsonMapping) -> str:
    """What is the same in each frame that shows the lump, as vision_msgs wants it: its track; of a
    lump that is not followed its id.
    """
    track = ore.get("track")
    return str(track["number"] if track else ore["id"])


def quaternion(rotation: F64) -> tuple[float, float, float, float]:
    """x, y, z, w of a rotation (3, 3), w ≥ 0 (Shepperd 1978); SciPy's takes 0.2 ms, which is much
    where a frame has a hundred.
    """
    R = rotation.tolist()
    squares = [R[0][0], R[1][1], R[2][2], R[0][0] + R[1][1] + R[2][2]]
    largest = squares.index(max(squares))
    found = [0.0] * 4
    if largest == 3:
        found[3] = 1 + squares[3]
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            found[i] = R[k][j] - R[j][k]
    else:
        i, j, k = largest, (largest + 1) % 3, (largest + 2) % 3
        found[i] = 1 - squares[3] + 2 * R[i][i]
        found[j], found[k] = R[j][i] + R[i][j], R[k][i] + R[i][k]
        found[3] = R[k][j] - R[j][k]
    length = math.copysign(math.hypot(*found), found[3])
    x, y, z, w = (value / length for value in found)
    return x, y, z, w


def box_axes(ore: JsonMapping) -> F64:
    """Axes (3, 3), as columns, of a lump's box: a rotation, in the camera's frame."""
    axes = np.array(ore["box"]["camera"]["axes"], np.float64).T
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    return axes


def x_along(direction: npt.ArrayLike) -> F64:
    """Axes (3, 3), as columns, whose first is `direction`: viewers draw a pose as an arrow along
    x.
    """
    along = np.asarray(direction, np.float64)
    helper = np.eye(3)[np.argmin(np.abs(along))]
    y = _cross(helper, along)
    y /= np.linalg.norm(y)
    return np.stack([along / np.linalg.norm(along), y, _cross(along, y)], 1)


def _cross(a: F64, b: F64) -> F64:
    """Vector product of two vectors (3,); `np.cross` takes ten times as long."""
    (a0, a1, a2), (b0, b1, b2) = a.tolist(), b.tolist()
    return np.array([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0])


def _covariance(ore: JsonMapping) -> F64:
    """(36,) covariance of the centre of gravity; the rotation's is unknown, which ROS writes as −1
    at its place.
    """
    covariance = np.zeros((6, 6))
    covariance[range(3), range(3)] = np.square(ore["centre_of_gravity"]["sigma_m"])
    covariance[range(3, 6), range(3, 6)] = -1
    return covariance.ravel()
