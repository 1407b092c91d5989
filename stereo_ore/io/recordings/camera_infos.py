"""The calibration that a bag carries: the camera_info that goes with its images."""

from __future__ import annotations

import bisect
from collections import Counter
from collections.abc import Mapping, Sequence
from copy import copy
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from stereo_ore.errors import CalibrationError
from stereo_ore.io.recordings import ros_messages
from stereo_ore.io.recordings.bag_files import Messages
from stereo_ore.io.recordings.topics import camera_info_topics, is_rectified
from stereo_ore.types import F64, StereoCalibration

REALSENSE_PLACE = "/image/"
TREE = "tf2_msgs/msg/TFMessage"
STATIC_TREE = "/tf_static"


class Taken(NamedTuple):
    """When an image was recorded and when it was taken [ns]."""

    logged_ns: int
    stamp_ns: int


def calibration_of(
    bag: Messages,
    topics: tuple[str, str],
    images: tuple[Sequence[Taken], Sequence[Taken]],
    path: Path,
) -> StereoCalibration | None:
    """The calibration in the camera_info that goes with the images of both eyes; None when an eye
    has none.

    Raises
    ------
    CalibrationError
        When it changes between the images, or describes an impossible camera.
    """
    kinds = {topic for topic, kind in bag.types.items() if kind in ros_messages.CAMERA_INFO}
    places = [
        next((place for place in camera_info_topics(topic) if place in kinds), None)
        for topic in topics
    ]
    if places[0] == places[1]:
        return None
    infos = [
        _used(bag, place, taken, path) for place, taken in zip(places, images, strict=True) if place
    ]
    if len(infos) < 2 or any(info is None for info in infos):
        return None
    left, right = infos
    rectified = is_rectified(topics[0])
    shift = _shifts(left, right)
    if shift == 0 and (pose := _pose(bag, topics, left, right)) is not None:
        right, rectified = _with_pose(left, right, *pose), rectified or _ideal(left, right)
        left = _with_projection(left, 0.0)
    try:
        return ros_messages.calibration(left, right, rectified, path)
    except CalibrationError as fault:
        remedy = (
            f"{fault.remedy or 'Its camera_info is of no use'}; or give a calibration with --calib"
        )
        raise CalibrationError(
            fault.problem, file=fault.file, key=fault.key, remedy=remedy
        ) from None


def _used(bag: Messages, topic: str, images: Sequence[Taken], path: Path) -> Any:
    """The one camera_info that goes with all images: of the same stamp, else the latest before,
    else the first.
    """
    found = [
        (logged, ros_messages.stamp_ns(info), info) for _, logged, info in bag.messages([topic])
    ]
    found = [entry for entry in found if np.any(ros_messages.matrix(entry[2], "K"))]
    if not found:
        return None
    found.sort(key=lambda entry: entry[0])
    logged = [entry[0] for entry in found]
    stamped = {stamp: number for number, (_, stamp, _) in enumerate(found) if stamp}
    numbers = Counter(
        stamped.get(image.stamp_ns, max(bisect.bisect_right(logged, image.logged_ns) - 1, 0))
        for image in images
    )
    contents = Counter[tuple[bytes, ...]]()
    for number, count in numbers.items():
        contents[content(found[number][2])] += count
    if len(contents) > 1:
        counts = " and ".join(str(count) for count in contents.values())
        raise CalibrationError(
            f"changes during the recording: {len(contents)} different ones go with {counts} images",
            file=path,
            key=topic,
            remedy="Give the right one with --calib",
        )
    return found[min(numbers, default=0)][2]


def content(info: Any) -> tuple[bytes, ...]:
    """What a CameraInfo says of the camera, to be compared."""
    return (
        *(ros_messages.matrix(info, letter).tobytes() for letter in "KDRP"),
        f"{info.width}×{info.height}".encode(),
    )


def _shifts(left: Any, right: Any) -> float:
    """The baseline that the projections hold, times the focal length."""
    P_left, P_right = (ros_messages.matrix(info, "P") for info in (left, right))
    return float(P_right[3] - P_left[3])


def _ideal(*infos: Any) -> bool:
    """Whether these are cameras without distortion and rotation, whose images are rectified as they
    are.
    """
    rotations = [ros_messages.matrix(info, "R") for info in infos]
    undistorted = not any(ros_messages.matrix(info, "D").any() for info in infos)
    return undistorted and all(
        not R.any() or np.array_equal(R, np.eye(3).ravel()) for R in rotations
    )


