"""Time as live operation sees it: one object, so that a test can let a month pass in seconds."""

from __future__ import annotations

import threading
import time


class Clock:
    """The machine's clocks."""

    def time_ns(self) -> int:
        """Time of day [ns since 1970]; may be set."""
        return time.time_ns()

    def monotonic(self) -> float:
        """Time on the clock that nobody sets [s]."""
        return time.monotonic()

    def wait(self, event: threading.Event, seconds: float) -> None:
        """Wait until `event` is set, but no longer than `seconds`."""
        event.wait(max(0.0, seconds))


SYSTEM = Clock()
