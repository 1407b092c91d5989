"""Frames that appear in a folder: complete ones only, each once, in the natural order of their names.

A frame is complete when both eyes are there and their files are: PNG and JPEG by their end marker, other formats when
they have stopped growing. A frame that stays incomplete holds up those behind it for `patience_s` and is then handed
on as it is, so that it is recorded as failed. A frame that sorts before one already handed on comes too late: it is
counted, and never processed. So the name of the last frame done is all that a restart needs to know.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from stereo_ore.config.models import MAX_PIXELS
from stereo_ore.errors import SourceError
from stereo_ore.io.recordings import limit_pixels
from stereo_ore.io.recordings.folder import ImagePairs
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
TAIL_BYTES = 64
END_MARKS = {b"\x89PNG": b"IEND\xaeB`\x82", b"\xff\xd8": b"\xff\xd9"}


@dataclass(frozen=True)
class _Pending:
    """The next frame while it is not complete: what its files look like, and since when."""

    name: str
    looks: tuple[tuple[int, int], ...]
    since: float


class FolderWatch:
    """Watches `folder`, which may be empty at first, in any layout of image files that `run` knows."""

    def __init__(
        self, folder: Path, *, poll_s: float = 0.2, patience_s: float = 10.0, max_pixels: int = MAX_PIXELS
    ) -> None:
        if not folder.is_dir():
            raise SourceError("no such folder", file=folder, remedy="Make the folder that frames will be copied to")
        self.folder = folder
        self.name = str(folder)
        self._poll_s, self._patience_s, self._max_pixels = poll_s, patience_s, max_pixels
        self._pending: _Pending | None = None
        self._done: set[str] = set()
        self._prune_at = PRUNE_AT
        self._pairs = False
        self._late = 0
        self._waiting = 0
        self._problem = ""

    def frames(self, start: Position, stop: threading.Event) -> Iterator[LiveFrame]:
        """Frames that sort after `start.after`, as they become complete."""
        after, index, watching = start.after, start.index, False
        while not stop.is_set():
            began = time.monotonic()
            waiting = self._new_frames(after, late=watching)
            watching, scan_s = True, time.monotonic() - began
            for place, arrival in enumerate(waiting):
                if stop.is_set() or not self._ready(arrival):
                    break
                after, self._waiting = arrival.name, len(waiting) - place - 1
                self._done.update(map(str, arrival.files))
                yield _frame(replace(arrival, source=limit_pixels(arrival.source, self._max_pixels)), index)
                index += 1
            stop.wait(max(self._poll_s, scan_s / SCAN_SHARE))

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
        """Frames that sort after `after`; the others are done or, once the folder is being watched, too late."""
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
            log.warning("%d frames in %s sort before %s, which is done: left out", len(past), self.folder, after)
        return found[len(past) :]

    def _leave_out(self, past: list[Arrival]) -> None:
        self._done.update(str(file) for arrival in past for file in arrival.files)
        if len(self._done) > self._prune_at:
            self._done = {file for file in self._done if os.path.exists(file)}
            self._prune_at = max(PRUNE_AT, 2 * len(self._done))

    def _ready(self, arrival: Arrival) -> bool:
        """Whether the frame may be handed on: complete, or waited for long enough."""
        try:
            looks = tuple((stat.st_size, stat.st_mtime_ns) for stat in (file.stat() for file in arrival.files))
        except OSError:
            looks = ()
        pending = self._pending
        if pending is None or (pending.name, pending.looks) != (arrival.name, looks):
            pending = self._pending = _Pending(arrival.name, looks, time.monotonic())
        unchanged_s = time.monotonic() - pending.since
        whole = arrival.paired and all(_is_whole(file, unchanged_s) for file in arrival.files)
        if whole or unchanged_s >= self._patience_s:
            self._pending = None
            return True
        return False


def _is_whole(file: Path, unchanged_s: float) -> bool:
    """Whether a file ends as its format says or, for formats that say nothing, has not changed for a while."""
    try:
        with file.open("rb") as data:
            head = data.read(8)
            data.seek(max(0, file.stat().st_size - TAIL_BYTES))
            tail = data.read()
    except OSError:
        return False
    for magic, mark in END_MARKS.items():
        if head.startswith(magic):
            return mark in tail
    return bool(head) and unchanged_s >= SETTLED_S


def _frame(arrival: Arrival, index: int) -> LiveFrame:
    files = arrival.files

    def read() -> StereoPair:
        return replace(arrival.source.read(0), index=index)

    # The change time is when the file got its content here; copying tools carry the modification time over.
    arrived_ns = max((file.stat().st_ctime_ns for file in files if file.exists()), default=time.time_ns())
    return LiveFrame(arrival.name, index, arrived_ns, files, read)
