"""Videos, in any container that OpenCV opens: both eyes beside each other in each picture, or a
video an eye.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from stereo_ore.config.models import MAX_PIXELS
from stereo_ore.errors import FrameError, SourceError
from stereo_ore.io.recordings.base import make_pair
from stereo_ore.io.recordings.both_eyes import check_eye_size
from stereo_ore.io.recordings.container import Container, read_container
from stereo_ore.io.recordings.frame_packing import packing_of
from stereo_ore.io.recordings.images import (
    Image,
    as_bgr,
    check_alike,
    check_packing,
    check_pixels,
    split_in_two,
    to_8_bit,
)
from stereo_ore.io.recordings.names import frame_names
from stereo_ore.io.recordings.pairing import pair_by_stamp
from stereo_ore.io.recordings.quiet import overheard
from stereo_ore.io.recordings.stamps import Stamp
from stereo_ore.types import StampSource, StereoCalibration, StereoPair

_log = logging.getLogger(__name__)

VIDEO_SUFFIXES = (".avi", ".mkv", ".mov", ".mp4", ".m4v", ".mjpg", ".mjpeg", ".webm")


class Decoder:
    """Pictures of a video by number, as stored; opened when first used, and anew after it was sent
    elsewhere.

    Pictures are counted by decoding: containers seek by time, which finds another picture when the
    rate varies.
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

    def times_ms(self) -> tuple[float, ...]:
        """Times of all pictures that can be decoded [ms from the first].

        What containers say of their number is not believed: some count by a rate, or what their
        edit list cuts off.
        """
        return overheard(self._times_ms)[0]

    def claim(self) -> int:
        """Number of pictures that the container claims; not positive where it claims none."""
        return overheard(lambda: int(self._open().get(cv2.CAP_PROP_FRAME_COUNT)))[0]

    def size(self) -> tuple[int, int]:
        """Width and height that the container claims."""
        capture = overheard(self._open)[0]
        return int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(
            capture.get(cv2.CAP_PROP_FRAME_HEIGHT)
        )

    def turn(self) -> int:
        """By how many degrees players are asked to turn the picture; it is not turned here."""
        return int(overheard(self._open)[0].get(cv2.CAP_PROP_ORIENTATION_META))

    def first_packet(self) -> bytes:
        """The first picture as it was compressed, for H.264 and H.265 in Annex B form; empty where
        it can't be had.
        """

        def read() -> bytes:
            capture = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG, [cv2.CAP_PROP_FORMAT, -1])
            found, packet = capture.read()
            return packet.tobytes() if found else b""

        return overheard(read)[0]

    def _picture(self, index: int) -> Image | None:
        if self._capture is None or index < self._next:
            self._reopen()
        capture = self._open()
        while self._next < index:
            if not capture.grab():
                return None
            self._next += 1
        found, image = capture.read()
        self._next += 1
        return image if found else None

    def _times_ms(self) -> tuple[float, ...]:
        self._reopen()
        capture, times = self._open(), []
        while capture.grab():
            times.append(float(capture.get(cv2.CAP_PROP_POS_MSEC)))
        self._capture = None
        return tuple(time - times[0] for time in times)

    def _open(self) -> cv2.VideoCapture:
        if self._capture is None:
            self._reopen()
        assert self._capture is not None, "just opened"
        return self._capture

    def _reopen(self) -> None:
        self._capture, self._next = cv2.VideoCapture(str(self.path)), 0
        self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)


@dataclass(frozen=True)
class Track:
    """The pictures of one video: how many there are, and when each was taken."""

    decoder: Decoder
    times_ms: tuple[float, ...]
    began_ns: int
    began_source: StampSource

    def stamp(self, index: int) -> Stamp:
        """When picture `index` was taken: the beginning of the video and its own time."""
        return Stamp(self.began_ns + round(1e6 * self.times_ms[index]), self.began_source)

    def picture(self, index: int, max_pixels: int) -> Image:
        """Picture `index`: (H, W, 3) BGR, uint8.

        Raises
        ------
        FrameError
            When it is too large or can't be decoded (any more).
        """
        path = self.decoder.path
        check_pixels(*self.decoder.size(), path, max_pixels)
        image = self.decoder.picture(index)
        if image is None:
            raise FrameError(
                f"picture {index} of {len(self.times_ms)} can't be decoded",
                code="UNREADABLE_IMAGE",
                file=path,
                remedy="Is the video cut off? Copy or export it again",
            )
        return as_bgr(np.asarray(image), path)


@dataclass(frozen=True)
class SideBySideVideo:
    """Frames of one picture each, named by their number; `eye_size` (width, height) [px] is the
    calibration's.
    """

    path: Path
    names: tuple[str, ...]
    track: Track
    packing: str = "left-right"
    calibration: StereoCalibration | None = None
    max_pixels: int = MAX_PIXELS
    eye_size: tuple[int, int] | None = None

    @property
    def description(self) -> Mapping[str, Any]:
        """Kind and number of frames."""
        return {"kind": "side-by-side video", "frames": len(self.names)}

    @property
    def notes(self) -> tuple[str, ...]:
        """What the file says of its eyes."""
        return ("the file says that the right eye comes first",) * (self.packing == "right-left")

    def files(self, index: int) -> tuple[Path, ...]:
        """The video."""
        return (self.path,)

    def stamp(self, index: int) -> Stamp | None:
        """When the container says that it was taken."""
        return self.track.stamp(index)

    def read(self, index: int) -> StereoPair:
        """Decode frame `index` and split it in the middle."""
        left, right = split_in_two(
            self.track.picture(index, self.max_pixels), self.path, self.packing
        )
        check_eye_size(left, self.eye_size, self.path)
        return make_pair(self, index, *to_8_bit(left, right))


