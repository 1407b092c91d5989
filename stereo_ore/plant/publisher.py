"""Numbers messages, hands them to every sink, and withdraws targets when no new frame comes in
time.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from types import TracebackType
from typing import Self

from stereo_ore.plant.sinks.base import FrameSink, SinkState, TargetSink
from stereo_ore.plant.sinks.message import Message, Origin, message, new_session, notice
from stereo_ore.types import JsonMapping


class Publisher:
    """Open sinks, and a timer of its own so that a frame that hangs can't keep old targets valid.

    Parameters
    ----------
    sinks
        Entered with the publisher, left with it after a last message without targets.
    valid_for_s : float
        How long a frame's targets hold after it was taken [s].
    origin : Origin
        What all messages share; a session is put in where there is none.
    """

    def __init__(
        self,
        sinks: Sequence[TargetSink],
        valid_for_s: float,
        origin: Origin = Origin(),  # noqa: B008
    ) -> None:
        self.valid_for_s = valid_for_s
        self._sinks = sinks
        self._origin = origin if origin.session else replace(origin, session=new_session())
        self._sequence = 1
        self._latest = notice(0, self._origin, "starting")
        self._changed = threading.Condition()
        self._closed = False
        self._stack = ExitStack()
        self._timer = threading.Thread(target=self._expire, daemon=True, name="expiry")

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            for sink in self._sinks:
                stack.enter_context(sink)
            self._stack = stack.pop_all()
        self._timer.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with self._changed:
            self._closed = True
            self._send(notice(self._sequence, self._origin, "stopped"))
            self._changed.notify()
        self._timer.join()
        self._stack.close()

    def publish(self, record: JsonMapping, age_s: float, notes: Sequence[str] = ()) -> Message:
        """Publish the targets of a record whose frame was taken `age_s` seconds ago; `notes` are
        further reason codes, which take no target away.
        """
        with self._changed:
            made = message(
                record, self._sequence, self._origin, age_s=age_s, valid_for_s=self.valid_for_s
            )
            made = replace(made, reasons=(*made.reasons, *notes))
            self._send(made, record, age_s)
            self._changed.notify()
        return made

    def show_files(self, record: JsonMapping) -> None:
        """Tell the sinks that show them that the files of a frame are written."""
        for sink in self._sinks:
            if isinstance(sink, FrameSink):
                sink.show_files(record)

    @property
    def latest(self) -> Message:
        """The message that consumers have been given last."""
        with self._changed:
            return self._latest.current()

    def states(self) -> list[SinkState]:
        """How each sink is doing."""
        return [sink.state() for sink in self._sinks]

    def _send(self, made: Message, record: JsonMapping | None = None, age_s: float = 0.0) -> None:
        self._latest = made
        self._sequence += 1
        for sink in self._sinks:
            if record is not None and isinstance(sink, FrameSink):
                sink.show(made, record, age_s)
            else:
                sink.publish(made)

    def _expire(self) -> None:
        with self._changed:
            while not self._closed:
                remaining_s = (
                    self._latest.deadline - time.monotonic() if self._latest.valid else None
                )
                if remaining_s is not None and remaining_s <= 0:
                    self._send(self._withdrawal())
                else:
                    self._changed.wait(remaining_s)

    def _withdrawal(self) -> Message:
        """The latest frame again, now without targets."""
        old = self._latest
        return replace(
            old.withdrawn("EXPIRED"),
            sequence=self._sequence,
            status="expired",
            published_ns=time.time_ns(),
        )
