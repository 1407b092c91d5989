"""Thirty days of `serve` on a clock of its own: the end of a month, a counter that begins anew,
upgrades, kills, full disks and a backlog of ten thousand frames.

Everything but the chain, the clock and the operating system's word of new files is the real thing.
The clock moves when somebody waits, and what happens in the plant happens as it moves.
"""

import errno
import gc
import heapq
import json
import os
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from live import ListSink, make_record

from stereo_ore.io import segments
from stereo_ore.io.results import Results
from stereo_ore.plant.clock import Clock
from stereo_ore.plant.frames import LiveFrame
from stereo_ore.plant.live_folder import LiveFolder
from stereo_ore.plant.loop import Done, serve
from stereo_ore.plant.publisher import Publisher
from stereo_ore.plant.retention import Retention, parse_limits
from stereo_ore.plant.status import PlantStatus
from stereo_ore.plant.watch import FolderWatch
from stereo_ore.runs.folder import FrameLines, RunFolder

PICTURE = b"\x89PNG\r\n\x1a\n" + b"\0\0\0\0IEND\xaeB`\x82"
BEGIN_NS = 1_800_000_000 * 10**9
"""15 January 2027: a month ends on the seventeenth day."""
DAYS, DAY_S = 30, 86_400.0
WORK_S = 2.0
"""Time that a frame takes."""
INBOX_S = 3600.0
LIMITS = ("clouds=2MB", "inbox=1h")


@dataclass(order=True)
class Event:
    at_s: float
    act: Callable[[], None] = field(compare=False)


