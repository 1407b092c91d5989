"""What every recording offers."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from stereo_ore.types import StereoCalibration, StereoPair


class Source(Protocol):
    """A recording of known length whose frames can be read in any order, any number of times.

    Sources hold paths, not open files, so that they can be sent to worker processes; a reader of a large file that
    keeps it open between frames opens it anew over there.
    """

    @property
    def path(self) -> Path:
        """Where it was opened."""
        ...

    @property
    def names(self) -> tuple[str, ...]:
        """Unique names of the frames, in order; safe as file names. A name of 19 digits is the frame's stamp [ns]."""
        ...

    @property
    def calibration(self) -> StereoCalibration | None:
        """The calibration that the recording itself carries."""
        ...

    @property
    def description(self) -> Mapping[str, Any]:
        """What the record of a run says about the recording; can be written as JSON."""
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
