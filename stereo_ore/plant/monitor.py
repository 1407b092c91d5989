"""A live run for monitors: health as JSON, and metrics in Prometheus' text format (version
0.0.4).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from stereo_ore.plant.live_files import NO_DISK_BYTES, free_bytes
from stereo_ore.plant.status import LATENCY_S, PlantStatus
from stereo_ore.version import __version__

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
_LITTLE_DISK_BYTES = 10**9

_Sample = tuple[Mapping[str, str], float]
"""Labels and value."""


def health(status: PlantStatus, folder: Path) -> dict[str, Any]:
    """Whether the program is in order: status ok, warning or alarm, and what is the matter.

    An alarm needs somebody (a server that does not come up again, a full disk). A warning may pass
    by itself: no frame for longer than targets hold, no consumer.
    """
    alarms, warnings = status.alarms(), []
    free = free_bytes(folder)
    if free < NO_DISK_BYTES:
        if not status.disk_fault:
            alarms.append(f"{folder}: {free // 10**6} MB left on the disk")
    elif free < _LITTLE_DISK_BYTES:
        warnings.append(f"{folder}: {free // 10**6} MB left on the disk")
    frame_s, _ = status.ages_s()
    if frame_s is None:
        warnings.append("no frame yet")
    elif frame_s > status.publisher.valid_for_s:
        warnings.append(f"no frame for {frame_s:.0f} s")
    warnings += [
        f"{s.name} {s.address}: nobody connected"
        for s in status.publisher.states()
        if not s.connected
    ]
    verdict = "alarm" if alarms else "warning" if warnings else "ok"
    return {"status": verdict, "alarms": alarms, "warnings": warnings, "version": __version__}


def metrics(status: PlantStatus, folder: Path) -> str:
    """All that changes, with units in the names."""
    return "".join(f"{line}\n" for family in _families(status, folder) for line in family)


def _families(status: PlantStatus, folder: Path) -> Iterator[Iterable[str]]:
    counts, (frame_s, target_s), latest = status.counts(), status.ages_s(), status.publisher.latest
    sinks = [
        ({"sink": state.name, "address": state.address}, state)
        for state in status.publisher.states()
    ]
    yield _family("info", "gauge", "version of the program", [({"version": __version__}, 1)])
    by_status = [({"status": name}, number) for name, number in sorted(counts.statuses.items())]
    yield _family("frames_total", "counter", "frames by status", by_status)
    reasons = [({"code": code}, number) for code, number in sorted(counts.reasons.items())]
    yield _family("reasons_total", "counter", "reasons of frames by code", reasons)
    yield _family("targets_total", "counter", "targets of all frames", [({}, counts.targets)])
    yield _latency(counts.latencies, counts.latency_sum_s)
    yield _family("frame_age_seconds", "gauge", "time since the last frame", _known(frame_s))
    yield _family(
        "target_age_seconds", "gauge", "time since the last frame with a target", _known(target_s)
    )
    yield _family(
        "targets_valid", "gauge", "targets that may be struck now", [({}, len(latest.targets))]
    )
    yield _family(
        "message_sequence", "gauge", "number of the last message", [({}, latest.sequence)]
    )
    yield _family(
        "fines_share",
        "gauge",
        "share of the screen under fines and mud in the last frame",
        _known(status.fines_share()),
    )
    yield _family(
        "sink_consumers", "gauge", "connected consumers", [(of, s.consumers) for of, s in sinks]
    )
    yield _family("sink_sent_total", "counter", "messages sent", [(of, s.sent) for of, s in sinks])
    yield _family(
        "sink_dropped_total", "counter", "messages dropped", [(of, s.dropped) for of, s in sinks]
    )
    yield _family(
        "sink_restarts_total",
        "counter",
        "servers started again",
        [(of, s.restarts) for of, s in sinks],
    )
    yield _family(
        "sink_alarm", "gauge", "1: look after it", [(of, bool(s.alarm)) for of, s in sinks]
    )
    yield _family("disk_free_bytes", "gauge", "free for results", [({}, free_bytes(folder))])
    yield _family(
        "alarms", "gauge", "what somebody has to look after", [({}, len(status.alarms()))]
    )


def _family(name: str, kind: str, text: str, samples: Iterable[_Sample]) -> list[str]:
    lines = [f"stereo_ore_{name}{_labels(labels)} {float(value)!r}" for labels, value in samples]
    return [f"# HELP stereo_ore_{name} {text}", f"# TYPE stereo_ore_{name} {kind}", *lines]


def _known(value: float | None) -> list[_Sample]:
    return [] if value is None else [({}, value)]


def _latency(numbers: list[int], sum_s: float) -> list[str]:
    name, total, lines = "stereo_ore_latency_seconds", 0, []
    for bound, number in zip((*map(str, LATENCY_S), "+Inf"), numbers, strict=True):
        total += number
        lines.append(f'{name}_bucket{{le="{bound}"}} {total}')
    head = [f"# HELP {name} from a frame's arrival to its publication", f"# TYPE {name} histogram"]
    return [*head, *lines, f"{name}_sum {sum_s!r}", f"{name}_count {total}"]


def _labels(labels: Mapping[str, str]) -> str:
    if not labels:
        return ""
    escape = str.maketrans({"\\": r"\\", '"': r"\"", "\n": r"\n"})
    return (
        "{"
        + ",".join(f'{name}="{value.translate(escape)}"' for name, value in labels.items())
        + "}"
    )
