"""What the readers of calibration files share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration.geometry import Images
from stereo_ore.types import F64, StereoCalibration


@dataclass(frozen=True)
class Hints:
    """What a file may not say of itself.

    Attributes
    ----------
    images
        What the recorded images are; None: what the file says or implies.
    image_size
        Width and height [px] of one eye, for formats that hold several or none.
    unit_m
        Length of one unit of the translation, for formats that do not fix it.
    eyes
        Which two cameras of a chain are left and right; None: the chain has just two.
    """

    images: Images | None = None
    image_size: tuple[int, int] | None = None
    unit_m: float = 1.0
    eyes: tuple[int, int] | None = None


class Format(Protocol):
    """What a module of a calibration format offers."""

    def recognises(self, text: str) -> bool:
        """Whether the text of a file is in this format."""

    def read(self, path: Path, text: str, hints: Hints) -> StereoCalibration:
        """The calibration in it."""


def size_of(path: Path, in_file: Sequence[Any] | None, hints: Hints) -> tuple[int, int]:
    """The image size that the file gives or, when it gives none, that the user gave."""
    size = in_file or hints.image_size
    if size is None:
        raise CalibrationError("does not say the image size", file=path, remedy="Give it with --size WxH")
    values = numbers(path, "image size", size, 2)
    if not all(value > 0 and value == int(value) for value in values):
        raise CalibrationError(f"the image size must be two positive whole numbers, not {list(size)}", file=path)
    return int(values[0]), int(values[1])


def numbers(path: Path, key: str, values: Any, count: int | None = None) -> F64:
    """A flat list of finite numbers, of a certain length if one is given."""
    try:
        array = np.array(values, dtype=np.float64).ravel()
    except (TypeError, ValueError, OverflowError):
        raise CalibrationError(f"must be numbers, not {values!r:.80}", file=path, key=key) from None
    if not np.isfinite(array).all():
        raise CalibrationError(f"must be finite numbers, not {array.tolist()!r:.80}", file=path, key=key)
    if count is not None and len(array) != count:
        raise CalibrationError(f"must have {count} numbers, not {len(array)}", file=path, key=key)
    return array


def other_eye(path: Path, pairs: Sequence[tuple[str, str]]) -> tuple[Path, Path]:
    """The two files of a format that keeps one an eye (or a half), from the name of either.

    Parameters
    ----------
    pairs
        Words of which one stands in the name of the first file and the other in that of the second.
    """
    for first, second in pairs:
        if first in path.name:
            return path, path.with_name(path.name.replace(first, second))
        if second in path.name:
            return path.with_name(path.name.replace(second, first)), path
    words = " or ".join(word for pair in pairs for word in pair)
    raise CalibrationError(f"is one file of two, and its name has no {words} to find the other by", file=path)
