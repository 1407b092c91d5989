"""A camera's driver for the tests of ROS 2, in a process of its own.

``python ros2_driver.py LEFT RIGHT CALIBRATION PLAN`` publishes a pair of image files as often as
the plan (JSON) says, and writes "ready" once it is listened to, "done" at the end.

Keys of a plan: count, period_s, start_ns (stamp of the first frame), stamp_step_ns, drop_left and
drop_right (numbers of frames), jump (number of a frame and how far the clock is set there [ns]),
info (whether camera_info is published), reliable, encoding (bgr8, png), kill_at (frame within which
the process ends: its left image is out, its right one is not), prefix (of the topics), name (of the
image topics), vary (whether each frame has its number in a pixel, so that none is frozen).
"""

import array
import json
import os
import signal
import sys
import time
from typing import Any

import cv2
import numpy as np
import rclpy
import yaml
from rclpy.context import Context
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from ros2_driver_plan import START, STEP
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

DEFAULTS = {
    "count": 1,
    "period_s": 0.1,
    "start_ns": START,
    "stamp_step_ns": STEP,
    "drop_left": [],
    "drop_right": [],
    "jump": None,
    "info": True,
    "reliable": True,
    "encoding": "bgr8",
    "kill_at": None,
    "prefix": "/camera",
    "name": "image_rect",
    "vary": True,
    "linger_s": 1.0,
}


def camera_infos(calibration: dict[str, Any], scale: float = 1.0) -> list[CameraInfo]:
    """The messages of rectified eyes."""
    found = []
    width, height = calibration["image_size"]
    baseline = -calibration["right_from_left"]["translation_m"][0]
    for eye in ("left", "right"):
        (fx, fy), (cx, cy) = calibration[eye]["focal_px"], calibration[eye]["principal_point_px"]
        shift = 0.0 if eye == "left" else -fx * baseline * scale
        info = CameraInfo(width=width, height=height, distortion_model="plumb_bob")
        info.d = [0.0] * 5
        info.k = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
        info.r = np.eye(3).ravel().tolist()
        info.p = [fx, 0.0, cx, shift, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]
        found.append(info)
    return found


class Driver:
    def __init__(self, files: list[str], calibration: str, plan: dict[str, Any]) -> None:
        self.plan = DEFAULTS | plan
        self.images = [cv2.imread(file, cv2.IMREAD_COLOR) for file in files]
        with open(calibration, encoding="utf-8") as text:
            self.infos = camera_infos(yaml.safe_load(text), self.plan.get("scale", 1.0))
        self.context = Context()
        rclpy.init(context=self.context, args=[], signal_handler_options=SignalHandlerOptions.NO)
        self.node = rclpy.create_node("driver", context=self.context)
        policy = ReliabilityPolicy
        qos = QoSProfile(
            depth=10,
            reliability=policy.RELIABLE if self.plan["reliable"] else policy.BEST_EFFORT,
        )
        kind, tail = (
            (Image, "") if self.plan["encoding"] == "bgr8" else (CompressedImage, "/compressed")
        )
        self.publishers = [
            self.node.create_publisher(
                kind, f"{self.plan['prefix']}/{eye}/{self.plan['name']}{tail}", qos
            )
            for eye in ("left", "right")
        ]
        self.info_publishers = [
            self.node.create_publisher(CameraInfo, f"{self.plan['prefix']}/{eye}/camera_info", qos)
            for eye in ("left", "right")
        ]

    def wait(self) -> None:
        while any(not publisher.get_subscription_count() for publisher in self.publishers):
            time.sleep(0.02)

    def message(self, eye: int, number: int, stamp_ns: int) -> Image | CompressedImage:
        image = self.images[eye]
        if self.plan["vary"]:
            image = image.copy()
            image[0, 0] = number % 256, number // 256 % 256, number // 65536 % 256
        height, width = image.shape[:2]
        if self.plan["encoding"] == "bgr8":
            message = Image(width=width, height=height, encoding="bgr8", step=3 * width)
            message.data = array.array("B", image.tobytes())
        else:
            message = CompressedImage(format="png")
            message.data = array.array("B", cv2.imencode(".png", image)[1].tobytes())
        self.stamp(message, eye, stamp_ns)
        return message

    @staticmethod
    def stamp(message: Any, eye: int, stamp_ns: int) -> None:
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
        message.header.frame_id = f"camera_{('left', 'right')[eye]}_optical_frame"

    def run(self) -> None:
        plan, shift = self.plan, 0
        begin = time.monotonic()
        for number in range(plan["count"]):
            if plan["jump"] and plan["jump"][0] == number:
                shift = plan["jump"][1]
            stamp_ns = plan["start_ns"] + number * plan["stamp_step_ns"] + shift
            for eye, dropped in enumerate((plan["drop_left"], plan["drop_right"])):
                if plan["info"]:
                    self.stamp(self.infos[eye], eye, stamp_ns)
                    self.info_publishers[eye].publish(self.infos[eye])
                if number not in dropped:
                    self.publishers[eye].publish(self.message(eye, number, stamp_ns))
                if plan["kill_at"] == number and eye == 0:
                    os.kill(os.getpid(), signal.SIGKILL)
            time.sleep(max(0.0, begin + (number + 1) * plan["period_s"] - time.monotonic()))


def say(word: str) -> None:
    sys.stdout.write(f"{word}\n")
    sys.stdout.flush()


def main() -> None:
    left, right, calibration, plan = sys.argv[1:]
    driver = Driver([left, right], calibration, json.loads(plan))
    say("up")
    driver.wait()
    say("ready")
    driver.run()
    say("done")
    time.sleep(driver.plan["linger_s"])


if __name__ == "__main__":
    main()
