"""Folders of images or videos, in the layouts that cameras and their tools write."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from stereo_ore.config.models import MAX_PIXELS
from stereo_ore.errors import FrameError, SourceError
from stereo_ore.io.recordings.base import make_pair, sampled_depth
from stereo_ore.io.recordings.both_eyes import file_notes
from stereo_ore.io.recordings.images import (
    IMAGE_SUFFIXES,
    STEREO_SUFFIXES,
    Image,
    check_alike,
    read_both,
    to_8_bit,
)
from stereo_ore.io.recordings.layouts import (
    Eyes,
    Files,
    Listing,
    find_eyes,
    list_files,
    without_companions,
)
from stereo_ore.io.recordings.names import frame_names, name_stamp, natural_key, split_name
from stereo_ore.io.recordings.pairing import pair_by_stamp
from stereo_ore.io.recordings.side_by_side import SideBySideImages
from stereo_ore.io.recordings.stamps import Stamp, file_stamp, stamp_table
from stereo_ore.io.recordings.video import VIDEO_SUFFIXES, VideoPairs, open_video_pairs
from stereo_ore.types import StereoCalibration, StereoPair

MOST_NAMES = 6
"""Entries of a folder that a message names."""


@dataclass(frozen=True)
class ImagePairs:
    """Frames of two files each; either may be missing. `stamps` [ns] are those of a table, by name
    of file.
    """

    path: Path
    names: tuple[str, ...]
    pairs: tuple[tuple[Path | None, Path | None], ...]
    calibration: StereoCalibration | None = None
    max_pixels: int = MAX_PIXELS
    stamps: Mapping[str, int] = field(default_factory=dict)
    layout: str = ""

    @property
    def description(self) -> Mapping[str, Any]:
        """Kind, number of frames, and how many lack an eye."""
        unpaired = sum(None in pair for pair in self.pairs)
        return {"kind": "image pairs", "frames": len(self.names), "unpaired": unpaired}

    @property
    def notes(self) -> tuple[str, ...]:
        """Which layout it is, where it has a name, and how the files of the first frame are to be
        turned.
        """
        return (*filter(None, (self.layout,)), *file_notes(self.files(0)[0]))

    @cached_property
    def depth(self) -> int:
        """Bits of 16-bit images."""
        return sampled_depth(len(self.names), self.eyes)

    def files(self, index: int) -> tuple[Path, ...]:
        """The files of frame `index` that exist."""
        return tuple(file for file in self.pairs[index] if file)

    def stamp(self, index: int) -> Stamp | None:
        """When a table, the name or the left file says that it was taken."""
        files = self.files(index)
        table = next((self.stamps[file.name] for file in files if file.name in self.stamps), None)
        return file_stamp(self.names[index], files) if table is None else Stamp(table, "csv")

    def eyes(self, index: int) -> tuple[Image, Image]:
        """Both images of frame `index` as stored."""
        left, right = self.pairs[index]
        if left is None or right is None:
            missing = "left" if left is None else "right"
            raise FrameError(
                f"has no {missing} partner",
                code="UNPAIRED",
                file=left or right,
                remedy="Frames are paired by name, never by position",
            )
        images = read_both(left, right, self.max_pixels)
        check_alike(*images, left, right.name)
        return images

    def read(self, index: int) -> StereoPair:
        """Read both images of frame `index`."""
        left, right = self.eyes(index)
        depth = self.depth if left.dtype == np.uint16 else None
        return make_pair(self, index, *to_8_bit(left, right, depth))


def open_two_files(left: Path, right: Path, max_skew_ms: float = 5.0) -> ImagePairs | VideoPairs:
    """Two named files, one frame of images or a video an eye, or two folders of images.

    Raises
    ------
    SourceError
        When one is not there, or the two are not of the same kind.
    """
    for file in (left, right):
        if not file.exists():
            raise SourceError("no such file", file=file, remedy="Check the path")
    if left.is_dir() and right.is_dir():
        return _paired(
            left.parent, Eyes(_by_stem(left, "left"), _by_stem(right, "right")), max_skew_ms
        )
    side, key = split_name(left.stem)
    name = key or left.resolve().parent.name if side else left.stem
    if all(file.suffix.lower() in VIDEO_SUFFIXES for file in (left, right)):
        return open_video_pairs(left.parent, {name: (left, right)})
    for file, other in ((left, right), (right, left)):
        if file.is_dir() or file.suffix.lower() in VIDEO_SUFFIXES:
            raise SourceError(
                f"and {other.name} are not of the same kind",
                file=file,
                remedy="Give two images, videos or folders",
            )
    return ImagePairs(left.parent, frame_names([name]), ((left, right),))


def open_folder(path: Path, max_skew_ms: float = 5.0) -> ImagePairs | SideBySideImages | VideoPairs:
    """Open a folder of images in whichever known layout it has; without images, of videos.

    Raises
    ------
    SourceError
        When it has none of them, saying what is in it.
    """
    listing = list_files(path, IMAGE_SUFFIXES)
    name = path.resolve().name
    eyes = without_companions(find_eyes(listing, name), name)
    images = listing.get("", [])
    of_both = bool(images) and all(file.suffix.lower() in STEREO_SUFFIXES for file in images)
    if eyes.left and eyes.right and not of_both:
        return _paired(path, eyes, max_skew_ms)
    if of_both or (images and not (eyes.left or eyes.right)):
        images = sorted(images, key=lambda file: natural_key(file.stem))
        return SideBySideImages(path, frame_names([file.stem for file in images]), tuple(images))
    if not any(listing.values()):
        videos = find_eyes(list_files(path, VIDEO_SUFFIXES), name)
        if videos.left and videos.right:
            return open_video_pairs(path, _both(path, videos))
    if {"left", "right"} <= {child.name.lower() for child in path.iterdir() if child.is_dir()}:
        raise _none_together(path, eyes)
    raise _unknown_layout(path, listing, eyes)


def _by_stem(folder: Path, side: str) -> Files:
    """Images of one eye's folder by name, which may carry the mark of that eye."""
    eyes = Eyes()
    for files in list_files(folder, IMAGE_SUFFIXES).values():
        for file in files:
            own, key = split_name(file.stem)
            eyes.add("left", key if own == side and key else file.stem, file)
    return eyes.left


