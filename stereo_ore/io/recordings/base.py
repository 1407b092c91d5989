"""What every recording offers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar, Protocol

from stereo_ore.errors import FrameError
from stereo_ore.io.recordings.images import Image, depth_of
from stereo_ore.io.recordings.stamps import Stamp
from stereo_ore.types import StereoCalibration, StereoPair


class Source(Protocol):
    """A recording of known length whose frames can be read in any order, any number of times.

    Sources hold paths, not open files, so that they can be sent to worker processes; a reader of a
    large file that keeps it open between frames opens it anew over there.
    """

    @property
    def path(self) -> Path:
        """Where it was opened."""
        ...

    @property
    def names(self) -> tuple[str, ...]:
        """Unique names of the frames, in order; safe as file names. A name of 19 digits is the
        frame's stamp [ns].
        """
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

    def stamp(self, index: int) -> Stamp | None:
        """When frame `index` was taken, whether or not it can be read."""
        ...

    def read(self, index: int) -> StereoPair:
        """Read one frame.

        Raises
        ------
        FrameError
            When the frame is incomplete or unreadable; the frames around it are not touched by
            that.
        """
        ...


class OpenedSource(Source, Protocol):
    """What an opener returns: a dataclass, copies of which with another limit read the same.

    It may have a field `eye_size` (width, height) [px], which refuses pictures of one eye where two
    are to be side by side, and `notes`, texts that are said at the start.
    """

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def max_pixels(self) -> int:
        """Pictures of more pixels are refused before they are decoded."""
        ...


def make_pair(source: Source, index: int, left: Any, right: Any) -> StereoPair:
    """Frame `index` of a recording, from its (H, W, 3) uint8 images."""
    stamp = source.stamp(index)
    ns, origin = (stamp.ns, stamp.source) if stamp else (None, None)
    return StereoPair(left, right, source.names[index], index, ns, origin)


def sampled_depth(count: int, read: Callable[[int], tuple[Image, Image]]) -> int:
    """Bits of the pixels of a recording of 16-bit images: the most that any of five frames spread
    over it uses.

    One depth for the whole recording keeps brightnesses of its frames comparable, whatever order
    they are read in.
    """
    depths = [8]
    for index in sorted({(count - 1) * part // 4 for part in range(5)}):
        try:
            depths.append(depth_of(read(index)))
        except FrameError:
            continue
    return max(depths)
