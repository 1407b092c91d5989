"""How a live run is doing: what the operator's page shows."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from dataclasses import asdict
from typing import Any

from stereo_ore.plant.frames import LiveSource
from stereo_ore.plant.publisher import Publisher
from stereo_ore.plant.sinks.message import Json

RATE_FRAMES = 20
"""The frame rate is taken over this many frames."""


class Status:
    """Counts frames; may be read from any thread."""

    def __init__(self, source: LiveSource, publisher: Publisher) -> None:
        self._source, self._publisher = source, publisher
        self._lock = threading.Lock()
        self._times: deque[float] = deque(maxlen=RATE_FRAMES)
        self._statuses: Counter[str] = Counter()
        self._last: Json | None = None

    def add(self, record: Json) -> None:
        """One frame is done."""
        with self._lock:
            self._times.append(time.monotonic())
            self._statuses[record["status"]] += 1
            self._last = record

    @property
    def last_frame(self) -> str | None:
        """Name of the last frame done."""
        with self._lock:
            return self._last["frame"] if self._last else None

    def json(self) -> dict[str, Any]:
        """All that the page shows; ages in seconds at the time of asking."""
        now = time.monotonic()
        latest = self._publisher.latest
        with self._lock:
            times, last = list(self._times), self._last
            statuses = dict(self._statuses)
        span = now - times[0] if len(times) > 1 else 0.0
        return {
            "source": self._source.state(),
            "sinks": [asdict(state) for state in self._publisher.states()],
            "frames": statuses,
            "frame_rate_hz": round((len(times) - 1) / span, 3) if span else None,
            "last_frame": last and {key: last[key] for key in ("frame", "index", "status", "reasons", "counts")},
            "age_s": round(now - times[-1], 2) if times else None,
            "valid_for_s": self._publisher.valid_for_s,
            "valid_s": round(max(0.0, latest.deadline - now), 2) if latest.valid else 0.0,
            "message": latest.json(),
        }
