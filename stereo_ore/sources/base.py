"""What every recording offers."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from stereo_ore.types import StereoPair


class Source(Protocol):
    """A recording of known length whose frames can be read in any order, any number of times.

    Sources hold paths, not open files, so that they can be sent to worker processes.
    """

    @property
    def path(self) -> Path:
        """Where it was opened."""
        ...

    @property
    def names(self) -> tuple[str, ...]:
        """Unique names of the frames, in order; safe as file names."""
        ...

    def files(self, index: int) -> tuple[Path, ...]:
        """The files that frame `index` is read from."""
        ...

    def read(self, index: int) -> StereoPair:
        """Read one frame.

        Raises
        ------
        FrameError
            When the frame is incomplete or unreadable; the frames around it are not touched by that.
        """
        ...
