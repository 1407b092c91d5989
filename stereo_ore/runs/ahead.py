"""A recording whose next frames are read while others are worked on."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from stereo_ore.io.recordings.base import Source
from stereo_ore.io.recordings.stamps import Stamp
from stereo_ore.types import StereoCalibration, StereoPair

FRAMES_AHEAD = 2
"""Frames read before they are asked for: a bound on memory, enough to hide a disk that is slow at
times."""


class ReadAhead:
    """Another `Source`, read by one thread in the `order` announced; a context manager.

    A frame that is asked for out of that order is read when its turn comes. An error is raised
    where the frame is asked for, as without it.
    """

    def __init__(self, source: Source, order: Iterable[int]) -> None:
        self._source = source
        self._order: Iterator[int] = iter(order)
        self._ahead: deque[tuple[int, Future[StereoPair]]] = deque()
        self._thread = ThreadPoolExecutor(1, "read ahead")

    def __enter__(self) -> Self:
        self._fill()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._thread.shutdown(cancel_futures=True)

    @property
    def path(self) -> Path:
        """Where it was opened."""
        return self._source.path

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the frames."""
        return self._source.names

    @property
    def calibration(self) -> StereoCalibration | None:
        """The calibration that the recording carries."""
        return self._source.calibration

    @property
    def description(self) -> Mapping[str, Any]:
        """What the record of a run says about it."""
        return self._source.description

    def files(self, index: int) -> tuple[Path, ...]:
        """The files that frame `index` is read from."""
        return self._source.files(index)

    def stamp(self, index: int) -> Stamp | None:
        """When frame `index` was taken."""
        return self._source.stamp(index)

    def read(self, index: int) -> StereoPair:
        """Frame `index`, at once if it was announced."""
        if self._ahead and self._ahead[0][0] == index:
            future = self._ahead.popleft()[1]
            self._fill()
        else:
            future = self._thread.submit(self._source.read, index)
        return future.result()

    def _fill(self) -> None:
        while len(self._ahead) < FRAMES_AHEAD and (index := next(self._order, None)) is not None:
            self._ahead.append((index, self._thread.submit(self._source.read, index)))
