"""Videos whose pictures hold both eyes beside each other, in any container that OpenCV opens."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from stereo_ore.config.models import MAX_PIXELS
from stereo_ore.errors import FrameError, SourceError
from stereo_ore.io.recordings.images import Image, as_bgr, check_pixels, split_in_two, to_8_bit
from stereo_ore.io.recordings.quiet import overheard
from stereo_ore.types import StereoCalibration, StereoPair

VIDEO_SUFFIXES = (".avi", ".mkv", ".mov", ".mp4", ".m4v", ".mjpg", ".mjpeg", ".webm")


LEAST_PICTURE_BYTES = 8
"""A container that claims more pictures than its bytes can be is not believed."""


class Decoder:
    """Pictures of a video by number; opened when first used, and anew after it was sent to another process.

    Pictures are counted by decoding: containers seek by time, which finds another picture when the rate varies.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._capture: cv2.VideoCapture | None = None
        self._next = 0

    def __reduce__(self) -> tuple[type[Decoder], tuple[Path]]:
        return Decoder, (self.path,)

    def picture(self, index: int) -> Image | None:
        """Picture `index` as stored; None when the video ends before it or is damaged there."""
        return overheard(lambda: self._picture(index))[0]

    def count(self) -> int:
        """Number of pictures: what the container says or, when that can't be, what can be decoded."""
        return overheard(self._count)[0]

    def size(self) -> tuple[int, int]:
        """Width and height that the container claims."""
        capture = self._capture or cv2.VideoCapture(str(self.path))
        return int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))

    def _picture(self, index: int) -> Image | None:
        if self._capture is None or index < self._next:
            self._reopen()
        assert self._capture is not None, "just opened"
        while self._next < index:
            if not self._capture.grab():
                return None
            self._next += 1
        found, image = self._capture.read()
        self._next += 1
        return image if found else None

    def _count(self) -> int:
        self._reopen()
        assert self._capture is not None, "just opened"
        promised = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        if 0 < promised <= self.path.stat().st_size // LEAST_PICTURE_BYTES:
            return promised
        count = 0
        while self._capture.grab():
            count += 1
        self._capture = None
        return count

    def _reopen(self) -> None:
        self._capture, self._next = cv2.VideoCapture(str(self.path)), 0


@dataclass(frozen=True)
class SideBySideVideo:
    """Frames of one picture each, named by their number."""

    path: Path
    names: tuple[str, ...]
    decoder: Decoder
    calibration: StereoCalibration | None = None
    max_pixels: int = MAX_PIXELS

    @property
    def description(self) -> Mapping[str, Any]:
        """Kind and number of frames."""
        return {"kind": "side-by-side video", "frames": len(self.names)}

    def files(self, index: int) -> tuple[Path, ...]:
        """The video."""
        return (self.path,)

    def read(self, index: int) -> StereoPair:
        """Decode frame `index` and split it in the middle."""
        check_pixels(*overheard(self.decoder.size)[0], self.path, self.max_pixels)
        image = self.decoder.picture(index)
        if image is None:
            raise FrameError(
                f"picture {index} of {len(self.names)} can't be decoded",
                code="UNREADABLE_IMAGE",
                file=self.path,
                remedy="Is the video cut off? Copy or export it again",
            )
        halves = split_in_two(as_bgr(np.asarray(image), self.path), self.path)
        return StereoPair(*to_8_bit(*halves), name=self.names[index], index=index)


def open_video(path: Path) -> SideBySideVideo:
    """Open a video.

    Raises
    ------
    SourceError
        When nothing in it can be decoded.
    """
    decoder = Decoder(path)
    check_pixels(*overheard(decoder.size)[0], path, MAX_PIXELS)
    count = decoder.count()
    if count < 1 or decoder.picture(0) is None:
        raise SourceError(
            "can't be decoded as a video", file=path, remedy="Export it as side-by-side AVI, or as a folder of images"
        )
    return SideBySideVideo(path, tuple(f"{index:06d}" for index in range(count)), decoder)
