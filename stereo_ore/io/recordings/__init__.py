"""Recordings: a SOURCE is recognised by what it is and opened as a sequence of frames."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from stereo_ore.errors import FrameError, SourceError
from stereo_ore.io.recordings.bag import BagOptions, is_bag_folder, open_bag
from stereo_ore.io.recordings.bag_files import BAG_SUFFIXES
from stereo_ore.io.recordings.base import OpenedSource, Source
from stereo_ore.io.recordings.folder import open_folder, open_two_files
from stereo_ore.io.recordings.images import IMAGE_SUFFIXES
from stereo_ore.io.recordings.side_by_side import open_side_by_side_image
from stereo_ore.io.recordings.svo import open_svo
from stereo_ore.io.recordings.video import VIDEO_SUFFIXES, open_video
from stereo_ore.types import StereoPair

__all__ = [
    "BagOptions",
    "OpenedSource",
    "Source",
    "describe_recording",
    "expect_eyes",
    "frame_size",
    "limit_pixels",
    "open_source",
    "open_two_files",
]

_KINDS = {
    "image pairs": "frame# of two images",
    "side-by-side images": "side-by-side frame#",
    "side-by-side video": "side-by-side frame# of a video",
    "two videos": "frame# of two videos",
}
"""Kinds of recordings in words; ``#`` is the plural's s."""
MOST_TRIED = 5
"""Frames that are tried for their size."""

Opener = Callable[[Path, BagOptions], OpenedSource]

FILE_OPENERS: dict[str, Opener] = {
    **dict.fromkeys(IMAGE_SUFFIXES, lambda path, _: open_side_by_side_image(path)),
    **dict.fromkeys(VIDEO_SUFFIXES, lambda path, _: open_video(path)),
    **dict.fromkeys(BAG_SUFFIXES, open_bag),
    **dict.fromkeys((".svo", ".svo2"), lambda path, _: open_svo(path)),
}
"""Openers by how a file's name ends, the longest ending first; to add a container format, add its
line here."""


def open_source(
    path: Path,
    options: BagOptions = BagOptions(),  # noqa: B008 - immutable
) -> OpenedSource:
    """Open a recording: a folder in any known layout, or a file; `options` matter for bags.

    Raises
    ------
    SourceError
        When there is nothing there or the layout is none of the known ones, saying what was found.
    """
    if not path.exists():
        raise SourceError("no such file or folder", file=path, remedy="Check the path")
    if path.is_dir():
        return (
            open_bag(path, options)
            if is_bag_folder(path)
            else open_folder(path, options.max_skew_ms)
        )
    endings = [ending for ending in FILE_OPENERS if path.name.lower().endswith(ending)]
    if not endings:
        raise SourceError(
            f"files ending in {path.suffix.lower()!r} are not known",
            file=path,
            remedy=f"Known: {known_layouts()}",
        )
    return FILE_OPENERS[max(endings, key=len)](path, options)


def limit_pixels(source: OpenedSource, max_pixels: int) -> OpenedSource:
    """The same recording, whose pictures of more than `max_pixels` are refused before they are
    decoded.
    """
    return replace(source, max_pixels=max_pixels)


def expect_eyes(source: OpenedSource, eye_size: tuple[int, int]) -> OpenedSource:
    """The same recording; pictures that are to hold two eyes of `eye_size` (width, height) and hold
    one are refused.
    """
    return replace(source, eye_size=eye_size) if hasattr(source, "eye_size") else source


def frame_size(source: Source) -> tuple[int, int] | None:
    """Width and height [px] of the first frame that can be read: some calibration files hold
    several resolutions.
    """
    pair = _first_pair(source)
    return None if pair is None else (pair.left.shape[1], pair.left.shape[0])


def _first_pair(source: Source, most: int | None = None) -> StereoPair | None:
    """The first frame that can be read, of `most` that are tried."""
    for index in range(len(source.names))[:most]:
        with suppress(FrameError):
            return source.read(index)
    return None


def known_layouts() -> str:
    """One sentence that lists what a SOURCE can be."""
    return (
        "a folder with left/ and right/; a folder with left*.png right*.png (also *_left/_right,"
        " *L/*R); a folder that holds left.png right.png, or a folder of such folders; the layouts"
        " of KITTI, EuRoC, TUM-VI, Middlebury, ETH3D and RealSense; a side-by-side image or a"
        " folder of them; a side-by-side video, or a folder with a left and a right one; a ROS 1 or"
        " ROS 2 bag or MCAP file; an SVO2 recording"
    )


def describe_recording(source: Source) -> str:
    """One line that says what is taken for what: "120 side-by-side frames of 2 × 1280×720, …"."""
    about, count = source.description, len(source.names)
    kind = _KINDS.get(
        about["kind"], "frame# of " + " and ".join(about.get("topics", [about["kind"]]))
    )
    words = f"{count} {kind.replace('#', 's' * (count != 1))}"
    if (pair := _first_pair(source, MOST_TRIED)) is not None:
        height, width = pair.left.shape[:2]
        words += f"{',' if ' of ' in words else ' of'} 2 × {width}×{height}"
        words += f", stamps: {pair.stamp_source}" if pair.stamp_source else ""
    return "; ".join(filter(None, (words, *getattr(source, "notes", ()))))
