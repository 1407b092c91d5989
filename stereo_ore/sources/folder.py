"""Folders of left and right images in the layouts that cameras and their tools write."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from stereo_ore.errors import FrameError, SourceError
from stereo_ore.sources.images import is_image, read_image, to_8_bit
from stereo_ore.sources.side_by_side import SideBySideImages
from stereo_ore.types import StereoPair

Files = dict[str, Path]

_MARKS = (  # where a file's stem carries the side; what is left over is the frame's key
    re.compile(r"^(?P<side>left|right)[_-]?(?P<key>.*)$", re.IGNORECASE),
    re.compile(r"^(?P<key>.*?)[_-]?(?P<side>left|right)$", re.IGNORECASE),
    re.compile(r"^(?P<key>.*?)[_-]?(?P<side>[LR])$"),
    re.compile(r"^(?P<side>[LR])[_-]?(?P<key>\d*)$"),
    re.compile(r"^im(?P<side>[01])(?P<key>)$"),
)
_SIDES = {"left": "left", "l": "left", "0": "left", "right": "right", "r": "right", "1": "right"}


@dataclass(frozen=True)
class ImagePairs:
    """Frames of two files each; either may be missing."""

    path: Path
    names: tuple[str, ...]
    pairs: tuple[tuple[Path | None, Path | None], ...]

    def files(self, index: int) -> tuple[Path, ...]:
        """The files of frame `index` that exist."""
        return tuple(file for file in self.pairs[index] if file)

    def read(self, index: int) -> StereoPair:
        """Read both images of frame `index`."""
        left, right = self.pairs[index]
        if left is None or right is None:
            missing = "left" if left is None else "right"
            raise FrameError(
                f"has no {missing} partner",
                code="UNPAIRED",
                file=left or right,
                remedy="Frames are paired by name, never by position",
            )
        images = read_image(left), read_image(right)
        if images[0].shape != images[1].shape:
            (h0, w0), (h1, w1) = images[0].shape[:2], images[1].shape[:2]
            raise FrameError(
                f"is {w0}×{h0} but {right.name} is {w1}×{h1}", code="SIZE_MISMATCH", file=left, remedy="Record again"
            )
        left_image, right_image = to_8_bit(*images)
        return StereoPair(self.names[index], index, left_image, right_image)


def open_two_files(left: Path, right: Path) -> ImagePairs:
    """One frame of two named files."""
    for file in (left, right):
        if not file.is_file():
            raise SourceError("no such file", file=file, remedy="Check the path")
    key = split_name(left.stem)[1] or left.resolve().parent.name
    return ImagePairs(left.parent, frame_names([key]), ((left, right),))


def open_folder(path: Path) -> ImagePairs | SideBySideImages:
    """Open a folder in whichever known layout it has.

    Raises
    ------
    SourceError
        When it has none of them, saying what is in it.
    """
    subfolders = {child.name.lower(): child for child in sorted(path.iterdir()) if child.is_dir()}
    if {"left", "right"} <= subfolders.keys():
        return _paired(path, _by_stem(subfolders["left"]), _by_stem(subfolders["right"]))
    images = sorted(filter(is_image, path.iterdir()))
    left, right = _by_mark(images, path)
    if left.keys() & right.keys():
        return _paired(path, left, right)
    if nested := [_by_mark(sorted(filter(is_image, child.iterdir())), child) for child in subfolders.values()]:
        lefts, rights = (
            {key: file for part in parts for key, file in part.items()} for parts in zip(*nested, strict=True)
        )
        if lefts.keys() & rights.keys():
            return _paired(path, lefts, rights)
    if left or right:
        raise SourceError(
            f"has {len(left)} left and {len(right)} right images, none of which belong together",
            file=path,
            remedy="Left and right images must have the same name but for the mark",
        )
    if images:
        return SideBySideImages(path, frame_names([file.stem for file in images]), tuple(images))
    raise SourceError(
        f"holds no stereo images that are known ({len(list(path.iterdir()))} entries)",
        file=path,
        remedy="Expected left/ and right/, left*.png and right*.png, or side-by-side images",
    )


def split_name(stem: str) -> tuple[str | None, str]:
    """Side ("left", "right" or None) and frame key of a file's stem."""
    for pattern in _MARKS:
        if match := pattern.match(stem):
            return _SIDES[match["side"].lower()], match["key"]
    return None, stem


def _by_mark(images: Iterable[Path], folder: Path) -> tuple[Files, Files]:
    sides: dict[str | None, Files] = {"left": {}, "right": {}}
    for image in images:
        side, key = split_name(image.stem)
        if side:
            sides[side].setdefault(key or folder.name, image)
    return sides["left"], sides["right"]


def _by_stem(folder: Path) -> Files:
    """Images by the frame's key, which may (left/left0001.png) or may not (left/0001.png) carry the side."""
    return {(split_name(file.stem)[1] or file.stem): file for file in sorted(filter(is_image, folder.iterdir()))}


def _paired(path: Path, left: Files, right: Files) -> ImagePairs:
    keys = sorted(left.keys() | right.keys(), key=natural_key)
    return ImagePairs(path, frame_names(keys), tuple((left.get(key), right.get(key)) for key in keys))


def natural_key(text: str) -> list[tuple[int, int, str]]:
    """Sort key by which frame 9 comes before frame 10."""
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", text) if part]


def frame_names(keys: Iterable[str]) -> tuple[str, ...]:
    """Names that are safe as file names, made unique by a counter."""
    names: dict[str, None] = {}
    for key in keys:
        name = re.sub(r"[^\w.-]+", "_", key, flags=re.ASCII).strip("._") or "frame"
        unique, count = name, 2
        while unique in names:
            unique, count = f"{name}_{count}", count + 1
        names[unique] = None
    return tuple(names)
