"""Frames as they arrive, and a recording that is served as if it were live."""

from __future__ import annotations

import functools
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from stereo_ore.io.recordings import Source
from stereo_ore.io.recordings.stamps import Stamp
from stereo_ore.plant.clock import SYSTEM, Clock
from stereo_ore.types import StereoPair


@dataclass(frozen=True)
class LiveFrame:
    """One frame that has arrived; `read` raises `FrameError` when it is not usable.

    Parameters
    ----------
    arrived_ns : int
        Time of day at which it arrived.
    seen_s : float
        The same moment on the clock that nobody sets (`Clock.monotonic`), where this program saw
        the frame arrive.
    taken_ns : int
        Time of day at which it was taken at the latest, where its name or files say so.
    written_ns : int
        When its files were last written, by their own clock: tells a file whose name is used again.
    skipped : str
        Why it is recorded without being processed; empty for a frame that is to be processed.
    stamp : Stamp
        When it was taken, for the record of one that can't be read; its clock may be any.
    superseded : bool
        A newer frame is at hand: this one is recorded, and consumers hear nothing of it.
    """

    name: str
    index: int
    arrived_ns: int
    files: tuple[Path, ...]
    read: Callable[[], StereoPair]
    seen_s: float | None = None
    taken_ns: int | None = None
    written_ns: int | None = None
    skipped: str = ""
    clock: Clock = SYSTEM
    stamp: Stamp | None = None
    superseded: bool = False

    @property
    def told(self) -> bool:
        """Whether consumers are to hear of it."""
        return not (self.skipped or self.superseded)

    @property
    def age_s(self) -> float:
        """Time since it was taken, or at least since it arrived [s]; of a frame that was not seen
        to arrive negative when the clock was set back.
        """
        now_ns = self.clock.time_ns()
        if self.seen_s is None:
            return (now_ns - min(self.arrived_ns, self.taken_ns or self.arrived_ns)) / 1e9
        seen_s = self.clock.monotonic() - self.seen_s
        return seen_s if self.taken_ns is None else max(seen_s, (now_ns - self.taken_ns) / 1e9)


Handled = Callable[[int], Iterable[tuple[str, float]]]
"""Paths of files handled since a time [ns since 1970], and when each had been written [ns]."""


@dataclass(frozen=True)
class Position:
    """Where a run stands: the index of the next frame, and what tells files that are done
    already.
    """

    index: int = 0
    handled: Handled = lambda since_ns: ()


class LiveSource(Protocol):
    """Something that frames come from for as long as the program runs."""

    @property
    def name(self) -> str:
        """What it is; the same after a restart."""
        ...

    def frames(self, start: Position, stop: threading.Event) -> Iterator[LiveFrame]:
        """Frames that follow `start`, in order, each once, until `stop` is set."""
        ...

    def state(self) -> str:
        """One line for the operator."""
        ...


class ReplayedRecording:
    """A recording served as if its frames arrived when they are asked for; it ends after its last
    frame.
    """

    def __init__(self, source: Source) -> None:
        self._source = source
        self.name = str(source.path)
        self._next = 0

    def frames(self, start: Position, stop: threading.Event) -> Iterator[LiveFrame]:
        """The recording from index `start.index` on."""
        for index in range(start.index, len(self._source.names)):
            if stop.is_set():
                return
            self._next = index + 1
            name, files = self._source.names[index], self._source.files(index)
            read = functools.partial(self._source.read, index)
            yield LiveFrame(name, index, time.time_ns(), files, read)

    def state(self) -> str:
        """How much of it is done."""
        return f"recording {self._source.path}: frame {self._next} of {len(self._source.names)}"
