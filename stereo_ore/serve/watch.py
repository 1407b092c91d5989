"""Frames that appear in a folder: complete ones only, each once, in the natural order of their names.

A frame is complete when both eyes are there and their files are: PNG and JPEG by their end marker, other formats when
they have stopped growing. A frame that stays incomplete holds up those behind it for `patience_s` and is then handed
on as it is, so that it is recorded as failed. A frame that sorts before one already handed on comes too late: it is
counted, and never processed. So the name of the last frame done is all that a restart needs to know.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from stereo_ore.errors import SourceError
from stereo_ore.serve.frames import LiveFrame, Position
from stereo_ore.sources import Source
from stereo_ore.sources.folder import open_folder
from stereo_ore.sources.names import natural_key
from stereo_ore.types import StereoPair

log = logging.getLogger(__name__)

SETTLED_S = 1.0
"""A file in a format without an end marker is complete when it has not changed for this time."""
SCAN_SHARE = 0.1
"""At most this share of the time is spent listing the folder, however large it grows."""
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

    def __init__(self, folder: Path, *, poll_s: float = 0.2, patience_s: float = 10.0) -> None:
        if not folder.is_dir():
            raise SourceError("no such folder", file=folder, remedy="Make the folder that frames will be copied to")
        self.folder = folder
        self.name = str(folder)
        self._poll_s, self._patience_s = poll_s, patience_s
        self._pending: _Pending | None = None
        self._seen = 0
        self._late = 0
        self._waiting = 0
        self._problem = ""

    def frames(self, start: Position, stop: threading.Event) -> Iterator[LiveFrame]:
        """Frames that sort after `start.after`, as they become complete."""
        after, index = start.after, start.index
        self._seen = -1
        while not stop.is_set():
            began = time.monotonic()
            source = self._scan()
            first = self._first_new(source, after)
            scan_s = time.monotonic() - began
            for place in range(first, len(source.names) if source else 0):
                if stop.is_set() or source is None or not self._ready(source, place):
                    break
                after, self._seen, self._waiting = source.names[place], place + 1, len(source.names) - place - 1
                yield _frame(source, place, index)
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

    def _scan(self) -> Source | None:
        try:
            source = open_folder(self.folder)
        except (SourceError, OSError) as fault:
            # An empty folder, or one eye of the first frame: what is to come will tell.
            self._problem = str(fault)
            return None
        self._problem = ""
        return source

    def _first_new(self, source: Source | None, after: str | None) -> int:
        """Place of the first frame that sorts after `after`; frames that slipped in before it are late."""
        names = source.names if source else ()
        limit = None if after is None else natural_key(after)
        first = 0 if limit is None else sum(natural_key(name) <= limit for name in names)
        if 0 <= self._seen < first:
            late = first - self._seen
            self._late += late
            log.warning("%d frames in %s sort before %s, which is done: left out", late, self.folder, after)
        self._seen = first
        return first

    def _ready(self, source: Source, place: int) -> bool:
        """Whether the frame may be handed on: complete, or waited for long enough."""
        name, files = source.names[place], source.files(place)
        try:
            looks = tuple((stat.st_size, stat.st_mtime_ns) for stat in (file.stat() for file in files))
        except OSError:
            looks = ()
        pending = self._pending
        if pending is None or (pending.name, pending.looks) != (name, looks):
            pending = self._pending = _Pending(name, looks, time.monotonic())
        unchanged_s = time.monotonic() - pending.since
        whole = _has_both_eyes(source, place) and all(_is_whole(file, unchanged_s) for file in files)
        if whole or unchanged_s >= self._patience_s:
            self._pending = None
            return True
        return False


def _has_both_eyes(source: Source, place: int) -> bool:
    pairs = getattr(source, "pairs", None)
    return pairs is None or None not in pairs[place]


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


def _frame(source: Source, place: int, index: int) -> LiveFrame:
    files = source.files(place)

    def read() -> StereoPair:
        return replace(source.read(place), index=index)

    # The change time is when the file got its content here; copying tools carry the modification time over.
    arrived_ns = max((file.stat().st_ctime_ns for file in files if file.exists()), default=time.time_ns())
    return LiveFrame(source.names[place], index, arrived_ns, files, read)
