"""Images that hold both eyes beside each other, left eye first."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stereo_ore.config.models import MAX_PIXELS
from stereo_ore.errors import SourceError
from stereo_ore.io.recordings.images import read_image, split_in_two, to_8_bit
from stereo_ore.io.recordings.names import frame_names, name_stamp, split_name
from stereo_ore.types import StereoCalibration, StereoPair


@dataclass(frozen=True)
class SideBySideImages:
    """Frames of one file each."""

    path: Path
    names: tuple[str, ...]
    images: tuple[Path, ...]
    calibration: StereoCalibration | None = None
    max_pixels: int = MAX_PIXELS

    @property
    def description(self) -> Mapping[str, Any]:
        """Kind and number of frames."""
        return {"kind": "side-by-side images", "frames": len(self.names)}

    def files(self, index: int) -> tuple[Path, ...]:
        """The file of frame `index`."""
        return (self.images[index],)

    def read(self, index: int) -> StereoPair:
        """Read frame `index` and split it in the middle."""
        halves = split_in_two(read_image(self.images[index], self.max_pixels), self.images[index])
        return StereoPair(
            *to_8_bit(*halves), name=self.names[index], index=index, stamp_ns=name_stamp(self.names[index])
        )


def open_side_by_side_image(path: Path) -> SideBySideImages:
    """One frame of one file.

    Raises
    ------
    SourceError
        When the file's name says that it is one eye of a pair.
    """
    side, _ = split_name(path.stem)
    if side:
        raise SourceError(
            f"is by its name the {side} eye of a pair, not a side-by-side image",
            file=path,
            remedy="Give the folder that holds both, or --left and --right",
        )
    return SideBySideImages(path.parent, frame_names([path.stem]), (path,))
