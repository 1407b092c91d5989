"""How much memory a piece of work takes: the process's resident set, sampled while it runs."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path

INTERVAL_S = 0.001
STATM = Path("/proc/self/statm")
"""Where Linux says it; elsewhere memory is not measured."""

Samples = list[tuple[float, int]]
"""Times of `time.perf_counter` and bytes."""


def sampled(work: Callable[[], object]) -> Samples:
    """Do `work` while a thread takes samples; empty where the system does not tell."""
    if not STATM.exists():
        work()
        return []
    samples: Samples = []
    over = threading.Event()
    page = os.sysconf("SC_PAGE_SIZE")

    def sample() -> None:
        samples.append((time.perf_counter(), int(STATM.read_text().split()[1]) * page))

    def watch() -> None:
        while not over.wait(INTERVAL_S):
            sample()

    sample()
    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        work()
    finally:
        over.set()
        watcher.join()
    sample()
    return samples


def peak_mb(samples: Samples) -> float | None:
    """The largest resident set [MB]."""
    return max(size for _, size in samples) / 1e6 if samples else None


def stage_peaks_mb(
    samples: Samples, start: float, stages_ms: Mapping[str, float]
) -> dict[str, float]:
    """The largest resident set [MB] in each of the stages that follow each other from `start`
    on.
    """
    peaks = {}
    for name, ms in stages_ms.items():
        end = start + ms / 1000
        within = [size for t, size in samples if start - INTERVAL_S <= t <= end + INTERVAL_S]
        if within:
            peaks[name] = max(within) / 1e6
        start = end
    return peaks