def _with_projection(info: Any, shift_px: float) -> Any:
    """The same camera with R = I and P = [K | (shift, 0, 0)]."""
    changed, K = copy(info), ros_messages.matrix(info, "K").reshape(3, 3)
    P = np.column_stack([K, [shift_px, 0.0, 0.0]]).ravel()
    for letter, value in (("R", np.eye(3).ravel()), ("P", P)):
        object.__setattr__(changed, letter if hasattr(info, letter) else letter.lower(), value)
    object.__setattr__(
        changed, "distortion_model", "plumb_bob" if _ideal(info) else info.distortion_model
    )
    return changed


def _with_pose(left: Any, right: Any, rotation: F64, translation_m: F64) -> Any:
    """The right camera with a baseline from elsewhere; only a rig with parallel eyes has one in its
    projection.
    """
    if not np.allclose(rotation, np.eye(3), atol=1e-6) or not np.allclose(
        translation_m[1:], 0, atol=1e-6
    ):
        return right
    return _with_projection(right, float(translation_m[0] * ros_messages.matrix(right, "K")[0]))


def _pose(bag: Messages, topics: tuple[str, str], left: Any, right: Any) -> tuple[F64, F64] | None:
    """Rotation and translation [m] from the left to the right camera, X_right = R X_left + t, from
    transforms.
    """
    return _recorded_pose(bag, topics[1]) or _tree_pose(bag, left, right)


def _recorded_pose(bag: Messages, topic: str) -> tuple[F64, F64] | None:
    """What RealSense's recorders write beside the images: a Transform, or a text with
    ``translation=x,y,z``.
    """
    prefix = topic.partition(REALSENSE_PLACE)[0] + "/tf/"
    for name in bag.types:
        if name.startswith(prefix):
            for _, _, message in bag.messages([name]):
                if hasattr(message, "translation"):
                    t = message.translation
                    return _matrix(message.rotation), np.array([t.x, t.y, t.z])
                if (pose := _text_pose(str(getattr(message, "data", "")))) is not None:
                    return pose
    return None


def _text_pose(text: str) -> tuple[F64, F64] | None:
    """Read ``rotation=9 numbers;translation=3 numbers``; the rotation's columns come first."""
    fields = dict(part.split("=", 1) for part in text.split(";") if "=" in part)
    try:
        rotation, translation = (
            np.array(fields[key].split(","), np.float64) for key in ("rotation", "translation")
        )
        return rotation.reshape(3, 3).T, translation.reshape(3)
    except (KeyError, ValueError):
        return None


def _tree_pose(bag: Messages, left: Any, right: Any) -> tuple[F64, F64] | None:
    """The pose that ``/tf_static`` holds between the frames of the two cameras."""
    if bag.types.get(STATIC_TREE) != TREE:
        return None
    parents: dict[str, tuple[str, F64, F64]] = {}
    for _, _, message in bag.messages([STATIC_TREE]):
        for each in message.transforms:
            t = each.transform.translation
            parents[each.child_frame_id] = (
                each.header.frame_id,
                _matrix(each.transform.rotation),
                np.array([t.x, t.y, t.z]),
            )
    (root, R_left, t_left), (other, R_right, t_right) = (
        _from_root(parents, info) for info in (left, right)
    )
    if root != other or left.header.frame_id == right.header.frame_id:
        return None
    return R_right.T @ R_left, R_right.T @ (t_left - t_right)


def _from_root(parents: Mapping[str, tuple[str, F64, F64]], info: Any) -> tuple[str, F64, F64]:
    """Root of the tree above a camera's frame, and the camera's pose in it."""
    frame, rotation, translation = str(info.header.frame_id), np.eye(3), np.zeros(3)
    for _ in range(len(parents)):
        if frame not in parents:
            break
        frame, R, t = parents[frame]
        rotation, translation = R @ rotation, R @ translation + t
    return frame, rotation, translation


def _matrix(quaternion: Any) -> F64:
    values = [quaternion.x, quaternion.y, quaternion.z, quaternion.w]
    return Rotation.from_quat(values).as_matrix() if any(values) else np.eye(3)
