"""Targets to an MQTT broker: one retained message, replaced with every frame, withdrawn by the
broker if we vanish.
"""

from __future__ import annotations

import logging
import math
import ssl
import threading
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from stereo_ore.errors import MissingExtraError, OutputError
from stereo_ore.plant.sinks.base import Outbox, SinkState
from stereo_ore.plant.sinks.message import Message, Origin, notice, offline

if TYPE_CHECKING:
    from paho.mqtt.client import Client, MQTTMessageInfo

_log = logging.getLogger(__name__)

KEEPALIVE_S = 5
"""The broker withdraws the targets 1.5 times this after the connection has gone silent."""
RECONNECT_S = (1, 8)
"""First and longest pause between attempts to connect."""
_CLOSING_S = 1.0
GREETING_S = 1.0
"""Time for a new message after a connection before the latest is sent again."""
_HEADER_BYTES = 64
"""More than the fixed header, the topic's length and the properties of a packet take."""
RETAIN_NOT_SUPPORTED, QOS_NOT_SUPPORTED = 0x9A, 0x9B


@dataclass(frozen=True)
class MqttLogin:
    """User, password and the authority that signed the broker's certificate; all None for a broker
    on this machine.
    """

    user: str | None = None
    password: str | None = field(default=None, repr=False)
    authority: Path | None = None


@dataclass(frozen=True)
class _Offer:
    """What the broker can do, from its CONNACK (MQTT 5, 3.2.2.3) or from the reason of a
    refusal.
    """

    retain: bool = True
    qos: int = 1
    packet_bytes: int | None = None


class MqttSink:
    """Publishes to `topic` of the broker at `host`:`port`; what can't be sent waits in a bounded
    outbox.

    Messages are retained where the broker can, and expire in it with their targets (MQTT 5). After
    each connection the latest message is sent again, so that "offline" does not outlive the
    program's return. The connection's last will is a message without targets.

    Parameters
    ----------
    host, port, topic
        Where to, and under which name.
    login : MqttLogin, optional
        User, password, authority.
    qos : int
        0: a message is sent at most once, since a repeated old target would be worse than none; 1:
        at least once.
    origin : Origin
        What the last will says of the session that it ends.
    """

    def __init__(
        self,
        host: str,
        port: int,
        topic: str,
        login: MqttLogin | None = None,
        *,
        qos: int = 0,
        origin: Origin = Origin(),  # noqa: B008
    ) -> None:
        self.host, self.port, self.topic = host, port, topic
        self._qos, self._origin = qos, origin
        self._offer = _Offer()
        self._client = _client(login or MqttLogin())
        self._client.on_connect = self._on_connect
        self._client.on_disconnect = self._on_disconnect
        self._set_will()
        self._outbox = Outbox()
        self._latest = notice(0, origin, "starting")
        self._connected = threading.Event()
        self._greeted = threading.Event()
        self._stopping = threading.Event()
        self._detail = "connecting"
        self._alarm = ""
        self._sent = self._unsendable = 0
        self._thread = threading.Thread(target=self._run, daemon=True, name="mqtt")

    def __enter__(self) -> Self:
        self._client.reconnect_delay_set(*RECONNECT_S)
        self._client.connect_async(self.host, self.port, keepalive=KEEPALIVE_S)
        self._client.loop_start()
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._outbox.close()
        self._thread.join(_CLOSING_S)
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
        lost = self._outbox.dropped + self._unsendable
        return SinkState(
            "MQTT", address, connected, int(connected), self._sent, lost, self._detail, self._alarm
        )

    def _run(self) -> None:
        while not self._outbox.finished and not self._stopping.is_set():
            message = self._outbox.get(GREETING_S)
            if message is None and self._connected.is_set() and not self._greeted.is_set():
                message = self._latest
            while message is not None and not self._stopping.is_set():
                if self._connected.wait(0.2) and self._send(message.current()):
                    self._latest, message = message, None
                    self._greeted.set()

    def _send(self, message: Message) -> bool:
        """False when the connection broke before the message was on its way."""
        from paho.mqtt.client import MQTT_ERR_SUCCESS
        from paho.mqtt.packettypes import PacketTypes
        from paho.mqtt.properties import Properties

        fitting = self._fitting(message)
        if fitting is None:
            return True
        offer, properties = self._offer, Properties(PacketTypes.PUBLISH)
        if fitting.valid:
            properties.MessageExpiryInterval = max(
                1, math.ceil(fitting.deadline - time.monotonic())
            )
        arguments = {
            "qos": min(self._qos, offer.qos),
            "retain": offer.retain,
            "properties": properties,
        }
        info = self._client.publish(self.topic, fitting.line(), **arguments)
        if info.rc != MQTT_ERR_SUCCESS:
            self._connected.clear()
            return False
        # One at a time: the client's own queue has no bound.
        written = self._wait_until_written(info)
        self._sent += written
        return written

    def _fitting(self, message: Message) -> Message | None:
        """The message with as many of its best targets as the broker's largest packet holds; None:
        not even none.
        """
        limit = self._offer.packet_bytes
        room = None if limit is None else limit - _HEADER_BYTES - len(self.topic.encode())
        for count in range(len(message.targets), -1, -1):
            fitting = message.shortened(count)
            if room is None or len(fitting.line().encode()) <= room:
                self._alarm = (
                    ""
                    if fitting is message
                    else f"only {count} targets fit the broker's {limit} bytes"
                )
                return fitting
        self._alarm = f"no message fits the broker's {limit} bytes"
        self._unsendable += 1
        return None

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

    def _set_will(self) -> None:
        self._client.will_set(
            self.topic, offline(self._origin), qos=self._offer.qos, retain=self._offer.retain
        )

    def _on_connect(
        self, client: Client, userdata: Any, flags: Any, reason: Any, properties: Any
    ) -> None:
        self._detail = str(reason)
        if reason.is_failure:
            _log.warning(
                "MQTT broker %s:%d refuses the connection: %s", self.host, self.port, reason
            )
            self._do_without(reason.value)
            return
        self._offer = _Offer(
            bool(getattr(properties, "RetainAvailable", 1)) and self._offer.retain,
            min(getattr(properties, "MaximumQoS", 1), self._offer.qos),
            getattr(properties, "MaximumPacketSize", None),
        )
        if not self._offer.retain:
            self._detail += "; without retained messages"
        _log.info("MQTT broker %s:%d: connected", self.host, self.port)
        self._greeted.clear()
        self._connected.set()

    def _do_without(self, reason: int) -> None:
        """Ask less at the next attempt: a will that a broker can't keep is a reason to refuse the
        connection.
        """
        if reason == RETAIN_NOT_SUPPORTED:
            self._offer = replace(self._offer, retain=False)
        elif reason == QOS_NOT_SUPPORTED:
            self._offer = replace(self._offer, qos=0)
        self._set_will()

    def _on_disconnect(
        self, client: Client, userdata: Any, flags: Any, reason: Any, properties: Any
    ) -> None:
        if self._connected.is_set():
            # A refused connection ends too, but then the refusal is what the operator needs to
            # read.
            self._connected.clear()
            self._detail = f"disconnected: {reason}"
            _log.warning(
                "MQTT broker %s:%d: %s; connecting again", self.host, self.port, self._detail
            )
            self._do_without(reason.value)


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
            raise OutputError(
                f"is no certificate: {fault}", file=login.authority, key="mqtt.authority"
            ) from None
    return client
