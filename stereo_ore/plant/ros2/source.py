"""Frames from the topics of a camera's driver: always the newest pair, and a record of each that is
passed over.
"""

from __future__ import annotations

import functools
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stereo_ore.config.models import MAX_PIXELS
from stereo_ore.errors import FrameError, StereoOreError
from stereo_ore.io.recordings import ros_messages
from stereo_ore.io.recordings.images import Image, check_alike, to_8_bit
from stereo_ore.io.recordings.names import stamp_name
from stereo_ore.io.recordings.stamps import Stamp
from stereo_ore.io.recordings.topics import camera_info_topics
from stereo_ore.plant.frames import LiveFrame, Position
from stereo_ore.plant.ros2.infos import Infos
from stereo_ore.plant.ros2.node import Node
from stereo_ore.plant.ros2.pairing import Coming, Newest, Pairer, TakenEyes
from stereo_ore.types import StereoPair

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
INFO = "sensor_msgs/msg/CameraInfo"
_DEPTH = 10
"""Messages that the middleware keeps until they are taken."""
LOOK_S = 1.0
"""How often overdue images and the publishers' quality of service are looked at."""


@dataclass(frozen=True)
class Wanted:
    """What the user says: topics of the left and right images, and how far apart stamps may be."""

    topics: tuple[str, str] | None = None
    max_skew_ms: float = 5.0
    max_pixels: int = MAX_PIXELS


