"""Results as topics of ROS 2: targets first, then what people look at.

Who listens to ``targets`` may ask for liveliness: the middleware then tells within `LEASE_S` that
this program has gone or hangs, which no message could.
"""

from __future__ import annotations

import logging
import threading
import time
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Any, Self

from stereo_ore.errors import OutputError, StereoOreError
from stereo_ore.io.results import Results
from stereo_ore.io.ros_frame import RosFrame
from stereo_ore.plant.ros2 import markers
from stereo_ore.plant.ros2.diagnosis import diagnostics
from stereo_ore.plant.ros2.install import has_transforms, octets
from stereo_ore.plant.ros2.node import Node
from stereo_ore.plant.ros2.view import View, camera_info, static_publisher
from stereo_ore.plant.sinks.base import SinkState
from stereo_ore.plant.sinks.message import Message
from stereo_ore.plant.sinks.settings import Ros2Settings
from stereo_ore.types import JsonMapping

_log = logging.getLogger(__name__)

LEASE_S = 1.0
"""Time after which silence means that this program is gone; half of what targets hold, where that
is less."""
DIAGNOSTICS_S = 1.0
ACKNOWLEDGED_S = 1.0
"""How long the last message is waited for to arrive."""

TOPICS = {
    "targets": "geometry_msgs/msg/PoseArray",
    "targets_camera": "geometry_msgs/msg/PoseArray",
    "strikes": "visualization_msgs/msg/MarkerArray",
    "lumps": "visualization_msgs/msg/MarkerArray",
    "cloud": "sensor_msgs/msg/PointCloud2",
    "camera_info": "sensor_msgs/msg/CameraInfo",
    "overlay/compressed": "sensor_msgs/msg/CompressedImage",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}
"""Topics below the namespace, but for the one that all programs share."""
STATIC = "/tf_static"
EXPIRING = ("targets", "targets_camera")


@dataclass(frozen=True)
class _Shown:
    """A message, with the record and age of its frame where it is about one."""

    message: Message
    record: JsonMapping | None = None
    age_s: float | None = None


