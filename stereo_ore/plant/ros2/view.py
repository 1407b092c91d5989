"""What the topics of a run show of it, and how its frames are called there."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stereo_ore.io.results import Results
from stereo_ore.io.ros_frame import RosFrame
from stereo_ore.types import F64, Rig

CAMERA_FRAME = "stereo_ore_left_optical_frame"
"""The rectified left camera (REP 103: x right, y down, z forward), where no driver has named it."""


@dataclass(frozen=True)
class View:
    """A run's folder and geometry; `T_arm_camera` may be unknown."""

    folder: Path
    rig: Rig
    T_arm_camera: F64 | None
    camera: str
    valid_for_s: float
    camera_frame: str = CAMERA_FRAME

    @classmethod
    def of_folder(cls, folder: Path, valid_for_s: float) -> View | None:
        """The view of a run that was written; None where it has kept no calibration."""
        results = Results(folder)
        if results.rig is None:
            return None
        arm = results.site.T_arm_camera
        return cls(folder, results.rig, arm, results.camera or "", valid_for_s)


def camera_info(ros: RosFrame, rig: Rig) -> Any:
    """CameraInfo of the rectified left images."""
    K = np.array([[rig.fx, 0, rig.cx], [0, rig.fy, rig.cy], [0, 0, 1]], float)
    return ros.types["sensor_msgs/msg/CameraInfo"](
        header=ros.header(ros.camera_frame),
        width=rig.width,
        height=rig.height,
        distortion_model="plumb_bob",
        d=[0.0] * 5,
        k=K.ravel().tolist(),
        r=np.eye(3).ravel().tolist(),
        p=np.column_stack([K, np.zeros(3)]).ravel().tolist(),
    )


def static_publisher(view: View, arm_frame: str) -> str | None:
    """The command that publishes where the camera is, for who has no `tf2_msgs` here; None where
    that is unknown.
    """
    if view.T_arm_camera is None:
        return None
    x, y, z = view.T_arm_camera[:3, 3]
    qx, qy, qz, qw = Rotation.from_matrix(view.T_arm_camera[:3, :3]).as_quat()
    return (
        f"ros2 run tf2_ros static_transform_publisher --x {x:.6f} --y {y:.6f} --z {z:.6f}"
        f" --qx {qx:.9f} --qy {qy:.9f} --qz {qz:.9f} --qw {qw:.9f}"
        f" --frame-id {arm_frame} --child-frame-id {view.camera_frame}"
    )
