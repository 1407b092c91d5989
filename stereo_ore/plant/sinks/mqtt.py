"""Targets to an MQTT broker: one retained message, replaced with every frame, withdrawn by the broker if we vanish."""

from __future__ import annotations

import logging
import math
import ssl
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from stereo_ore.errors import MissingExtraError, OutputError
from stereo_ore.plant.sinks.base import Outbox, SinkState
from stereo_ore.plant.sinks.message import Message, Origin, notice

if TYPE_CHECKING:
    from paho.mqtt.client import Client, MQTTMessageInfo

log = logging.getLogger(__name__)

KEEPALIVE_S = 5
"""The broker withdraws the targets 1.5 times this after the connection has gone silent."""
RECONNECT_S = (1, 8)
"""First and longest pause between attempts to connect."""
CLOSING_S = 1.0


@dataclass(frozen=True)
class MqttLogin:
    """User, password and the authority that signed the broker's certificate; all None for a broker on this machine."""

    user: str | None = None
    password: str | None = field(default=None, repr=False)
    authority: Path | None = None


class MqttSink:
    """Publishes to `topic` of the broker at `host`:`port`; what can't be sent waits in a bounded outbox.

    Messages are retained, expire in the broker with their targets (MQTT 5), and are sent at most once: a repeated old
    target would be worse than none. The connection's last will is a message without targets.
    """

    def __init__(self, host: str, port: int, topic: str, login: MqttLogin | None = None) -> None:
        self.host, self.port, self.topic = host, port, topic
        self._client = _client(login or MqttLogin())
        self._client.on_connect = self._on_connect
        self._client.on_disconnect = self._on_disconnect
        self._client.will_set(topic, notice(0, Origin(), "offline").line(), qos=1, retain=True)
        self._outbox = Outbox()
        self._connected = threading.Event()
        self._stopping = threading.Event()
        self._detail = "connecting"
        self._sent = 0
        self._thread = threading.Thread(target=self._run, daemon=True, name="mqtt")

    def __enter__(self) -> Self:
        self._client.reconnect_delay_set(*RECONNECT_S)
        self._client.connect_async(self.host, self.port, keepalive=KEEPALIVE_S)
        self._client.loop_start()
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._outbox.close()
        self._thread.join(CLOSING_S)
        self._stopping.set()
        self._thread.join()
        self._connected.clear()
        self._client.disconnect()
        self._client.loop_stop()

    def publish(self, message: Message) -> None:
        """Hand the message to the sending thread."""
        self._outbox.put(message)

    def state(self) -> SinkState:
        """Connection, messages sent and dropped."""
        connected = self._connected.is_set()
        address = f"{self.host}:{self.port} {self.topic}"
        return SinkState("MQTT", address, connected, int(connected), self._sent, self._outbox.dropped, self._detail)

    def _run(self) -> None:
        while not self._outbox.finished and not self._stopping.is_set():
            message = self._outbox.get(1.0)
            while message is not None and not self._stopping.is_set():
                if self._connected.wait(0.2):
                    message = None if self._send(message.current()) else message

    def _send(self, message: Message) -> bool:
        from paho.mqtt.client import MQTT_ERR_SUCCESS
        from paho.mqtt.packettypes import PacketTypes
        from paho.mqtt.properties import Properties

        properties = Properties(PacketTypes.PUBLISH)
        if message.valid:
            properties.MessageExpiryInterval = max(1, math.ceil(message.deadline - time.monotonic()))
        info = self._client.publish(self.topic, message.line(), qos=0, retain=True, properties=properties)
        if info.rc != MQTT_ERR_SUCCESS:
            self._connected.clear()
            return False
        # One at a time: the client's own queue has no bound.
        written = self._wait_until_written(info)
        self._sent += written
        return written

    def _wait_until_written(self, info: MQTTMessageInfo) -> bool:
        """True once the connection took the message, False when it broke before."""
        while not self._stopping.is_set():
            try:
                info.wait_for_publish(0.2)
                if info.is_published():
                    return True
            except RuntimeError:
                return False
        return False

    def _on_connect(self, client: Client, userdata: Any, flags: Any, reason: Any, properties: Any) -> None:
        self._detail = str(reason)
        if reason.is_failure:
            log.warning("MQTT broker %s:%d refuses the connection: %s", self.host, self.port, reason)
            return
        log.info("MQTT broker %s:%d: connected", self.host, self.port)
        self._connected.set()

    def _on_disconnect(self, client: Client, userdata: Any, flags: Any, reason: Any, properties: Any) -> None:
        if self._connected.is_set():
            # A refused connection ends too, but then the refusal is what the operator needs to read.
            self._connected.clear()
            self._detail = f"disconnected: {reason}"
            log.warning("MQTT broker %s:%d: %s; connecting again", self.host, self.port, self._detail)


def _client(login: MqttLogin) -> Client:
    """A client with its login, not yet connected."""
    try:
        from paho.mqtt.client import Client
        from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion
    except ImportError:
        raise MissingExtraError("paho-mqtt", "mqtt") from None

    client = Client(CallbackAPIVersion.VERSION2, protocol=MQTTProtocolVersion.MQTTv5)
    if login.user is not None:
        client.username_pw_set(login.user, login.password)
    if login.authority is not None:
        try:
            client.tls_set(ca_certs=str(login.authority))
        except (OSError, ssl.SSLError) as fault:
            raise OutputError(f"is no certificate: {fault}", file=login.authority, key="mqtt.authority") from None
    return client
