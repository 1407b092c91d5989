"""The frames in a folder that are not done yet, listed in a time that hardly grows with those that
are.
"""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass
from pathlib import Path

from stereo_ore.io.recordings import Source
from stereo_ore.io.recordings.folder import ImagePairs
from stereo_ore.io.recordings.images import IMAGE_SUFFIXES
from stereo_ore.io.recordings.layouts import find_eyes, list_files, may_be_eye
from stereo_ore.io.recordings.names import frame_names, natural_key
from stereo_ore.io.recordings.side_by_side import SideBySideImages


@dataclass(frozen=True)
class Arrival:
    """One frame with the files that are there so far: alone in `source`, and `paired` when no eye
    is missing.
    """

    name: str
    source: Source
    paired: bool

    @property
    def files(self) -> tuple[Path, ...]:
        """Its files."""
        return self.source.files(0)


def arrivals(folder: Path, done: Container[str]) -> list[Arrival]:
    """Frames of a folder in the natural order of their names, in the layouts that `sources.folder`
    knows.

    Parameters
    ----------
    folder : Path
        Folder with left and right images, together or in subfolders, or with side-by-side images.
    done : container of str
        Paths of files to leave out.
    """
    listing = list_files(folder, IMAGE_SUFFIXES, done)
    eyes = find_eyes(listing, folder.resolve().name)
    found = [
        _pair(folder, key, eyes.left.get(key), eyes.right.get(key))
        for key in eyes.left.keys() | eyes.right.keys()
    ]
    marked = {*eyes.left.values(), *eyes.right.values()}
    found += [
        _single(folder, file) for file in listing[""] if file not in marked and file.is_file()
    ]
    return sorted(found, key=lambda arrival: natural_key(arrival.name))


def _pair(folder: Path, key: str, left: Path | None, right: Path | None) -> Arrival:
    names = frame_names([key])
    return Arrival(
        names[0],
        ImagePairs(folder, names, ((left, right),)),
        left is not None and right is not None,
    )


def _single(folder: Path, file: Path) -> Arrival:
    """A frame of one file; where its name may tell an eye, its partner is waited for."""
    names = frame_names([file.stem])
    return Arrival(names[0], SideBySideImages(folder, names, (file,)), not may_be_eye(file.stem))