class PlantClock(Clock):
    """Moves when somebody waits or works; what is due happens meanwhile."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.events: list[Event] = []

    def time_ns(self) -> int:
        return BEGIN_NS + round(1e9 * self.now_s)

    def monotonic(self) -> float:
        return self.now_s

    def at(self, at_s: float, act: Callable[[], None]) -> None:
        heapq.heappush(self.events, Event(at_s, act))

    def advance(self, seconds: float) -> None:
        end = self.now_s + seconds
        while self.events and self.events[0].at_s <= end:
            event = heapq.heappop(self.events)
            self.now_s = max(self.now_s, event.at_s)
            event.act()
        self.now_s = max(self.now_s, end)

    def wait(self, event: threading.Event, seconds: float) -> None:
        # No time passes where none was left: what is behind the newest frame gets its turn.
        if seconds > 0 and not event.is_set():
            idle_s = self.events[0].at_s - self.now_s if self.events else seconds
            self.advance(max(seconds, idle_s))


class Plant:
    """A camera that writes frames, a disk that is full at times, and an operator who restarts."""

    def __init__(self, folder: Path, period_s: float, backlog: int) -> None:
        self.inbox, self.out = folder / "in", folder / "live"
        self.inbox.mkdir()
        self.clock, self.period_s, self.backlog = PlantClock(), period_s, backlog
        self.ledger = (folder / "written").open("w")
        self.said: set[tuple[int, str]] = set()
        self.full, self.version, self.taken = False, 0, 0
        self.stop = threading.Event()
        self.largest_delay_s = 0.0
        self.samples: list[tuple[float, int, int, int]] = []
        self.alarms: set[str] = set()
        self.sink = CountingSink()

    def schedule(self) -> None:
        """All that happens in the month."""
        clock = self.clock
        self._take()
        for day in (5, 12, 19):
            clock.at(day * DAY_S, self._upgrade)
        for day in (3, 9.5, 15, 26):
            clock.at(day * DAY_S, self.stop.set)
        for day in (7, 22):
            clock.at(day * DAY_S, lambda: setattr(self, "full", True))
            clock.at((day + 0.7) * DAY_S, lambda: setattr(self, "full", False))
        for day in range(1, DAYS):
            clock.at((day + 0.99) * DAY_S, self._sample)
        clock.at(DAYS * DAY_S, self.stop.set)

    def run(self) -> None:
        """Serve until the month is over, with restarts."""
        while self.clock.now_s < DAYS * DAY_S:
            self.stop.clear()
            self._serve_once()
            if self.clock.now_s > 15 * DAY_S:
                for _ in range(self.backlog):
                    self._write(f"late_{self.taken:07d}", self.clock.time_ns() - 10**9)
                self.backlog = 0
            self.clock.advance(600)

    def _serve_once(self) -> None:
        about = {"source": "in", "versions": {"stereo-ore": str(self.version)}}
        watch = FolderWatch(self.inbox, queue=2, clock=self.clock)
        with (
            LiveFolder(self.out, about, clock=self.clock) as folder,
            Publisher([self.sink], 5.0) as publisher,
        ):
            status = PlantStatus(watch, publisher, lambda: folder.alarm)
            limits = parse_limits(LIMITS)
            retention = Retention(self.out, limits, watch.inbox.handled, self.clock)
            began_s = self.clock.now_s

            def process(frame: LiveFrame) -> Done:
                self.clock.advance(WORK_S)
                if folder.alarm:
                    self.alarms.add(folder.alarm.partition(";")[0])
                if frame.seen_s is not None and frame.seen_s > began_s + 1:
                    self.largest_delay_s = max(self.largest_delay_s, frame.age_s)
                return Done(self._lines(frame))

            serve(watch, process, folder, publisher, status, self.stop, retention)
            # Killed: nothing is finished, and what waits in memory is lost.

    def _lines(self, frame: LiveFrame) -> FrameLines:
        if not self.full:
            cloud = self.out / "clouds" / f"{frame.name}.ply"
            cloud.parent.mkdir(exist_ok=True)
            cloud.write_bytes(bytes(20_000))
            os.utime(cloud, ns=(self.clock.time_ns(), self.clock.time_ns()))
        record = make_record(frame.index, ores=1, frame=frame.name)
        entry = json.dumps({"frame": frame.name})
        return FrameLines(json.dumps(record), entry, entry)

    def _take(self) -> None:
        """One frame, and the next in its time; its name is a counter, a date, or a counter anew."""
        third = 3 * self.clock.now_s / (DAYS * DAY_S)
        stamp = datetime.fromtimestamp(self.clock.time_ns() / 1e9, UTC)
        name = f"{stamp:%d_%H%M%S}" if 1 <= third < 2 else f"{self.taken % 500:06d}"
        self._write(name, self.clock.time_ns())
        self.clock.at(self.clock.now_s + self.period_s, self._take)

    def _write(self, name: str, time_ns: int) -> None:
        self.taken += 1
        for side in ("left", "right"):
            file = self.inbox / f"{side}_{name}.png"
            file.write_bytes(PICTURE)
            os.utime(file, ns=(time_ns, time_ns))
            self.said.add((1, str(file)))
        self.ledger.write(f"{time_ns} {self.inbox}/left_{name}.png\n")

    def written(self) -> set[tuple[str, int]]:
        """All frames; on the disk until the end: in memory a month of them would not be flat."""
        self.ledger.close()
        lines = Path(self.ledger.name).read_text().splitlines()
        parts = (line.partition(" ") for line in lines)
        return {(path, int(time_ns)) for time_ns, _, path in parts}

    def watch(self, *_: Path, **__: object) -> Iterator[set[tuple[int, str]]]:
        """What the operating system says of new files; to wait for it would take an hour."""
        while True:
            said, self.said = self.said, set()
            yield said

    def _upgrade(self) -> None:
        self.version += 1
        self.stop.set()

    def _sample(self) -> None:
        gc.collect()
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        clouds = sum(file.stat().st_size for file in (self.out / "clouds").iterdir())
        memory = pages * os.sysconf("SC_PAGE_SIZE")
        self.samples.append((self.clock.now_s, memory, clouds, len(os.listdir(self.inbox))))


class CountingSink(ListSink):
    """Counts messages with targets; a month of them would not be flat."""

    valid = full = 0

    def publish(self, message: Any) -> None:
        self.valid += message.valid
        self.full += message.valid and "DISK_FULL" in message.reasons


def recorded(out: Path) -> Iterator[tuple[str, int]]:
    for entry in Results(out).inputs():
        (left,) = (path for path in entry["files"] if "left_" in path)
        yield left, entry["written_ns"]


def live_through(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, period_s: float, backlog: int
) -> None:
    plant = Plant(tmp_path, period_s, backlog)
    append = RunFolder._append

    def write(self: RunFolder, name: str, line: str) -> None:
        if plant.full:
            raise OSError(errno.ENOSPC, "No space left on device")
        append(self, name, line)

    monkeypatch.setattr(RunFolder, "_append", write)
    monkeypatch.setattr("watchfiles.watch", plant.watch)
    plant.schedule()
    begin = time.monotonic()
    plant.run()
    statuses = Counter(record["status"] for record in Results(plant.out).each_record())
    memory = [sample[1] / 1e6 for sample in plant.samples]
    figures = {
        "seconds": round(time.monotonic() - begin, 1),
        "frames": plant.taken,
        "records": dict(statuses),
        "parts": len(segments.closed(plant.out)) + 1,
        "delay of fresh frames, largest [s]": round(plant.largest_delay_s, 2),
        "memory [MB] at the end of days 2, 10, 12, 20, 30": [
            round(memory[day - 2]) for day in (2, 10, 12, 20, 30)
        ],
        "clouds, largest [MB]": max(sample[2] for sample in plant.samples) / 1e6,
        "files in the inbox, largest": max(sample[3] for sample in plant.samples),
        "messages with targets, on a full disk": [plant.sink.valid, plant.sink.full],
    }
    sys.stdout.write(json.dumps(figures, indent=1) + "\n")
    # Each frame once: those that wait in the inbox at the end are not due yet.
    found = Counter(recorded(plant.out))
    assert max(found.values()) == 1
    missing = plant.written() - found.keys()
    assert all(time_ns > plant.clock.time_ns() - 700 * 10**9 for _, time_ns in missing)
    assert statuses["skipped"] >= backlog - 1
    assert not plant.backlog
    assert plant.largest_delay_s < 2 * WORK_S + 0.5
    assert plant.sink.full > 10
    assert any("No space left" in alarm for alarm in plant.alarms)
    assert max(sample[2] for sample in plant.samples) < 2.2e6 + 20_000 * 60 / period_s
    # What waits on a full disk, or in a backlog, raises memory once; between such days it is flat.
    for first, last in ((4, 6), (10, 12), (24, 30)):
        assert memory[last - 2] < 1.02 * memory[first - 2] + 3
    assert memory[-1] < memory[0] + 50
    assert max(sample[3] for sample in plant.samples[-10:]) < 2 * (INBOX_S / period_s + 10)
    assert plant.version == 3


pytestmark = pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs /proc")


def test_thirty_days_of_a_frame_an_hour(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    live_through(tmp_path, monkeypatch, 3600.0, 1_000)


@pytest.mark.slow
def test_thirty_days_of_a_frame_in_five_seconds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Here a look comes every few seconds, in a plant several in one: their searches for names with
    # another file would be most of the test's time.
    monkeypatch.setattr("stereo_ore.plant.inbox.RECHECKS", 50)
    live_through(tmp_path, monkeypatch, 5.0, 10_000)
