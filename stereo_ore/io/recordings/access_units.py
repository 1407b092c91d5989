"""Pictures of a video that is stored a message a picture: access units of H.264 or H.265 in Annex B
form.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from stereo_ore.errors import FrameError, MissingExtraError
from stereo_ore.io.recordings.images import Image, check_pixels

if TYPE_CHECKING:
    import av

LONGEST_DELAY = 16
"""A decoder gives a picture at most so many units after its own (the standards' largest reorder
buffer)."""
_START_CODE = b"\x00\x00\x01"
H264_KEY, H264_PARAMETERS = 5, 7
H265_KEY, H265_PARAMETERS = range(16, 22), 32


def codec_of(unit: bytes) -> str | None:
    """The name of the codec of an access unit with parameter sets; None where it has none."""
    for part in _parts(unit):
        if part & 0x9F == H264_PARAMETERS:
            return "h264"
        if part >> 1 == H265_PARAMETERS:
            return "hevc"
    return None


def is_key(unit: bytes) -> bool:
    """Whether decoding can begin at an access unit."""
    codec = codec_of(unit)
    parts = _parts(unit)
    if codec == "hevc":
        return any(part >> 1 & 0x3F in H265_KEY for part in parts)
    return codec == "h264"


def _parts(unit: bytes) -> list[int]:
    """First byte of each part (NAL unit) of an access unit; only the first parts tell what it
    is.
    """
    found: list[int] = []
    place = unit.find(_START_CODE)
    while 0 <= place < len(unit) - 3 and len(found) < LONGEST_DELAY:
        found.append(unit[place + 3])
        place = unit.find(_START_CODE, place + 3, place + 4096)
    return found


class UnitDecoder:
    """Decodes units by number; from the last key unit before, where it does not go on from the one
    before.
    """

    def __init__(self, path: Path, keys: Sequence[bool], unit: Callable[[int], bytes]) -> None:
        self._path, self._keys, self._unit = path, keys, unit
        self._context: av.VideoCodecContext | None = None
        self._next = 0
        self._ready: dict[int, Image] = {}

    def picture(self, index: int, max_pixels: int) -> Image:
        """Picture of unit `index`: (H, W, 3) BGR, uint8.

        Raises
        ------
        FrameError
            When it can't be decoded.
        MissingExtraError
            Without PyAV.
        """
        if index in self._ready:
            return self._ready.pop(index)
        key = next((i for i in range(index, -1, -1) if self._keys[i]), None)
        if key is None:
            raise self._fault(index, "no key frame comes before it")
        if self._context is None or not key <= self._next <= index:
            self._restart(key)
        try:
            self._feed(index, max_pixels)
        except StopIteration:
            raise self._fault(index, "the decoder gives no picture") from None
        except _av().error.FFmpegError as fault:
            self._context = None
            raise self._fault(index, str(fault)) from None
        return self._ready.pop(index)

    def _restart(self, key: int) -> None:
        av, codec = _av(), codec_of(self._unit(key))
        self._context = av.CodecContext.create(codec or "h264", "r")
        self._next, self._ready = key, {}

    def _feed(self, index: int, max_pixels: int) -> None:
        """Decode until picture `index` is there; StopIteration when it does not come."""
        assert self._context is not None, "just begun"
        while index not in self._ready:
            if self._next >= len(self._keys) or self._next > index + LONGEST_DELAY:
                self._take(self._context.decode(None), index, max_pixels)
                self._context = None
                if index not in self._ready:
                    raise StopIteration
                return
            packet = _av().Packet(self._unit(self._next))
            packet.pts = packet.dts = self._next
            self._next += 1
            self._take(self._context.decode(packet), index, max_pixels)

    def _take(self, frames: Sequence[Any], index: int, max_pixels: int) -> None:
        for frame in frames:
            if frame.pts is not None and frame.pts >= index:
                check_pixels(frame.width, frame.height, self._path, max_pixels)
                self._ready[frame.pts] = np.ascontiguousarray(frame.to_ndarray(format="bgr24"))
        self._ready = {
            number: picture for number, picture in self._ready.items() if number >= index
        }

    def _fault(self, index: int, why: str) -> FrameError:
        return FrameError(
            f"picture {index} of {len(self._keys)} can't be decoded: {why}",
            code="UNREADABLE_IMAGE",
            file=self._path,
            remedy="A video must begin with a key frame; record or copy it again",
        )


def _av() -> Any:
    try:
        import av
    except ImportError:
        raise MissingExtraError("av", "svo") from None
    return av
