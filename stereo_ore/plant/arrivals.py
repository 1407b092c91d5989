"""The frames in a folder that are not done yet, listed in a time that hardly grows with those that are."""

from __future__ import annotations

import os
from collections.abc import Container, Iterator
from dataclasses import dataclass
from pathlib import Path

from stereo_ore.io.recordings import Source
from stereo_ore.io.recordings.folder import ImagePairs
from stereo_ore.io.recordings.images import IMAGE_SUFFIXES
from stereo_ore.io.recordings.names import frame_names, natural_key, split_name
from stereo_ore.io.recordings.side_by_side import SideBySideImages

SIDES = ("left", "right")


@dataclass(frozen=True)
class Arrival:
    """One frame with the files that are there so far: alone in `source`, and `paired` when no eye is missing."""

    name: str
    source: Source
    paired: bool

    @property
    def files(self) -> tuple[Path, ...]:
        """Its files."""
        return self.source.files(0)


def arrivals(folder: Path, done: Container[str]) -> list[Arrival]:
    """Frames of a folder in the natural order of their names, in the layouts that `sources.folder` knows.

    Parameters
    ----------
    folder : Path
        Folder with left and right images, together or in subfolders, or with side-by-side images.
    done : container of str
        Paths of files to leave out.
    """
    pairs: dict[str, dict[str, Path]] = {}
    singles: dict[str, Path] = {}
    for file in _images(folder, done):
        side, key = _side_and_key(file, folder)
        if side:
            pairs.setdefault(key, {}).setdefault(side, file)
        elif file.parent == folder:
            singles[key] = file
    found = [_pair(folder, key, pair) for key, pair in pairs.items()]
    found += [_single(folder, key, file) for key, file in singles.items()]
    return sorted(found, key=lambda arrival: natural_key(arrival.name))


def _images(folder: Path, done: Container[str]) -> Iterator[Path]:
    """Image files of a folder and its subfolders that are not done, each folder sorted."""
    with os.scandir(folder) as entries:
        listed = sorted(entries, key=lambda entry: entry.name)
    for entry in listed:
        if entry.is_dir() and not entry.name.startswith("."):
            with os.scandir(entry.path) as inner:
                yield from (Path(path) for path in sorted(file.path for file in inner if _is_new(file, done)))
        elif _is_new(entry, done):
            yield Path(entry.path)


def _is_new(entry: os.DirEntry[str], done: Container[str]) -> bool:
    named = entry.name.lower().endswith(IMAGE_SUFFIXES) and not entry.name.startswith(".")
    return named and entry.path not in done and entry.is_file()


def _side_and_key(file: Path, folder: Path) -> tuple[str | None, str]:
    """Which eye a file shows (None: both, or it does not tell) and of which frame."""
    side, key = split_name(file.stem)
    if file.parent == folder:
        return side, key or folder.resolve().name
    if file.parent.name.lower() in SIDES:
        return file.parent.name.lower(), key or file.stem
    return side, f"{file.parent.name}_{key}" if key else file.parent.name


def _pair(folder: Path, key: str, pair: dict[str, Path]) -> Arrival:
    names = frame_names([key])
    left, right = (pair.get(side) for side in SIDES)
    return Arrival(names[0], ImagePairs(folder, names, ((left, right),)), len(pair) == 2)


def _single(folder: Path, key: str, file: Path) -> Arrival:
    names = frame_names([key])
    return Arrival(names[0], SideBySideImages(folder, names, (file,)), True)
