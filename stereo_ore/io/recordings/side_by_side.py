"""Images that hold both eyes: beside each other, left eye first unless the file says otherwise, or
as two pictures.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from stereo_ore.config.models import MAX_PIXELS
from stereo_ore.errors import SourceError
from stereo_ore.io.recordings.base import make_pair, sampled_depth
from stereo_ore.io.recordings.both_eyes import (
    check_eye_size,
    file_notes,
    is_stereo_file,
    read_side_by_side,
)
from stereo_ore.io.recordings.images import Image, to_8_bit
from stereo_ore.io.recordings.names import frame_names, split_name
from stereo_ore.io.recordings.stamps import Stamp, file_stamp
from stereo_ore.types import StereoCalibration, StereoPair


@dataclass(frozen=True)
class SideBySideImages:
    """Frames of one file each; `eye_size` (width, height) [px] is that of the calibration."""

    path: Path
    names: tuple[str, ...]
    images: tuple[Path, ...]
    calibration: StereoCalibration | None = None
    max_pixels: int = MAX_PIXELS
    eye_size: tuple[int, int] | None = None

    @property
    def description(self) -> Mapping[str, Any]:
        """Kind and number of frames."""
        return {"kind": "side-by-side images", "frames": len(self.names)}

    @cached_property
    def depth(self) -> int:
        """Bits of 16-bit images."""
        return sampled_depth(len(self.names), self.eyes)

    @property
    def notes(self) -> tuple[str, ...]:
        """What the first file says of its eyes and of how it is to be turned."""
        return file_notes(self.images[0])

    def files(self, index: int) -> tuple[Path, ...]:
        """The file of frame `index`."""
        return (self.images[index],)

    def stamp(self, index: int) -> Stamp | None:
        """When the name or the file says that it was taken."""
        return file_stamp(self.names[index], self.files(index))

    def eyes(self, index: int) -> tuple[Image, Image]:
        """Both eyes of frame `index` as stored."""
        left, right = read_side_by_side(self.images[index], self.max_pixels)
        check_eye_size(left, self.eye_size, self.images[index])
        return left, right

    def read(self, index: int) -> StereoPair:
        """Read frame `index` and take its eyes apart."""
        left, right = self.eyes(index)
        depth = self.depth if left.dtype == np.uint16 else None
        return make_pair(self, index, *to_8_bit(left, right, depth))


def open_side_by_side_image(path: Path) -> SideBySideImages:
    """One frame of one file.

    Raises
    ------
    SourceError
        When the file's name says that it is one eye of a pair.
    """
    side, _ = split_name(path.stem)
    if side and not is_stereo_file(path):
        raise SourceError(
            f"is by its name the {side} eye of a pair, not a side-by-side image",
            file=path,
            remedy="Give the folder that holds both, or --left and --right",
        )
    return SideBySideImages(path.parent, frame_names([path.stem]), (path,))
