"""The frames of a listing of files, with whatever files of theirs are there so far."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from stereo_ore.errors import SourceError
from stereo_ore.io.recordings import OpenedSource
from stereo_ore.io.recordings.folder import ImagePairs
from stereo_ore.io.recordings.layouts import Eyes, Listing, find_eyes, may_be_eye
from stereo_ore.io.recordings.names import frame_names, natural_key
from stereo_ore.io.recordings.side_by_side import SideBySideImages


@dataclass(frozen=True)
class Arrival:
    """One frame with the files that are there so far: alone in `source`, and `paired` when no eye
    is missing. `name` is safe as a file's, `key` tells the frame from all others of a listing.
    """

    name: str
    key: str
    source: OpenedSource
    paired: bool

    @property
    def files(self) -> tuple[Path, ...]:
        """Its files."""
        return self.source.files(0)


def arrivals(folder: Path, listing: Listing) -> list[Arrival]:
    """Frames of a folder in the natural order of their names, in the layouts that `sources.folder`
    knows.

    Parameters
    ----------
    folder : Path
        Folder with left and right images, together or in subfolders, or with side-by-side images.
    listing
        Its files by their folder.
    """
    eyes, odd = _find_eyes(listing, folder.resolve().name)
    found = [
        _pair(folder, key, eyes.left.get(key), eyes.right.get(key))
        for key in eyes.left.keys() | eyes.right.keys()
    ]
    marked = {*eyes.left.values(), *eyes.right.values(), *odd}
    found += [_alone(folder, file) for file in odd]
    found += [
        _single(folder, file)
        for file in listing.get("", ())
        if file not in marked and file.is_file()
    ]
    return sorted(found, key=lambda arrival: natural_key(arrival.name))


def _find_eyes(listing: Listing, default_key: str) -> tuple[Eyes, list[Path]]:
    """The eyes of a listing, and files that claim an eye which another file is already: they must
    not keep all others from being found.
    """
    order = [(folder, file) for folder, files in listing.items() for file in files]
    odd: list[Path] = []
    while True:
        try:
            return find_eyes(_some(listing, order), default_key), odd
        except SourceError:
            at = _first(
                len(order), lambda count: _fails(_some(listing, order[:count]), default_key)
            )
            odd.append(order.pop(at - 1)[1])


def _some(listing: Listing, order: list[tuple[str, Path]]) -> Listing:
    some: Listing = {folder: [] for folder in listing}
    for folder, file in order:
        some[folder].append(file)
    return some


def _fails(listing: Listing, default_key: str) -> bool:
    try:
        find_eyes(listing, default_key)
    except SourceError:
        return True
    return False


def _first(most: int, holds: Callable[[int], bool]) -> int:
    """The smallest number up to `most`, for which it holds, from which on it holds."""
    low, high = 0, most
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if holds(middle) else (middle, high)
    return high


def _pair(folder: Path, key: str, left: Path | None, right: Path | None) -> Arrival:
    names = frame_names([key])
    paired = left is not None and right is not None
    return Arrival(names[0], f"pair {key}", ImagePairs(folder, names, ((left, right),)), paired)


def _alone(folder: Path, file: Path) -> Arrival:
    """A frame that never gets its other eye."""
    names = frame_names([file.stem])
    return Arrival(names[0], f"odd {file}", ImagePairs(folder, names, ((file, None),)), False)


def _single(folder: Path, file: Path) -> Arrival:
    """A frame of one file; where its name may tell an eye, its partner is waited for."""
    names = frame_names([file.stem])
    source = SideBySideImages(folder, names, (file,))
    return Arrival(names[0], f"file {file}", source, not may_be_eye(file.stem))