@dataclass(frozen=True)
class VideoPairs:
    """Frames of a picture from each of two videos: `entries` are numbers of two tracks and of their
    pictures.
    """

    path: Path
    names: tuple[str, ...]
    tracks: tuple[Track, ...]
    entries: tuple[tuple[tuple[int, int] | None, tuple[int, int] | None], ...]
    calibration: StereoCalibration | None = None
    max_pixels: int = MAX_PIXELS

    @property
    def description(self) -> Mapping[str, Any]:
        """Kind, number of frames, and how many lack an eye."""
        unpaired = sum(None in pair for pair in self.entries)
        return {"kind": "two videos", "frames": len(self.names), "unpaired": unpaired}

    def files(self, index: int) -> tuple[Path, ...]:
        """The videos of both eyes, or of the one that has a picture."""
        return tuple(self.tracks[entry[0]].decoder.path for entry in self.entries[index] if entry)

    def stamp(self, index: int) -> Stamp | None:
        """When the left video says that it was taken; without a left picture, the right one."""
        track, picture = next(entry for entry in self.entries[index] if entry)
        return self.tracks[track].stamp(picture)

    def read(self, index: int) -> StereoPair:
        """Decode the pictures of frame `index`."""
        left, right = self.entries[index]
        if left is None or right is None:
            raise FrameError(
                f"frame {self.names[index]} has no {'left' if left is None else 'right'} picture at"
                " its time",
                code="UNPAIRED",
                file=self.path,
                remedy="Pictures of two videos that differ in number are paired by their time",
            )
        tracks = self.tracks[left[0]], self.tracks[right[0]]
        one, other = (
            track.picture(i, self.max_pixels)
            for track, (_, i) in zip(tracks, (left, right), strict=True)
        )
        check_alike(one, other, tracks[0].decoder.path, tracks[1].decoder.path.name)
        return make_pair(self, index, *to_8_bit(one, other))


def open_video(path: Path) -> SideBySideVideo:
    """Open a side-by-side video. Which half is the left eye is what the container or the first
    picture says.

    Raises
    ------
    SourceError
        When nothing in it can be decoded, or it says that its eyes are not beside each other.
    """
    said = read_container(path)
    if said.video_tracks > 1:
        raise SourceError(
            f"has {said.video_tracks} video tracks, not one with both eyes beside each other",
            file=path,
            remedy=(
                f"Write a file an eye (ffmpeg -i {path.name} -map 0:v:0 -c copy left.mkv -map 0:v:1"
                " -c copy right.mkv), then give --left left.mkv --right right.mkv"
            ),
        )
    track = _open_track(path, said)
    packing = said.packing or packing_of(track.decoder.first_packet()) or "left-right"
    try:
        check_packing(packing, path)
    except FrameError as fault:
        raise SourceError(fault.problem, file=path, remedy=fault.remedy) from None
    return SideBySideVideo(
        path, tuple(f"{index:06d}" for index in range(len(track.times_ms))), track, packing
    )


def open_video_pairs(path: Path, videos: Mapping[str, tuple[Path, Path]]) -> VideoPairs:
    """Open two videos, or several such pairs one after the other, by key.

    Pictures belong together by their number where both videos have equally many, else by their
    time.

    Raises
    ------
    SourceError
        When nothing in one of them can be decoded.
    """
    tracks: list[Track] = []
    names: list[str] = []
    entries: list[tuple[tuple[int, int] | None, tuple[int, int] | None]] = []
    for key, files in videos.items():
        left, right = (_open_track(file, read_container(file)) for file in files)
        first = len(tracks)
        tracks += (left, right)
        for number, (i, j) in enumerate(_together(left.times_ms, right.times_ms)):
            entries.append(
                (None if i is None else (first, i), None if j is None else (first + 1, j))
            )
            names.append(f"{number:06d}" if len(videos) == 1 else f"{key}_{number:06d}")
    return VideoPairs(path, frame_names(names), tuple(tracks), tuple(entries))


def _together(
    left_ms: Sequence[float], right_ms: Sequence[float]
) -> list[tuple[int | None, int | None]]:
    if len(left_ms) == len(right_ms):
        return [(index, index) for index in range(len(left_ms))]
    gaps = np.diff(left_ms if len(left_ms) > 1 else right_ms)
    _log.warning(
        "the videos have %d and %d pictures: paired by their times", len(left_ms), len(right_ms)
    )
    most_ns = round(5e5 * float(np.median(gaps))) if len(gaps) else 0
    return pair_by_stamp(
        [round(1e6 * ms) for ms in left_ms], [round(1e6 * ms) for ms in right_ms], most_ns
    )


def _open_track(path: Path, said: Container) -> Track:
    decoder = Decoder(path)
    check_pixels(*decoder.size(), path, MAX_PIXELS)
    claim, times_ms = decoder.claim(), decoder.times_ms()
    if not times_ms:
        raise SourceError(
            "can't be decoded as a video",
            file=path,
            remedy="Export it as side-by-side AVI, or as a folder of images",
        )
    if 0 < claim != len(times_ms):
        _log.info(
            "%s: the container claims %d pictures, %d can be decoded",
            path.name,
            claim,
            len(times_ms),
        )
    if turn := decoder.turn():
        _log.info(
            "%s asks players to turn the picture by %d°; pixels are taken as stored",
            path.name,
            turn,
        )
    if said.began_ns is not None:
        return Track(decoder, times_ms, said.began_ns, "container")
    ended_ns = path.stat().st_mtime_ns  # a recorder's last write is near its last picture
    return Track(decoder, times_ms, ended_ns - round(1e6 * times_ms[-1]), "modification time")