class Topics:
    """Images of two topics as frames; `close` it, or use up `frames`."""

    def __init__(self, node: Node, topics: tuple[str, str], wanted: Wanted) -> None:
        self.topics = topics
        self.name = f"ROS 2 {topics[0]} {topics[1]}"
        self.infos = Infos(topics)
        self.frame_id = ""
        self._node, self._wanted = node, wanted
        self._pairer = Pairer(round(wanted.max_skew_ms * 1e6))
        self._newest = Newest()
        self._changed = threading.Condition()
        self._counts: Counter[str] = Counter()
        self._subscriptions: dict[str, tuple[Any, bool]] = {}
        self._timer = node.ros.create_timer(LOOK_S, self._look)
        self._look()

    def frames(self, start: Position, stop: threading.Event) -> Iterator[LiveFrame]:
        """The newest pair each time one is asked for, after those that it supersedes."""
        index = start.index
        try:
            while not stop.is_set():
                for coming, superseded in self._take():
                    if coming.lost:
                        yield self._lost(coming, index)
                        index += 1
                    yield self._frame(coming, superseded, index)
                    index += 1
        finally:
            self.close()

    def close(self) -> None:
        """Leave the network."""
        self._node.close()

    def state(self) -> str:
        """What comes, and what of it is not worked on."""
        counts = self._counts
        return (
            f"ROS 2 {self.topics[0]}, {self.topics[1]}: {counts['pairs']} pairs,"
            f" {counts['passed']} passed over, {counts['single']} without the other eye,"
            f" {counts['lost']} never came"
        )

    @property
    def size(self) -> tuple[int, int] | None:
        """Width and height [px] of the newest left image; None while no pair has come, or where it
        can't be read.
        """
        with self._changed:
            newest = self._newest.last
        if newest is None or newest.left is None:
            return None
        with suppress(FrameError):
            height, width = self._image(newest.left, 0).shape[:2]
            return width, height
        return None

    @property
    def pairs_waiting(self) -> int:
        """Complete frames that have come since one was taken."""
        with self._changed:
            return self._newest.pairs

    @property
    def delivers(self) -> bool:
        """Whether a pair has come."""
        return self._counts["pairs"] > 0

    def find_infos(self) -> bool:
        """Listen to the `camera_info` of both eyes; False while an eye has none of its own."""
        kinds = self._node.topics()
        places = [
            next((place for place in camera_info_topics(topic) if kinds.get(place) == INFO), None)
            for topic in self.topics
        ]
        if None in places or places[0] == places[1]:
            return False
        for eye, place in enumerate(places):
            assert place is not None, "just seen"
            self._subscribe(place, INFO, functools.partial(self._on_info, eye))
        return True

    def _look(self) -> None:
        """Listen as the publishers speak, and give up images whose partners have not come."""
        kinds = self._node.topics()
        for eye, topic in enumerate(self.topics):
            if (kind := kinds.get(topic)) in IMAGES:
                self._subscribe(topic, kind, functools.partial(self._on_image, eye))
        with self._changed:
            self._add(self._pairer.overdue(time.monotonic()))

    def _subscribe(self, topic: str, kind: str, callback: Callable[..., None]) -> None:
        """Subscribe, anew where reliability has changed.

        Reliable where all publishers are: over the loopback of a busy machine half of the images
        are lost otherwise, for they are much larger than what the middleware buffers.
        """
        from rclpy.qos import QoSProfile, ReliabilityPolicy

        offers = self._node.ros.get_publishers_info_by_topic(topic)
        known = self._subscriptions.get(topic)
        if known and not offers:
            return
        reliable = bool(offers) and all(
            offer.qos_profile.reliability == ReliabilityPolicy.RELIABLE for offer in offers
        )
        if known and known[1] == reliable:
            return
        if known:
            self._node.ros.destroy_subscription(known[0])
        policy = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        made = self._node.ros.create_subscription(
            self._node.types[kind], topic, callback, QoSProfile(depth=_DEPTH, reliability=policy)
        )
        self._subscriptions[topic] = made, reliable

    def _on_info(self, eye: int, message: Any, info: Any) -> None:
        self.infos.add(eye, message)

    def _on_image(self, eye: int, message: Any, info: Any) -> None:
        arrived_s = time.monotonic()
        if eye == 0:
            self.frame_id = message.header.frame_id
        stamp_ns = ros_messages.stamp_ns(message)
        number = info.get("publication_sequence_number")
        if stamp_ns <= 0:  # a driver that leaves it empty
            stamp_ns = int(info["source_timestamp"]) or time.time_ns()
        with self._changed:
            self._add(self._pairer.add(eye, TakenEyes(stamp_ns, arrived_s, message, number)))

    def _add(self, found: list[Coming]) -> None:
        for coming in found:
            self._newest.add(coming)
            self._counts["pairs" if coming.complete else "single"] += 1
            self._counts["lost"] += coming.lost
        if found:
            self._changed.notify()

    def _take(self) -> list[tuple[Coming, bool]]:
        with self._changed:
            self._changed.wait_for(lambda: self._newest, 0.2)
            return list(self._newest.take())

    def _frame(self, coming: Coming, superseded: bool, index: int) -> LiveFrame:
        stamp_ns = coming.first.stamp_ns
        name = stamp_name(stamp_ns)
        self._counts["passed"] += superseded and coming.complete
        return LiveFrame(
            name,
            index,
            time.time_ns() - round(1e9 * (time.monotonic() - coming.arrived_s)),
            (),
            functools.partial(self._read, coming, name, index),
            coming.arrived_s,
            skipped="a newer frame was there" if superseded and coming.complete else "",
            stamp=Stamp(stamp_ns, "header"),
            superseded=superseded,
        )

    def _lost(self, coming: Coming, index: int) -> LiveFrame:
        """Frames before this one, of which nothing has come."""
        fault = FrameError(
            f"{coming.lost} frame{'s' * (coming.lost != 1)} before {coming.first.stamp_ns} never"
            " came",
            code="NEVER_CAME",
            file=self.topics[0],
            remedy="Is the network or this machine too slow for the images?",
        )

        def read() -> StereoPair:
            raise fault

        name = f"{stamp_name(coming.first.stamp_ns)}_before"
        now_ns = time.time_ns()
        return LiveFrame(name, index, now_ns, (), read, coming.arrived_s, superseded=True)

    def _read(self, coming: Coming, name: str, index: int) -> StereoPair:
        left, right = coming.left, coming.right
        if left is None or right is None:
            missing = "left" if left is None else "right"
            raise FrameError(
                f"frame {name} has no {missing} image within {self._wanted.max_skew_ms:g} ms",
                code="UNPAIRED",
                file=self.topics[0],
                remedy="Frames are paired by stamp; --max-skew-ms is the limit",
            )
        self.infos.check((left.stamp_ns, right.stamp_ns))
        images = self._image(left, 0), self._image(right, 1)
        check_alike(images[0], images[1], self.topics[0], self.topics[1])
        pair = to_8_bit(*images)
        return StereoPair(*pair, name, index, left.stamp_ns, "header")

    def _image(self, image: TakenEyes, eye: int) -> Image:
        topic = Path(self.topics[eye])
        try:
            return ros_messages.image(image.message, topic, self._wanted.max_pixels)
        except StereoOreError:
            raise
        except Exception as fault:  # what a decoder makes of octets from anywhere
            raise FrameError(
                f"can't be read: {fault}", code="UNREADABLE_IMAGE", file=topic
            ) from None
