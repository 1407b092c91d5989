"""What every consumer of targets has in common: it takes a message at once, and sends it when it
can.
"""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass
from types import TracebackType
from typing import Protocol, Self, runtime_checkable

from stereo_ore.plant.sinks.message import Message
from stereo_ore.types import JsonMapping

OUTBOX_SIZE = 64
"""Messages kept for a consumer that is slow or away; the oldest goes first, and is counted."""


@dataclass(frozen=True)
class SinkState:
    """How a sink is doing, for the operator; `alarm` is what he has to look after, empty while all
    is well.
    """

    name: str
    address: str
    connected: bool
    consumers: int
    sent: int
    dropped: int
    detail: str = ""
    alarm: str = ""
    restarts: int = 0


class TargetSink(Protocol):
    """Sends messages in a thread of its own, from entering the context until leaving it.

    Entering raises `OutputError` for what can't come right by itself (a port in use, a certificate
    that is none); a consumer that is away is waited for.
    """

    def __enter__(self) -> Self: ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None: ...

    def publish(self, message: Message) -> None:
        """Take a message; never blocks, never raises for the consumer's sake."""
        ...

    def state(self) -> SinkState:
        """What to show the operator."""
        ...


@runtime_checkable
class FrameSink(TargetSink, Protocol):
    """A sink that shows more of a frame than its targets."""

    def show(self, message: Message, record: JsonMapping, age_s: float) -> None:
        """Take the message of a frame with its record, `age_s` after it arrived [s]; as `publish`,
        in its place.
        """
        ...

    def show_files(self, record: JsonMapping) -> None:
        """Take that the cloud and overlay of a frame are in the run's folder, if it has any."""
        ...


class Outbox:
    """A bounded queue whose writer never waits: when it is full the oldest message is dropped and
    counted.
    """

    def __init__(self, size: int = OUTBOX_SIZE) -> None:
        self._messages: deque[Message] = deque()
        self._size = size
        self._changed = threading.Condition()
        self._closed = False
        self.dropped = 0

    def put(self, message: Message) -> None:
        """Append a message."""
        with self._changed:
            if len(self._messages) == self._size:
                self._messages.popleft()
                self.dropped += 1
            self._messages.append(message)
            self._changed.notify()

    def get(self, timeout_s: float) -> Message | None:
        """The oldest message as it may be sent now; None when there is none in time."""
        with self._changed:
            self._changed.wait_for(lambda: self._messages or self._closed, timeout_s)
            return self._messages.popleft().current() if self._messages else None

    def close(self) -> None:
        """Wake the reader; it takes what is left and then ends."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    @property
    def finished(self) -> bool:
        """True when closed and empty."""
        with self._changed:
            return self._closed and not self._messages