class Ros2Sink:
    """Publishes in a thread of its own; of messages that come faster than they can be sent the
    newest is.
    """

    def __init__(self, settings: Ros2Settings, view: View) -> None:
        self._settings = settings
        self._view = (
            replace(view, camera_frame=settings.camera_frame) if settings.camera_frame else view
        )
        self._results = Results(view.folder)
        self._lease_s = min(LEASE_S, view.valid_for_s / 2)
        self._next: _Shown | None = None
        self._written: JsonMapping | None = None
        self._latest: _Shown | None = None
        self._told_s = 0.0
        self._changed = threading.Condition()
        self._closed = False
        self._sent = self._dropped = 0
        self._fault = ""
        self._publishers: dict[str, Any] = {}
        self._thread = threading.Thread(target=self._run, daemon=True, name="ros2")

    def __enter__(self) -> Self:
        self._node = Node("stereo_ore", spins=False, namespace=self._settings.namespace)
        try:
            for topic in TOPICS:
                self._publishers[topic] = self._publisher(topic)
            self._publish_transform()
        except Exception as fault:
            self._node.close()
            if isinstance(fault, StereoOreError):
                raise
            raise OutputError(f"can't publish: {fault}", key="ros2") from None
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join()
        self._node.close()

    def publish(self, message: Message) -> None:
        """Take a message that belongs to no frame, or withdraws one's targets."""
        self._put(_Shown(message))

    def show(self, message: Message, record: JsonMapping, age_s: float) -> None:
        """Take the message of a frame."""
        self._put(_Shown(message, record, age_s))

    def show_files(self, record: JsonMapping) -> None:
        """Take that the cloud and overlay of a frame are in the run's folder."""
        with self._changed:
            self._written = record
            self._changed.notify()

    def state(self) -> SinkState:
        """Subscriptions, and messages sent."""
        count = sum(publisher.get_subscription_count() for publisher in self._publishers.values())
        address = f"/{self._settings.namespace.strip('/')}"
        return SinkState(
            "ROS 2", address, count > 0, count, self._sent, self._dropped, alarm=self._fault
        )

    def _put(self, shown: _Shown) -> None:
        with self._changed:
            self._dropped += self._next is not None
            self._next = shown
            self._changed.notify()

    def _publisher(self, topic: str) -> Any:
        """Reliable, and the last message for who comes late: listeners of any kind fit to that."""
        from rclpy.duration import Duration
        from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy

        qos = QoSProfile(
            depth=1,
            reliability=ReliabilityPolicy.RELIABLE,
            durability=DurabilityPolicy.TRANSIENT_LOCAL,
        )
        if topic in EXPIRING:
            qos.lifespan = Duration(seconds=self._view.valid_for_s)
            qos.liveliness = LivelinessPolicy.MANUAL_BY_TOPIC
            qos.liveliness_lease_duration = Duration(seconds=self._lease_s)
        if topic == "/diagnostics":
            qos = QoSProfile(depth=10)
        kind = TOPICS.get(topic, "tf2_msgs/msg/TFMessage")
        return self._node.ros.create_publisher(self._node.types[kind], topic, qos)

    def _publish_transform(self) -> None:
        """Say where the camera is, or how the user's launch file can."""
        command = static_publisher(self._view, self._settings.arm_frame)
        if self._view.T_arm_camera is None:
            return
        if has_transforms():
            self._publishers[STATIC] = self._publisher(STATIC)
            self._publishers[STATIC].publish(
                self._ros(time.time_ns()).transform(self._view.T_arm_camera)
            )
        else:
            _log.info("without tf2_msgs /tf_static is not published; for RViz: %s", command)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(
                    lambda: self._next or self._written or self._closed, self._lease_s / 3
                )
                shown, self._next, closed = self._next, None, self._closed
                # Targets overtake the pictures of the frame before.
                written = None
                if shown is None:
                    written, self._written = self._written, None
            try:
                if shown is not None:
                    self._send(shown)
                elif written is not None:
                    self._send_files(written)
                elif closed:
                    for topic in ("targets", "/diagnostics"):
                        self._publishers[topic].wait_for_all_acked(self._duration(ACKNOWLEDGED_S))
                    return
                self._beat()
                self._fault = ""
            except Exception as fault:  # what the middleware raises has no common base
                if not self._fault:
                    _log.exception("ROS 2")
                self._fault = f"can't publish: {fault}"
                if closed:
                    return

    @staticmethod
    def _duration(seconds: float) -> Any:
        from rclpy.duration import Duration

        return Duration(seconds=seconds)

    def _beat(self) -> None:
        """Say that this program lives."""
        for topic in EXPIRING:
            self._publishers[topic].assert_liveliness()
        if self._latest and time.monotonic() - self._told_s > DIAGNOSTICS_S:
            self._diagnose(self._latest)

    def _send(self, shown: _Shown) -> None:
        message = shown.message.current()
        self._latest = replace(shown, message=message)
        ids = [target.id for target in message.targets]
        ros, record = self._ros(message.stamp_ns or 0), shown.record
        empty: JsonMapping = {"ores": []}
        for topic, base in (("targets", "arm"), ("targets_camera", "camera")):
            self._publishers[topic].publish(
                ros.targets(record or empty, "arm" if base == "arm" else "camera", ids)
            )
        lifetime_s = max(0.0, message.deadline - time.monotonic())
        strikes = (
            markers.strikes(ros, record, ids, lifetime_s) if record else markers.no_markers(ros)
        )
        self._publishers["strikes"].publish(strikes)
        self._diagnose(self._latest)
        if record is not None:
            rig, lifetime_s = self._view.rig, self._view.valid_for_s
            self._publishers["lumps"].publish(markers.lump_markers(ros, record, rig, lifetime_s))
            self._publishers["camera_info"].publish(camera_info(ros, rig))
        self._sent += 1

    def _send_files(self, record: JsonMapping) -> None:
        """What people look at, from the run's folder."""
        frame, ros = record["frame"], self._ros(record["stamp_ns"] or 0)
        if (cloud := self._results.cloud(frame)) is not None:
            self._publishers["cloud"].publish(ros.cloud(cloud))
        if (overlay := self._results.overlay(frame)) is not None:
            self._publishers["overlay/compressed"].publish(ros.picture(overlay.read_bytes()))

    def _diagnose(self, shown: _Shown) -> None:
        self._told_s = time.monotonic()
        message = shown.message.current()
        name = f"{self._settings.namespace.strip('/')}: targets"
        ros = self._ros(time.time_ns())
        self._publishers["/diagnostics"].publish(
            diagnostics(ros, message, name, self._view.camera, shown.age_s)
        )

    def _ros(self, stamp_ns: int) -> RosFrame:
        frames = self._view.camera_frame, self._settings.arm_frame
        return RosFrame(self._node.types, stamp_ns, frames, octets)