def _paired(path: Path, eyes: Eyes, max_skew_ms: float) -> ImagePairs:
    """Frames of the same name or, where all names are stamps that differ, of nearly the same
    stamp.
    """
    left, right = eyes.left, eyes.right
    if left.keys() == right.keys() or not (keys := _pairs_by_stamp(left, right, max_skew_ms)):
        if not left.keys() & right.keys():
            raise _none_together(path, eyes)
        keys = [(key, key) for key in sorted(left.keys() | right.keys(), key=natural_key)]
    names = frame_names(one if one in left else other for one, other in keys)
    tables = [
        stamp_table(Path(folder))
        for folder in {os.path.dirname(file): None for file in left.values()}
    ]
    table = {name: ns for each in tables for name, ns in each.items()}
    pairs = tuple((left.get(one), right.get(other)) for one, other in keys)
    return ImagePairs(path, names, pairs, stamps=table, layout=eyes.layout)


def _pairs_by_stamp(left: Files, right: Files, max_skew_ms: float) -> list[tuple[str, str]]:
    """Keys of the left and right image of each frame, where all are stamps; of a lost one, that of
    its partner.
    """
    ours, theirs = _stamped(left), _stamped(right)
    found = list[tuple[str, str]]()
    for before in ours if ours.keys() == theirs.keys() else ():
        one, other = ours[before], theirs[before]
        pairs = pair_by_stamp(
            [ns for ns, _ in one], [ns for ns, _ in other], round(max_skew_ms * 1e6)
        )
        found += [
            ("" if i is None else one[i][1], "" if j is None else other[j][1]) for i, j in pairs
        ]
    return found


def _stamped(files: Files) -> dict[str, list[tuple[int, str]]]:
    """Stamps [ns] and keys of files, in order, by what stands before the stamps (the name of their
    folder); empty where one has none.
    """
    found = dict[str, list[tuple[int, str]]]()
    for key, file in files.items():
        stamps = ((name, name_stamp(name)) for name in (key, split_name(file.stem)[1]))
        name, ns = next((each for each in stamps if each[1] is not None), ("", None))
        if ns is None:
            return {}
        found.setdefault(key.removesuffix(name), []).append((ns, key))
    return {before: sorted(found[before]) for before in sorted(found)}


def _both(path: Path, eyes: Eyes) -> dict[str, tuple[Path, Path]]:
    if not eyes.pairs:
        raise _none_together(path, eyes)
    keys = sorted(eyes.left.keys() & eyes.right.keys(), key=natural_key)
    return {key: (eyes.left[key], eyes.right[key]) for key in keys}


def _none_together(path: Path, eyes: Eyes) -> SourceError:
    examples = [min(files.values()).name for files in (eyes.left, eyes.right) if files]
    such = f": {', '.join(examples)}" if examples else ""
    return SourceError(
        f"has {len(eyes.left)} left and {len(eyes.right)} right images, none of which belong"
        f" together{such}",
        file=path,
        remedy=(
            "Left and right images must have the same name but for the mark, or all be named by"
            " their stamps"
        ),
    )


def _unknown_layout(path: Path, listing: Listing, eyes: Eyes) -> SourceError:
    children = sorted(path.iterdir())
    if found := [*eyes.left.values(), *eyes.right.values()]:
        problem = f"holds images of one eye only, such as {found[0].name}"
    else:
        problem = (
            f"holds no stereo images that are known ({len(children)} entries{_named(children)})"
        )
    images = {file for files in listing.values() for file in files}
    files = [child.name for child in children if child.is_file() and child not in images]
    hint = f"; it holds {files[0]}: name a recording file itself" if files else ""
    expected = (
        "Expected left/ and right/, left*.png and right*.png, or side-by-side images; of other"
        " names say which eye is which: --left FOLDER --right FOLDER"
    )
    return SourceError(problem, file=path, remedy=expected + hint)


def _named(children: Sequence[Path]) -> str:
    names = [f"{child.name}/" if child.is_dir() else child.name for child in children]
    return f": {', '.join(names[:MOST_NAMES])}{', …' * (len(names) > MOST_NAMES)}" if names else ""
