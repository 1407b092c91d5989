"""Frames as they arrive, and a recording that is served as if it were live."""

from __future__ import annotations

import functools
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from stereo_ore.io.recordings import Source
from stereo_ore.io.recordings.stamps import Stamp
from stereo_ore.types import StereoPair


@dataclass(frozen=True)
class LiveFrame:
    """One frame that has arrived; `read` raises `FrameError` when it is not usable.

    `arrived_ns` is the time of day; `seen_s` the same moment on the clock that nobody sets
    (`time.monotonic`), where this program saw the frame arrive. `stamp` is when it was taken, for
    the record of one that can't be read. `superseded`: a newer frame is at hand, so that this one
    is recorded and not told.
    """

    name: str
    index: int
    arrived_ns: int
    files: tuple[Path, ...]
    read: Callable[[], StereoPair]
    seen_s: float | None = None
    stamp: Stamp | None = None
    superseded: bool = False

    @property
    def age_s(self) -> float:
        """Time since it arrived [s]; of a frame that was not seen to arrive negative when the clock
        was set back.
        """
        if self.seen_s is not None:
            return time.monotonic() - self.seen_s
        return (time.time_ns() - self.arrived_ns) / 1e9


@dataclass(frozen=True)
class Position:
    """Where a run stands: the name of the last frame done (None: nothing yet) and the index of the
    next.
    """

    after: str | None = None
    index: int = 0


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


class Recording:
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
