"""How a live run is doing: what the operator's page, a monitor and a watchdog are shown."""

from __future__ import annotations

import threading
import time
from bisect import bisect_left
from collections import Counter, deque
from collections.abc import Callable
from copy import deepcopy
from dataclasses import asdict, dataclass, field
from typing import Any

from stereo_ore.plant.frames import LiveSource
from stereo_ore.plant.publisher import Publisher
from stereo_ore.types import JsonMapping

RATE_FRAMES = 20
"""The frame rate is taken over this many frames."""
LATENCY_S = (0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)
"""Upper bounds of the classes in which latencies are counted."""


@dataclass
class Counts:
    """What has happened since the start."""

    statuses: Counter[str] = field(default_factory=Counter)
    reasons: Counter[str] = field(default_factory=Counter)
    targets: int = 0
    latencies: list[int] = field(default_factory=lambda: [0] * (len(LATENCY_S) + 1))
    latency_sum_s: float = 0.0


class PlantStatus:
    """Counts frames; may be read from any thread. `disk` tells what keeps results from being
    written.
    """

    def __init__(
        self, source: LiveSource, publisher: Publisher, disk: Callable[[], str] = str
    ) -> None:
        self._source, self._publisher, self._disk = source, publisher, disk
        self._lock = threading.Lock()
        self._times: deque[float] = deque(maxlen=RATE_FRAMES)
        self._counts = Counts()
        self._target_at: float | None = None
        self._last: JsonMapping | None = None

    def add(self, record: JsonMapping, latency_s: float | None = None) -> None:
        """One frame is done, `latency_s` after it arrived [s]; negative latencies, of a clock set
        back, count as 0.
        """
        with self._lock:
            counts = self._counts
            self._times.append(time.monotonic())
            counts.statuses[record["status"]] += 1
            counts.reasons.update(reason["code"] for reason in record["reasons"])
            counts.targets += len(record["targets"])
            if record["targets"]:
                self._target_at = time.monotonic()
            if latency_s is not None:
                counts.latencies[bisect_left(LATENCY_S, latency_s)] += 1
                counts.latency_sum_s += max(0.0, latency_s)
            self._last = record

    def counts(self) -> Counts:
        """A copy of all counts."""
        with self._lock:
            return deepcopy(self._counts)

    def ages_s(self) -> tuple[float | None, float | None]:
        """Time since the last frame and since the last frame with a target [s]; None: there was
        none.
        """
        now = time.monotonic()
        with self._lock:
            frame_at, target_at = self._times[-1] if self._times else None, self._target_at
        return (
            None if frame_at is None else now - frame_at,
            None if target_at is None else now - target_at,
        )

    def fines_share(self) -> float | None:
        """Share of the screen that the last frame saw under fines; None where it was not told."""
        with self._lock:
            screen = (self._last or {}).get("grizzly") or {}
        return screen.get("fines_share")

    def alarms(self) -> list[str]:
        """What somebody has to look after."""
        sinks = [f"{state.name}: {state.alarm}" for state in self.publisher.states() if state.alarm]
        return [*sinks, *filter(None, (self.disk_fault,))]

    @property
    def disk_fault(self) -> str:
        """What keeps results from being written; empty while nothing does."""
        return self._disk()

    @property
    def publisher(self) -> Publisher:
        """Where its targets go."""
        return self._publisher

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
            statuses = dict(self._counts.statuses)
        span = now - times[0] if len(times) > 1 else 0.0
        return {
            "source": self._source.state(),
            "alarms": self.alarms(),
            "sinks": [asdict(state) for state in self._publisher.states()],
            "frames": statuses,
            "frame_rate_hz": round((len(times) - 1) / span, 3) if span else None,
            "last_frame": last
            and {key: last[key] for key in ("frame", "index", "status", "reasons", "counts")},
            "age_s": round(now - times[-1], 2) if times else None,
            "valid_for_s": self._publisher.valid_for_s,
            "valid_s": round(max(0.0, latest.deadline - now), 2) if latest.valid else 0.0,
            "message": latest.json(),
        }
