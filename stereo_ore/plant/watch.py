"""Frames that appear in a folder: complete ones only, each once, in the natural order of their
names.

A frame is complete when both eyes are there and their files are: PNG and JPEG by their end marker,
other formats when they have stopped growing. A frame that stays incomplete holds up those behind it
for `patience_s` and is then handed on as it is, so that it is recorded as failed. A frame that
sorts before one already handed on comes too late: it is counted, and never processed. So the name
of the last frame done is all that a restart needs to know.

The age of a frame counts from when it was first seen here, by a clock that nobody sets: a share's
server may have another time of day. Only for frames that were there at the start its files' times
are all that is known.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from stereo_ore.config.models import MAX_PIXELS
from stereo_ore.errors import FrameError, SourceError
from stereo_ore.io.recordings import expect_eyes, frame_size, limit_pixels
from stereo_ore.io.recordings.folder import ImagePairs
from stereo_ore.io.recordings.images import is_complete
from stereo_ore.io.recordings.names import natural_key
from stereo_ore.plant.arrivals import Arrival, arrivals
from stereo_ore.plant.frames import LiveFrame, Position
from stereo_ore.types import StereoPair

log = logging.getLogger(__name__)

SETTLED_S = 1.0
"""A file in a format without an end marker is complete when it has not changed for this time."""
SCAN_SHARE = 0.25
"""At most this share of the time is spent listing the folder, however large it grows."""
PRUNE_AT = 100_000
"""Names of files done are forgotten, where the files are gone, when there are so many."""
MOST_SKEW_S = 1.0
"""Clocks of files and of this machine may differ by so much without a word."""


@dataclass(frozen=True)
class _Pending:
    """The next frame while it is not complete: what its files look like, and since when."""

    name: str
    looks: tuple[tuple[int, int], ...]
    since: float


class FolderWatch:
    """Watches `folder`, which may be empty at first, in any layout of image files that `run` knows.

    `eye_size` (width, height) [px] is that of the calibration: an image of that size is no
    side-by-side one.
    """

    def __init__(
        self,
        folder: Path,
        *,
        poll_s: float = 0.2,
        patience_s: float = 10.0,
        max_pixels: int = MAX_PIXELS,
        eye_size: tuple[int, int] | None = None,
    ) -> None:
        if not folder.is_dir():
            raise SourceError(
                "no such folder",
                file=folder,
                remedy="Make the folder that frames will be copied to",
            )
        self.folder = folder
        self.name = str(folder)
        self._poll_s, self._patience_s, self._max_pixels = poll_s, patience_s, max_pixels
        self._eye_size = eye_size
        self._pending: _Pending | None = None
        self._done: set[str] = set()
        self._prune_at = PRUNE_AT
        self._pairs = False
        self._late = 0
        self._waiting = 0
        self._problem = ""
        self._seen_s: dict[str, float] = {}
        self._told_skew = False
        self._waited_s = 0.0
        self._quiet_s = 0.0

    def frames(self, start: Position, stop: threading.Event) -> Iterator[LiveFrame]:
        """Frames that sort after `start.after`, as they become complete."""
        after, index, watching, began = start.after, start.index, False, time.monotonic()
        while not stop.is_set():
            self._quiet_s, began = time.monotonic() - began, time.monotonic()
            waiting = self._new_frames(after, late=watching)
            self._see(waiting, watching)
            watching, scan_s = True, time.monotonic() - began
            pause_s = max(self._poll_s, scan_s / SCAN_SHARE)
            for place, arrival in enumerate(waiting):
                # What arrives while a frame is worked on is to be seen soon: its age counts from
                # then.
                overdue = place > 0 and time.monotonic() - began > pause_s
                if stop.is_set() or overdue or not self._ready(arrival):
                    break
                after, self._waiting = arrival.name, len(waiting) - place - 1
                self._done.update(map(str, arrival.files))
                yield self._frame(arrival, index)
                index += 1
            stop.wait(max(0.0, began + pause_s - time.monotonic()))

    def state(self) -> str:
        """What is waited for."""
        parts = [f"watching {self.folder}"]
        if self._waiting:
            parts.append(f"{self._waiting} waiting")
        if self._pending:
            parts.append(f"{self._pending.name} is not complete")
        if self._late:
            parts.append(f"{self._late} came too late and are left out")
        if self._problem:
            parts.append(self._problem)
        return "; ".join(parts)

    def _new_frames(self, after: str | None, late: bool) -> list[Arrival]:
        """Frames that sort after `after`; the others are done or, once the folder is being watched,
        too late.
        """
        try:
            found, self._problem = arrivals(self.folder, self._done), ""
        except OSError as fault:
            # A network folder comes back; until then targets expire.
            found, self._problem = [], f"can't be read: {fault.strerror}"
        # A picture without a mark beside left and right ones is no side-by-side frame.
        self._pairs |= any(isinstance(arrival.source, ImagePairs) for arrival in found)
        if self._pairs:
            found = [arrival for arrival in found if isinstance(arrival.source, ImagePairs)]
        if after is None:
            return found
        limit = natural_key(after)
        past = [arrival for arrival in found if natural_key(arrival.name) <= limit]
        self._leave_out(past)
        if late and past:
            self._late += len(past)
            log.warning(
                "%d frames in %s sort before %s, which is done: left out",
                len(past),
                self.folder,
                after,
            )
        return found[len(past) :]

    def _leave_out(self, past: list[Arrival]) -> None:
        self._done.update(str(file) for arrival in past for file in arrival.files)
        if len(self._done) > self._prune_at:
            self._done = {file for file in self._done if os.path.exists(file)}
            self._prune_at = max(PRUNE_AT, 2 * len(self._done))

    def _see(self, waiting: Sequence[Arrival], watching: bool) -> None:
        """Note when frames are first seen; those that were there at the start are as old as their
        files.
        """
        now_s = time.monotonic()
        earlier = self._seen_s
        self._seen_s = {}
        for arrival in waiting:
            if arrival.name in earlier:
                self._seen_s[arrival.name] = earlier[arrival.name]
            elif watching:
                self._seen_s[arrival.name] = now_s
                self._check_clock(arrival)

    def _check_clock(self, arrival: Arrival) -> None:
        """Say once when the clock of the files is not this machine's, by a frame that has come
        since the last look.
        """
        skew_s = (time.time_ns() - _changed_ns(arrival)) / 1e9
        slack_s = MOST_SKEW_S + (self._quiet_s if skew_s > 0 else 0)
        if abs(skew_s) > slack_s and not self._told_skew:
            self._told_skew = True
            way = "behind" if skew_s > 0 else "ahead of"
            log.warning(
                "the clock of files in %s is %.1f s %s this machine's: ages of frames count from"
                " when they are seen",
                self.folder,
                abs(skew_s),
                way,
            )

    def _ready(self, arrival: Arrival) -> bool:
        """Whether the frame may be handed on: complete, or waited for long enough."""
        try:
            looks = tuple(
                (stat.st_size, stat.st_mtime_ns) for stat in (file.stat() for file in arrival.files)
            )
        except OSError:
            looks = ()
        pending = self._pending
        if pending is None or (pending.name, pending.looks) != (arrival.name, looks):
            pending = self._pending = _Pending(arrival.name, looks, time.monotonic())
        unchanged_s = time.monotonic() - pending.since
        if arrival.paired and all(_is_whole(file, unchanged_s) for file in arrival.files):
            self._pending, self._waited_s = None, 0.0
            return True
        if unchanged_s >= self._patience_s:
            self._pending, self._waited_s = None, unchanged_s
            log.warning(
                "frame %s was not complete and did not change for %.0f s", arrival.name, unchanged_s
            )
            return True
        return False

    def _frame(self, arrival: Arrival, index: int) -> LiveFrame:
        source = limit_pixels(arrival.source, self._max_pixels)
        arrival = replace(
            arrival, source=expect_eyes(source, self._eye_size) if self._eye_size else source
        )
        seen_s = self._seen_s.get(arrival.name)
        arrived_ns = _changed_ns(arrival)
        if seen_s is not None:
            arrived_ns = time.time_ns() - round(1e9 * (time.monotonic() - seen_s))
        waited_s = self._waited_s

        def read() -> StereoPair:
            try:
                pair = arrival.source.read(0)
            except FrameError as fault:
                raise _after_waiting(fault, waited_s) from None
            if pair.stamp_source == "modification time":
                pair = replace(pair, stamp_ns=arrived_ns, stamp_source="arrival")
            return replace(pair, index=index)

        return LiveFrame(arrival.name, index, arrived_ns, arrival.files, read, seen_s)


def _after_waiting(fault: FrameError, waited_s: float) -> FrameError:
    """The same fault; a frame that was waited for in vain says so."""
    if not waited_s:
        return fault
    problem = f"{fault.problem} (waited for {waited_s:.0f} s)"
    return FrameError(problem, code=fault.code, file=fault.file, key=fault.key, remedy=fault.remedy)


def _is_whole(file: Path, unchanged_s: float) -> bool:
    """Whether a file ends as its format says or, for formats that say nothing, has not changed for
    a while.
    """
    try:
        # Of a file only: a pipe under its name would be waited for.
        data = file.read_bytes() if file.is_file() else b""
    except OSError:
        return False
    complete = is_complete(data)
    return bool(data) and unchanged_s >= SETTLED_S if complete is None else complete


def _changed_ns(arrival: Arrival) -> int:
    """When its files got their content here: copying tools carry the modification time over, not
    the change time.
    """
    return max(
        (file.stat().st_ctime_ns for file in arrival.files if file.exists()), default=time.time_ns()
    )


def first_size(folder: Path) -> tuple[int, int] | None:
    """Width and height [px] of the first frame that lies in a folder already and can be read."""
    for arrival in arrivals(folder, ()) if folder.is_dir() else ():
        if arrival.paired and (size := frame_size(arrival.source)):
            return size
    return None
