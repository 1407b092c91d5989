"""Results live in Foxglove: the channels of an exported bag on a WebSocket of this machine."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterable
from types import TracebackType
from typing import Any, Self

from stereo_ore.errors import MissingExtraError, OutputError
from stereo_ore.io.results import Results
from stereo_ore.io.ros_channels import STATIC_TOPIC, Topical, files_of, found_in, typestore
from stereo_ore.io.ros_frame import RosFrame
from stereo_ore.plant.sinks.base import SinkState
from stereo_ore.plant.sinks.message import Message
from stereo_ore.types import F64, JsonMapping

_log = logging.getLogger(__name__)


class FoxgloveSink:
    """Sends from the threads of Foxglove's own server, which drops the oldest for a slow viewer.

    Who subscribes late gets the latest of each channel at once.

    Parameters
    ----------
    host, port
        Where to listen.
    results : Results
        The run whose clouds and overlays are shown.
    T_arm_camera : (4, 4) array or None
        Where the camera is; None: unknown.
    """

    def __init__(self, host: str, port: int, results: Results, T_arm_camera: F64 | None) -> None:
        self._host, self._port, self._results, self._T = host, port, results, T_arm_camera
        self._store = typestore()
        self._channels: dict[str, Any] = {}
        self._latest: dict[str, bytes] = {}
        self._clients: set[int] = set()
        self._lock = threading.Lock()
        self._sent, self._fault = 0, ""

    def __enter__(self) -> Self:
        try:
            import foxglove
        except ImportError:
            raise MissingExtraError("foxglove-sdk", "foxglove") from None
        # A context of its own: two sinks of a process share no channels.
        self._foxglove, self._context = foxglove, foxglove.Context()
        try:
            self._server = foxglove.start_server(
                name="stereo-ore",
                host=self._host,
                port=self._port,
                server_listener=self,
                context=self._context,
            )
        except Exception as fault:  # the SDK has no class of its own for a port in use
            raise OutputError(f"can't serve Foxglove: {fault}", key="foxglove") from None
        if self._T is not None:
            ros = RosFrame(self._store.types, time.time_ns())
            self._log([(STATIC_TOPIC, ros.transform(self._T))])
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._server.stop()

    def publish(self, message: Message) -> None:
        """Take a message that belongs to no frame, or withdraws one's targets."""
        ros = RosFrame(self._store.types, message.published_ns)
        self._log([("/stereo_ore/targets", ros.targets({"ores": []}, "arm", []))])

    def show(self, message: Message, record: JsonMapping, age_s: float) -> None:
        """Take what was found in a frame; its targets are the message's."""
        ids = [target.id for target in message.current().targets]
        self._log(found_in(record, self._store.types, ids))
        self._sent += 1

    def show_files(self, record: JsonMapping) -> None:
        """Take that the cloud and overlay of a frame are in the run's folder."""
        self._log(files_of(self._results, record, self._store.types))

    def state(self) -> SinkState:
        """Subscribed viewers, and frames sent."""
        address = f"ws://{self._host}:{self._server.port}"
        count = len(self._clients)
        return SinkState("Foxglove", address, count > 0, count, self._sent, 0, alarm=self._fault)

    def on_subscribe(self, client: Any, channel: Any) -> None:
        """Called by the server: a viewer wants a channel; all others get its latest once more."""
        self._clients.add(client.id)
        with self._lock:  # else an old message may come behind a new one
            if (data := self._latest.get(channel.topic)) is not None:
                self._channels[channel.topic].log(data)

    def on_unsubscribe(self, client: Any, channel: Any) -> None:
        """Called by the server: a viewer, or a part of one, is gone."""
        self._clients.discard(client.id)

    def _log(self, messages: Iterable[Topical]) -> None:
        try:
            for topic, message in messages:
                kind = message.__msgtype__
                data = bytes(self._store.serialize_cdr(message, kind))
                if topic not in self._channels:
                    self._channels[topic] = self._channel(topic, kind)
                with self._lock:
                    self._latest[topic] = data
                    self._channels[topic].log(data)
            self._fault = ""
        except Exception as fault:  # no viewer may cost a frame
            if not self._fault:
                _log.exception("Foxglove")
            self._fault = f"can't publish: {fault}"

    def _channel(self, topic: str, kind: str) -> Any:
        definition, _ = self._store.generate_msgdef(kind, ros_version=2)
        schema = self._foxglove.Schema(name=kind, encoding="ros2msg", data=definition.encode())
        return self._foxglove.Channel(
            topic, schema=schema, message_encoding="cdr", context=self._context
        )
