"""A consumer of the topics for the tests of ROS 2, in a process of its own.

``python ros2_listener.py NAMESPACE SECONDS [TOPIC …]`` writes a line of JSON for each message and
event: topic, when it came (monotonic, which is one for all processes of a machine), stamp and
what a test looks at.
"""

import hashlib
import json
import sys
import time
from collections.abc import Callable
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import CameraInfo, CompressedImage, PointCloud2
from visualization_msgs.msg import MarkerArray


def digest(data: Any) -> str:
    return hashlib.sha256(bytes(data)).hexdigest()


def xyz(vector: Any) -> list[float]:
    return [vector.x, vector.y, vector.z]


def poses(message: PoseArray) -> list[Any]:
    return [[*xyz(p.position), *xyz(p.orientation), p.orientation.w] for p in message.poses]


def markers(message: MarkerArray) -> list[dict[str, Any]]:
    return [
        {
            "ns": m.ns,
            "id": m.id,
            "type": m.type,
            "action": m.action,
            "lifetime_s": m.lifetime.sec + m.lifetime.nanosec / 1e9,
            "text": m.text,
            "position": xyz(m.pose.position),
            "orientation": [*xyz(m.pose.orientation), m.pose.orientation.w],
            "scale": xyz(m.scale),
            "points": [xyz(p) for p in m.points],
            "frame": m.header.frame_id,
        }
        for m in message.markers
    ]


def cloud(message: PointCloud2) -> dict[str, Any]:
    fields = [[field.name, field.offset, field.datatype] for field in message.fields]
    return {"points": message.width, "fields": fields, "sha256": digest(message.data)}


def diagnosis(message: DiagnosticArray) -> dict[str, Any]:
    status = message.status[0]
    values = {pair.key: pair.value for pair in status.values}
    return {"level": status.level[0], "name": status.name, "said": status.message, **values}


KINDS: dict[str, tuple[Any, Callable[[Any], Any]]] = {
    "targets": (PoseArray, poses),
    "targets_camera": (PoseArray, poses),
    "strikes": (MarkerArray, markers),
    "lumps": (MarkerArray, markers),
    "cloud": (PointCloud2, cloud),
    "overlay/compressed": (CompressedImage, lambda m: [m.format, digest(m.data)]),
    "camera_info": (CameraInfo, lambda m: [m.width, m.height, list(m.k), list(m.p)]),
    "/diagnostics": (DiagnosticArray, diagnosis),
}


def say(topic: str, **more: Any) -> None:
    sys.stdout.write(json.dumps({"topic": topic, "at": time.monotonic(), **more}) + "\n")
    sys.stdout.flush()


def on_message(topic: str, read: Callable[[Any], Any]) -> Callable[[Any], None]:
    def callback(message: Any) -> None:
        at = time.monotonic()
        header = message.header if hasattr(message, "header") else message.markers[0].header
        stamp = header.stamp.sec * 10**9 + header.stamp.nanosec
        say(topic, came=at, stamp=stamp, frame=header.frame_id, data=read(message))

    return callback


def main() -> None:
    namespace, seconds, *topics = sys.argv[1:]
    context = Context()
    rclpy.init(context=context, args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("listener", context=context)
    for topic in topics or KINDS:
        kind, read = KINDS[topic]
        qos = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
        events = None
        if topic != "/diagnostics":
            qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
        if topic == "targets":
            qos.liveliness_lease_duration = Duration(seconds=1.5)
            events = SubscriptionEventCallbacks(
                liveliness=lambda event: say("liveliness", alive=event.alive_count)
            )
        name = topic if topic.startswith("/") else f"/{namespace}/{topic}"
        node.create_subscription(kind, name, on_message(topic, read), qos, event_callbacks=events)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    end = time.monotonic() + float(seconds)
    say("up")
    while time.monotonic() < end:
        executor.spin_once(timeout_sec=0.1)


if __name__ == "__main__":
    main()
