"""Writers of small bags for tests: the same pictures as a ROS 1 bag, a ROS 2 sqlite3 bag, and
MCAP."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

ENCODINGS = {
    "bgr8": None,
    "rgb8": cv2.COLOR_BGR2RGB,
    "mono8": cv2.COLOR_BGR2GRAY,
    "bgra8": cv2.COLOR_BGR2BGRA,
}
TOPICS = ("/zed/left/image_rect_color", "/zed/right/image_rect_color")
KINDS = ("ros1", "sqlite3", "mcap")


class Shot(NamedTuple):
    """A message to write: topic, time of recording, stamp [ns], BGR picture."""

    topic: str
    logged_ns: int
    stamp_ns: int
    image: np.ndarray


class Camera(NamedTuple):
    """A camera_info to write beside the image topic."""

    image_topic: str
    size: tuple[int, int]
    focal_px: tuple[float, float]
    centre_px: tuple[float, float]
    baseline_m: float


def write_bag(
    path: Path,
    kind: str,
    shots: Iterable[Shot],
    cameras: Iterable[Camera] = (),
    encoding: str = "bgr8",
) -> Path:
    """Write a bag below `path`; the path to open."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    first = kind == "ros1"
    store = get_typestore(Stores.ROS1_NOETIC if first else Stores.ROS2_HUMBLE)
    serialise = store.serialize_ros1 if first else store.serialize_cdr
    path = path.with_suffix(".bag") if first else path
    storage = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
    with Writer1(path) if first else Writer2(path, version=9, storage_plugin=storage) as bag:
        connections: dict[str, Any] = {}

        def write(topic: str, logged_ns: int, message: Any) -> None:
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, message.__msgtype__, typestore=store)
            bag.write(connections[topic], logged_ns, serialise(message, message.__msgtype__))

        for camera in cameras:
            write(
                camera.image_topic.rpartition("/")[0] + "/camera_info",
                0,
                camera_info(store, camera, first),
            )
        for shot in shots:
            write(shot.topic, shot.logged_ns, image_message(store, shot, encoding, first))
    return path


def header(store: Any, stamp_ns: int, first: bool) -> Any:
    types = store.types
    stamp = types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    sequence = {"seq": 0} if first else {}
    return types["std_msgs/msg/Header"](stamp=stamp, frame_id="left", **sequence)


def image_message(store: Any, shot: Shot, encoding: str, first: bool) -> Any:
    head = header(store, shot.stamp_ns, first)
    if encoding in ("png", "jpeg"):
        data = cv2.imencode(f".{encoding}", shot.image)[1].ravel()
        return store.types["sensor_msgs/msg/CompressedImage"](
            header=head, format=f"bgr8; {encoding}", data=data
        )
    conversion = ENCODINGS[encoding]
    pixels = shot.image if conversion is None else cv2.cvtColor(shot.image, conversion)
    rows = pixels.reshape(len(pixels), -1)
    padded = np.pad(rows, ((0, 0), (0, 8)), constant_values=255)  # drivers may pad their rows
    return store.types["sensor_msgs/msg/Image"](
        header=head,
        height=len(pixels),
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=padded.shape[1],
        data=padded.ravel(),
    )


def camera_info(store: Any, camera: Camera, first: bool) -> Any:
    (width, height), (fx, fy), (cx, cy) = camera.size, camera.focal_px, camera.centre_px
    K = np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1])
    shift = -fx * camera.baseline_m if "right" in camera.image_topic else 0.0
    P = np.array([fx, 0, cx, shift, 0, fy, cy, 0, 0, 0, 1, 0])
    matrices = {"D": np.zeros(5), "K": K, "R": np.eye(3).ravel(), "P": P}
    if not first:
        matrices = {letter.lower(): matrix for letter, matrix in matrices.items()}
    roi = store.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    return store.types["sensor_msgs/msg/CameraInfo"](
        header=header(store, 0, first),
        height=height,
        width=width,
        distortion_model="plumb_bob",
        binning_x=0,
        binning_y=0,
        roi=roi,
        **matrices,
    )
