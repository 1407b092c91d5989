"""Images that hold both eyes beside each other, left eye first."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from stereo_ore.errors import FrameError
from stereo_ore.sources.images import read_image, to_8_bit
from stereo_ore.types import StereoPair


@dataclass(frozen=True)
class SideBySideImages:
    """Frames of one file each."""

    path: Path
    names: tuple[str, ...]
    images: tuple[Path, ...]

    def files(self, index: int) -> tuple[Path, ...]:
        """The file of frame `index`."""
        return (self.images[index],)

    def read(self, index: int) -> StereoPair:
        """Read frame `index` and split it in the middle."""
        image = read_image(self.images[index])
        if image.shape[1] % 2:
            raise FrameError(
                f"is {image.shape[1]} px wide: two eyes need an even width",
                code="SIZE_MISMATCH",
                file=self.images[index],
                remedy="Is this a side-by-side image? Use --left and --right for two files",
            )
        half = image.shape[1] // 2
        left, right = to_8_bit(image[:, :half].copy(), image[:, half:].copy())
        return StereoPair(self.names[index], index, left, right)


def open_side_by_side_image(path: Path) -> SideBySideImages:
    """One frame of one file."""
    return SideBySideImages(path.parent, (path.stem,), (path,))
