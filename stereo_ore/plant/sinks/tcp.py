"""Targets as JSON lines over TCP: connect, and read a line a message and a heartbeat line a
second.
"""

from __future__ import annotations

import json
import logging
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from types import TracebackType
from typing import Self

from stereo_ore.plant.listening import connections, listen, stop_listening
from stereo_ore.plant.sinks.base import Outbox, SinkState
from stereo_ore.plant.sinks.message import Message

_log = logging.getLogger(__name__)

TCP_HEARTBEAT_S = 1.0
SEND_TIMEOUT_S = 5.0
MAX_CONSUMERS = 16
HANGING_S = 2.5
"""A consumer that has taken nothing for this time, in which two heartbeats were due, gives its
place to one waiting."""
_CLOSING_S = 1.0
"""Time a consumer has to take the last messages."""


class TcpSink:
    """Listens on `host`:`port`; each consumer has a thread and an outbox of its own.

    Parameters
    ----------
    host, port
        Where to listen; port 0 takes a free one, see `port`.
    """

    def __init__(self, host: str, port: int) -> None:
        self.host, self.port = host, port
        self._consumers: dict[_Consumer, None] = {}
        self._latest: Message | None = None
        self._lock = threading.Lock()
        self._sent = self._dropped = 0

    def __enter__(self) -> Self:
        self._server = listen(self.host, self.port, "tcp")
        self.port = self._server.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True, name="tcp-accept").start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        stop_listening(self._server)
        with self._lock:
            consumers = list(self._consumers)
        end = time.monotonic() + _CLOSING_S
        for consumer in consumers:
            consumer.outbox.close()
        for consumer in consumers:
            consumer.thread.join(max(0.0, end - time.monotonic()))

    def publish(self, message: Message) -> None:
        """Hand the message to each consumer's outbox."""
        with self._lock:
            self._latest = message
            for consumer in self._consumers:
                consumer.outbox.put(message)

    def state(self) -> SinkState:
        """Consumers, lines sent and messages dropped so far."""
        with self._lock:
            sent = self._sent + sum(consumer.sent for consumer in self._consumers)
            dropped = self._dropped + sum(consumer.outbox.dropped for consumer in self._consumers)
            count = len(self._consumers)
        return SinkState("TCP", f"{self.host}:{self.port}", count > 0, count, sent, dropped)

    def _accept(self) -> None:
        for connection, address in connections(self._server):
            with self._lock:
                if len(self._consumers) >= MAX_CONSUMERS and not self._make_room():
                    connection.close()
                    continue
                consumer = _Consumer(connection, str(address), self._leave)
                if self._latest is not None:
                    consumer.outbox.put(self._latest)
                self._consumers[consumer] = None
                # Under the lock, for whoever finds a consumer may join its thread.
                consumer.thread.start()

    def _make_room(self) -> bool:
        """Cut off the consumer that has hung for longest; False when none hangs. The lock is
        held.
        """
        longest = min(self._consumers, key=lambda consumer: consumer.taken)
        if time.monotonic() - longest.taken < HANGING_S:
            return False
        _log.warning("TCP consumer %s takes nothing: cut off for another", longest.address)
        self._forget(longest)
        longest.cut()
        return True

    def _leave(self, consumer: _Consumer) -> None:
        with self._lock:
            if consumer in self._consumers:
                self._forget(consumer)

    def _forget(self, consumer: _Consumer) -> None:
        del self._consumers[consumer]
        self._sent += consumer.sent
        self._dropped += consumer.outbox.dropped


class _Consumer:
    """One connection. Whoever takes nothing for `SEND_TIMEOUT_S` is cut off, and may connect
    again.
    """

    def __init__(
        self, connection: socket.socket, address: str, leave: Callable[[_Consumer], None]
    ) -> None:
        self.outbox = Outbox()
        self.address = address
        self.sent = 0
        self.taken = time.monotonic()
        self._connection, self._leave = connection, leave
        self.thread = threading.Thread(target=self._run, daemon=True, name=f"tcp {address}")

    def _run(self) -> None:
        self._connection.settimeout(SEND_TIMEOUT_S)
        try:
            while not self.outbox.finished:
                message = self.outbox.get(TCP_HEARTBEAT_S)
                if message is not None:
                    self._connection.sendall(message.line().encode() + b"\n")
                    self.sent += 1
                elif not self.outbox.finished:
                    self._connection.sendall(_heartbeat())
                self.taken = time.monotonic()
        except OSError as fault:
            _log.info("TCP consumer %s is gone: %s", self.address, fault)
        finally:
            self._connection.close()
            self._leave(self)

    def cut(self) -> None:
        """End the connection under the thread that sends; it then closes and leaves by itself."""
        self.outbox.close()
        with suppress(OSError):
            self._connection.shutdown(socket.SHUT_RDWR)


def _heartbeat() -> bytes:
    return (
        json.dumps({"schema": "stereo_ore/heartbeat/1", "time_ns": time.time_ns()}).encode() + b"\n"
    )
