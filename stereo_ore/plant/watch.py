"""Frames that appear in a folder: complete ones only, each once, in the order of their arrival.

A frame is complete when both eyes are there and their files are: PNG and JPEG by their end marker,
other formats when they have stopped growing. A frame that stays incomplete for `patience_s` is
handed on as it is, so that it is recorded as failed; it holds up nobody. Order goes by when files
were written, then by names: a counter that is reset, a new month or names of any kind lose nothing,
and a name that is used again is a new frame.

When more frames wait than `queue`, the newest is next, and those it has overtaken are handed on to
be recorded as skipped: an arm needs to know what lies there now.

A frame is as old as its name or its files say, and never younger than since it was first seen here,
by a clock that nobody sets. Where a share's server has another time of day, frames in a row are
alike late, and that is taken off; `trust_times` off never looks at names and files.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from stereo_ore.config.models import MAX_PIXELS
from stereo_ore.errors import FrameError, SourceError
from stereo_ore.io.recordings import expect_eyes, frame_size, limit_pixels
from stereo_ore.io.recordings.folder import ImagePairs
from stereo_ore.io.recordings.images import IMAGE_SUFFIXES, is_complete
from stereo_ore.io.recordings.layouts import Listing, list_files
from stereo_ore.io.recordings.names import (
    STAMPS_FROM_NS,
    STAMPS_TO_NS,
    name_stamp,
    natural_key,
)
from stereo_ore.plant.arrivals import Arrival, arrivals
from stereo_ore.plant.clock import SYSTEM, Clock
from stereo_ore.plant.frames import LiveFrame, Position
from stereo_ore.plant.inbox import Inbox, Look, look_at
from stereo_ore.types import StereoPair

_log = logging.getLogger(__name__)

_SETTLED_S = 1.0
"""A file in a format without an end marker is complete when it has not changed for this time."""
SCAN_SHARE = 0.25
"""At most this share of the time is spent listing the folder, however large it grows."""
MOST_SKEW_S = 1.0
"""Clocks of files and of this machine may differ by so much without a word."""
_ALIKE, MOST_OFFSET_S = 3, 15.0
"""So many frames in a row that come alike late, by no more than this, show another clock, not old
files: what they are late by is then taken off their age."""
LEDGER_SLACK_NS = 24 * 3600 * 10**9
"""What was handled is looked up this much farther back than the oldest file: clocks may differ."""


@dataclass
class _Waiting:
    """A frame that is not handed on yet: what its files look like, and since when.

    `seen_s` is None for one that was there at the start.
    """

    arrival: Arrival
    seen_s: float | None
    looks: tuple[Look, ...] = ()
    since_s: float = 0.0
    whole: bool = False
    gone: bool = False

    @property
    def written_ns(self) -> int:
        """When its files were last written; 0 when they are gone."""
        return max((look[0] for look in self.looks), default=0)

    @property
    def order(self) -> tuple[int, list[tuple[int, int, str]]]:
        """By arrival, then by name."""
        return self.written_ns, natural_key(self.arrival.name)


class FolderWatch:
    """Watches `folder`, which may be empty at first, in any layout of image files that `run` knows.

    Parameters
    ----------
    folder : Path
        Where frames appear; nothing is written there.
    poll_s, patience_s : float
        How often it is looked at, and how long an incomplete frame is waited for [s].
    max_pixels : int
        Larger images are refused.
    eye_size : (width, height)
        That of the calibration [px]: an image of that size is no side-by-side one.
    queue : int
        Frames that may wait for their turn; 0: any number, none is skipped.
    trust_times : bool
        Whether names and files tell the age of a frame.
    """

    def __init__(
        self,
        folder: Path,
        *,
        poll_s: float = 0.2,
        patience_s: float = 10.0,
        max_pixels: int = MAX_PIXELS,
        eye_size: tuple[int, int] | None = None,
        queue: int = 0,
        trust_times: bool = True,
        clock: Clock = SYSTEM,
    ) -> None:
        if not folder.is_dir():
            raise SourceError(
                "no such folder",
                file=folder,
                remedy="Make the folder that frames will be copied to",
            )
        self.folder = folder
        self.name = str(folder)
        self.inbox = Inbox(folder, clock)
        self._poll_s, self._patience_s, self._max_pixels = poll_s, patience_s, max_pixels
        self._eye_size, self._queue, self._trust = eye_size, queue, trust_times
        self._clock = clock
        self._waiting: dict[str, _Waiting] = {}
        self._order: deque[_Waiting] = deque()
        self._overtaken: deque[_Waiting] = deque()
        self._pairs = False
        self._skipped = 0
        self._problem = ""
        self._told_skew = False
        self._late: deque[float] = deque(maxlen=_ALIKE)
        self._looked_s = 0.0

    def frames(self, start: Position, stop: threading.Event) -> Iterator[LiveFrame]:
        """Frames that were not handled yet at `start`, as they become complete."""
        index = start.index
        first: Position | None = start
        while not stop.is_set():
            began = self._clock.monotonic()
            if looked := self._look(first):
                first = None
            pause_s = max(self._poll_s, (self._clock.monotonic() - began) / SCAN_SHARE)
            # What arrives while frames are worked on is to be seen soon: its age counts from then.
            while looked and not stop.is_set() and (frame := self._next(index)):
                yield frame
                index += 1
                if self._clock.monotonic() - began > pause_s:
                    break
            self._clock.wait(stop, began + pause_s - self._clock.monotonic())

    def state(self) -> str:
        """What is waited for."""
        waiting = list(self._waiting.values())
        incomplete = [each.arrival.name for each in waiting if not each.whole]
        parts = [f"watching {self.folder}"]
        if len(waiting) > len(incomplete):
            parts.append(f"{len(waiting) - len(incomplete)} waiting")
        if incomplete:
            parts.append(f"{incomplete[0]} is not complete")
        if self._skipped:
            parts.append(f"{self._skipped} were skipped for newer ones")
        if self._problem:
            parts.append(self._problem)
        return "; ".join(parts)

    def _look(self, start: Position | None) -> bool:
        """Take note of what has come since the last look; at the first, of what a run that goes on
        has not done yet. False when the folder can't be read.
        """
        try:
            listing = self.inbox.new_files()
            if start:
                self._leave_out(start, listing)
                listing = self.inbox.new_files()
            found, self._problem = arrivals(self.folder, listing), ""
        except OSError as fault:
            # A network folder comes back; until then targets expire.
            self._problem = f"can't be read: {fault.strerror}"
            return False
        # A picture without a mark beside left and right ones is no side-by-side frame.
        self._pairs |= any(isinstance(arrival.source, ImagePairs) for arrival in found)
        if self._pairs:
            found = [arrival for arrival in found if isinstance(arrival.source, ImagePairs)]
        now_s, earlier = self._clock.monotonic(), self._waiting
        current: dict[str, _Waiting] = {}
        for arrival in found:
            waiting = earlier.get(arrival.key) or _Waiting(arrival, None if start else now_s)
            waiting.arrival = arrival
            looks = tuple(look_at(file) or (0, 0) for file in arrival.files)
            if looks != waiting.looks:
                waiting.looks, waiting.since_s, waiting.whole = looks, now_s, False
            if arrival.key not in earlier and not start:
                self._check_clock(waiting, now_s - self._looked_s)
            current[arrival.key] = waiting
        self._waiting = current
        self._order = deque(sorted(current.values(), key=lambda waiting: waiting.order))
        self._looked_s = now_s
        return True

    def _leave_out(self, start: Position, listing: Listing) -> None:
        """Take for handled what the run that goes on has handled."""
        waiting = {str(file): file for files in listing.values() for file in files}
        changed = [file.stat().st_ctime_ns for file in waiting.values() if file.exists()]
        if not changed:
            return
        for path, written_ns in start.handled(min(changed) - LEDGER_SLACK_NS):
            file = waiting.get(path)
            look = file and look_at(file)
            if file and look and look[0] <= written_ns:
                self.inbox.handle(file, look)

    def _next(self, index: int) -> LiveFrame | None:
        """The frame that is next, where one is ready; what it has overtaken comes when nothing
        else is ready.
        """
        while self._order and self._order[0].gone:
            self._order.popleft()
        order = [waiting for waiting in self._order if not waiting.gone] if self._queue else ()
        behind = 0 < self._queue < sum(waiting.arrival.paired for waiting in order)
        for place, waiting in enumerate(reversed(order) if behind else self._order):
            waited_s = None if waiting.gone else self._ready(waiting)
            if waited_s is not None:
                self._hand_on(waiting)
                if behind:
                    self._overtake(order[: len(order) - place - 1])
                return self._frame(waiting, index, waited_s)
        if self._overtaken:
            return self._frame(self._overtaken.popleft(), index, 0.0, skipped=True)
        return None

    def _overtake(self, older: Sequence[_Waiting]) -> None:
        """Skip those that are complete among the frames older than one that is handed on."""
        for waiting in older:
            if waiting.arrival.paired and (self._settled(waiting) or self._ready(waiting) == 0.0):
                self._hand_on(waiting)
                self._overtaken.append(waiting)
                self._skipped += 1

    def _settled(self, waiting: _Waiting) -> bool:
        """Whether its files have not changed for a while, by either clock."""
        unchanged_s = self._clock.monotonic() - waiting.since_s
        age_s = (self._clock.time_ns() - waiting.written_ns) / 1e9
        return max(unchanged_s, age_s) > _SETTLED_S

    def _hand_on(self, waiting: _Waiting) -> None:
        waiting.gone = True
        self._waiting.pop(waiting.arrival.key, None)
        for file, look in zip(waiting.arrival.files, waiting.looks, strict=True):
            self.inbox.handle(file, look)

    def _check_clock(self, waiting: _Waiting, quiet_s: float) -> None:
        """Say once when the clock of the files is not this machine's, by a frame that has come
        since the last look, `quiet_s` ago.
        """
        late_s = _late_s(waiting, self._clock.time_ns())
        if self._told_skew or late_s is None:
            return
        if abs(late_s) <= MOST_SKEW_S + (quiet_s if late_s > 0 else 0):
            return
        self._told_skew = True
        counted = (
            f"targets hold for less, or not at all, until {_ALIKE} in a row are alike late by at"
            f" most {MOST_OFFSET_S:.0f} s (see --age)"
        )
        _log.warning(
            "the clock of files in %s is %.1f s %s this machine's, or they are old when they come:"
            " %s",
            self.folder,
            abs(late_s),
            "behind" if late_s > 0 else "ahead of",
            counted if self._trust and late_s > 0 else "ages of frames count from when they come",
        )

    def _ready(self, waiting: _Waiting) -> float | None:
        """Time for which a frame that may be handed on was waited for in vain [s]; None for one
        that may not.
        """
        unchanged_s = self._clock.monotonic() - waiting.since_s
        if waiting.arrival.paired:
            files = waiting.arrival.files
            waiting.whole = waiting.whole or all(_is_whole(file, unchanged_s) for file in files)
            if waiting.whole:
                return 0.0
        if unchanged_s < self._patience_s:
            return None
        _log.warning(
            "frame %s was not complete and did not change for %.0f s",
            waiting.arrival.name,
            unchanged_s,
        )
        return unchanged_s

    def _frame(
        self, waiting: _Waiting, index: int, waited_s: float, skipped: bool = False
    ) -> LiveFrame:
        arrival = waiting.arrival
        source = limit_pixels(arrival.source, self._max_pixels)
        source = expect_eyes(source, self._eye_size) if self._eye_size else source
        now_ns, seen_s = self._clock.time_ns(), waiting.seen_s
        arrived_ns = waiting.written_ns or now_ns
        if seen_s is not None:
            arrived_ns = now_ns - round(1e9 * (self._clock.monotonic() - seen_s))

        def read() -> StereoPair:
            try:
                pair = source.read(0)
            except FrameError as fault:
                raise _after_waiting(fault, waited_s) from None
            if pair.stamp_source == "modification time" and seen_s is not None:
                pair = replace(pair, stamp_ns=arrived_ns, stamp_source="arrival")
            return replace(pair, index=index)

        return LiveFrame(
            arrival.name,
            index,
            arrived_ns,
            arrival.files,
            read,
            seen_s,
            self._taken_ns(waiting, arrived_ns),
            waiting.written_ns,
            "a newer frame was there" if skipped else "",
            self._clock,
        )

    def _taken_ns(self, waiting: _Waiting, arrived_ns: int) -> int | None:
        """When a frame was taken at the latest, by this machine's clock; None: not asked, or
        unknown.
        """
        stated_ns, late_s = _stated_ns(waiting), _late_s(waiting, arrived_ns)
        if not self._trust or stated_ns is None or late_s is None:
            return None
        if waiting.seen_s is None:
            return stated_ns
        self._late.append(late_s)
        least, most = min(self._late), max(self._late)
        alike = len(self._late) == _ALIKE and most - least <= MOST_SKEW_S
        return stated_ns + round(1e9 * least) if alike and 0 < least <= MOST_OFFSET_S else stated_ns


def _stated_ns(waiting: _Waiting) -> int | None:
    """When a frame was taken at the latest, by its name and its files."""
    stamp_ns = name_stamp(waiting.arrival.name) or 0
    stamps = [stamp_ns] if STAMPS_FROM_NS <= stamp_ns < STAMPS_TO_NS else []
    return min([*stamps, *filter(None, (waiting.written_ns,))], default=None)


def _late_s(waiting: _Waiting, arrived_ns: int) -> float | None:
    """Time from when a frame was taken to `arrived_ns` [s]; None where the former is unknown."""
    stated_ns = _stated_ns(waiting)
    return None if stated_ns is None else (arrived_ns - stated_ns) / 1e9


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
    return bool(data) and unchanged_s >= _SETTLED_S if complete is None else complete


def first_size(folder: Path) -> tuple[int, int] | None:
    """Width and height [px] of the first frame that lies in a folder already and can be read."""
    listing = list_files(folder, IMAGE_SUFFIXES) if folder.is_dir() else {}
    for arrival in arrivals(folder, listing):
        if arrival.paired and (size := frame_size(arrival.source)):
            return size
    return None
