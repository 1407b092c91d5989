"""Which files of a folder are the left and the right image of which frame.

Eyes are told by their folders or by the names of their files: by the words left and right, by the
letters L and R, or as a known recorder or data set tells them (`LAYOUTS`). Where a name holds more
than one such mark, the one counts by which most files find their partner.
"""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Callable, Container, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from stereo_ore.errors import SourceError
from stereo_ore.io.recordings.marks import SEPARATORS, joined, marks, read_marks, without
from stereo_ore.io.recordings.names import Side

_log = logging.getLogger(__name__)

Files = dict[str, Path]
"""The files of one eye by the key of their frame."""
Listing = dict[str, list[Path]]
"""Files by their folder, relative to the recording's, with ``/`` (``""``: its own); folders without
files too."""
MOST_LEVELS = 6
STRUCTURE = frozenset(["data", "image", "images", "img", "cam", "camera", "mav0"]) | frozenset(
    ["rect", "rectified", "raw", "gray", "grey", "color", "colour"]
)
"""Folders, and what is left of a folder's name without its mark, that say nothing about the
frame."""
_GOES_WITH = re.compile(
    r"(?<![a-z])(?:depth|disp|disparity|seg|segmentation|mask|conf|confidence|occ|occlusions?|flow"
    r"|normals?)(?![a-z])",
    re.IGNORECASE,
)
"""Words in names of images that are no pictures but go with one."""


@dataclass(frozen=True)
class Layout:
    """How a recorder or data set names its files: ``*`` stands for the frame, folders may stand
    before.
    """

    name: str
    left: str
    right: str


LAYOUTS = (
    Layout("KITTI raw, colour", "image_02/data/*", "image_03/data/*"),
    Layout("KITTI raw, grey", "image_00/data/*", "image_01/data/*"),
    Layout("KITTI stereo 2012, tracking, colour", "image_02/*", "image_03/*"),
    Layout("KITTI stereo 2012, grey", "image_00/*", "image_01/*"),
    Layout("KITTI odometry, stereo 2015, colour", "image_2/*", "image_3/*"),
    Layout("KITTI odometry, grey", "image_0/*", "image_1/*"),
    Layout("EuRoC, TUM-VI", "cam0/data/*", "cam1/data/*"),
    Layout("Kalibr", "cam0/*", "cam1/*"),
    Layout("RealSense, a folder an eye", "infra1/*", "infra2/*"),
    Layout("RealSense, ROS names", "infrared_1/*", "infrared_2/*"),
    Layout("ETH3D SLAM", "rgb/*", "rgb2/*"),
    Layout("RealSense, in names", "infra1*", "infra2*"),
    Layout("RealSense, at the end of names", "*_infra1", "*_infra2"),
    Layout("RealSense Viewer", "*_Infrared_1", "*_Infrared_2"),
    Layout("TartanAir V2", "image_lcam_front/*_lcam_front", "image_rcam_front/*_rcam_front"),
    Layout("Virtual KITTI 2", "rgb/Camera_0/*", "rgb/Camera_1/*"),
    Layout("Booster", "camera_00/im*", "camera_02/im*"),
    Layout("Luxonis OAK, a folder a socket", "CAM_B/*", "CAM_C/*"),
    Layout("Luxonis OAK, sockets in names", "CAM_B*", "CAM_C*"),
    Layout("cam_0 and cam_1, a folder an eye", "cam_0/*", "cam_1/*"),
    Layout("camera0 and camera1, a folder an eye", "camera0/*", "camera1/*"),
    Layout("camera_0 and camera_1, a folder an eye", "camera_0/*", "camera_1/*"),
    Layout("cam1 and cam2, a folder an eye", "cam1/*", "cam2/*"),
    Layout("camera1 and camera2, a folder an eye", "camera1/*", "camera2/*"),
    Layout("cameras by number", "cam0_*", "cam1_*"),
    Layout("cameras by number, at the end of names", "*_cam0", "*_cam1"),
    Layout("Middlebury 2001, 2003", "im2", "im6"),
    Layout("Middlebury, ETH3D two views", "im0", "im1"),
    Layout("Middlebury 2005, 2006", "view1", "view5"),
)
"""Layouts by the names of folders, then those by the names of files; the first that fits counts."""


@dataclass
class Eyes:
    """Left and right files by frame, and those that tell no eye."""

    left: Files = field(default_factory=Files)
    right: Files = field(default_factory=Files)
    layout: str = ""
    """Name of the layout, where it is one of `LAYOUTS`."""

    @property
    def pairs(self) -> int:
        """Number of frames with both eyes."""
        return len(self.left.keys() & self.right.keys())

    def add(self, side: Side, key: str, file: Path) -> None:
        """Take a file for an eye of a frame."""
        files = self.left if side == "left" else self.right
        if key in files:
            raise SourceError(
                f"{file.name} and {files[key].name} are for the same eye of frame {key!r}",
                file=file.parent,
                remedy="Keep one of them",
            )
        files[key] = file


def list_files(root: Path, suffixes: tuple[str, ...], skip: Container[str] = ()) -> Listing:
    """The files of some suffixes by folder, each folder's sorted by name; hidden ones and paths in
    `skip` left out.

    A folder with the name of a file is listed as one, to fail when it is read.
    """
    listing: Listing = {}
    _list(listing, root, "", suffixes, skip)
    return dict(sorted(listing.items()))


def _list(
    listing: Listing, root: Path, folder: str, suffixes: tuple[str, ...], skip: Container[str]
) -> None:
    folders, found = [], []
    parent = root / folder if folder else root
    with os.scandir(parent) as entries:
        for entry in entries:
            if entry.name.startswith("."):
                continue
            if entry.name.lower().endswith(suffixes):
                if entry.path not in skip:
                    found.append(entry.name)
            elif entry.is_dir():
                folders.append(entry.name)
    listing[folder] = [parent / name for name in sorted(found)]
    if folder.count("/") < MOST_LEVELS:
        for name in folders:
            _list(listing, root, f"{folder}/{name}" if folder else name, suffixes, skip)


def find_eyes(listing: Listing, default_key: str) -> Eyes:
    """The eyes in a listing, by the first rule that finds a pair; without any, what came nearest.

    Parameters
    ----------
    listing
        Files by folder.
    default_key
        Key of a frame whose files' names are nothing but a mark.
    """
    own = {"": listing.get("", [])}
    inner = {folder: files for folder, files in listing.items() if folder}
    rules: tuple[Callable[[], Eyes], ...] = (
        lambda: _by_folder(_folder_marks([folder for folder in inner if _plain(folder)]), inner),
        lambda: _by_file(own, default_key),
        lambda: _by_folder(_folder_marks(list(inner)), inner),
        lambda: _by_layout(inner, default_key),
        lambda: _by_layout(own, default_key),
        lambda: _by_file(inner, default_key),
    )
    best = Eyes()
    for rule in rules:
        found = rule()
        if found.pairs:
            return found
        best = max(
            best,
            found,
            key=lambda eyes: (bool(eyes.left and eyes.right), bool(eyes.left or eyes.right)),
        )
    return best


def _plain(folder: str) -> bool:
    """Whether a folder is one eye's by its whole name, or is in such a one."""
    return folder.split("/")[0].lower() in ("left", "right")


def without_companions(eyes: Eyes, default_key: str) -> Eyes:
    """The eyes without what only goes with a picture and whose name says so (``7_depth`` beside
    ``7``): data sets keep depths, disparities, masks and the like among the pictures.
    """
    keys = eyes.left.keys() | eyes.right.keys()
    if not _GOES_WITH.search("\n".join(keys)):
        return eyes
    words = {key: [word for word in re.split(r"[-_. ]+", key) if word] for key in keys}
    names = {"_".join(each) for each in words.values()} | {default_key} & keys
    others = set[str]()
    for key, each in words.items():
        kept = [word for word in each if not _GOES_WITH.fullmatch(word)]
        if kept != each and ("_".join(kept) or default_key) in names:
            others.add(key)
    if others:
        _log.warning(
            "%d pairs are left out: by their names they only go with others, as depths or masks"
            " do (%s)",
            len(others),
            min(others),
        )
    return replace(
        eyes,
        left={key: file for key, file in eyes.left.items() if key not in others},
        right={key: file for key, file in eyes.right.items() if key not in others},
    )


# --- by folders


def _folder_marks(folders: Sequence[str]) -> dict[str, tuple[Side, str]]:
    """Eye, and what its name adds to the keys of frames, of the folders that belong to one."""
    return {
        folder: (side, _folder_key(rest))
        for folder, (side, rest) in zip(folders, read_marks(folders), strict=True)
        if side
    }


def _folder_key(rest: str) -> str:
    parts = [part.strip(SEPARATORS) for part in rest.split("/")]
    return "_".join(part for part in parts if part and part.lower() not in STRUCTURE)


def _by_folder(folders: dict[str, tuple[Side, str]], listing: Listing) -> Eyes:
    """Eyes of marked folders; their files' names may carry the mark too (left/left0001.png)."""
    if {side for side, _ in folders.values()} != {"left", "right"} and not all(
        map(_plain, folders)
    ):
        return Eyes()
    kept = _keyed(folders, listing, strip=False)
    sides = {"left": kept.left, "right": kept.right}
    if any(
        mark.side == side
        for side, files in sides.items()
        for file in files.values()
        for mark in marks(file.name)
    ):
        stripped = _keyed(folders, listing, strip=True)
        return stripped if stripped.pairs >= kept.pairs else kept
    return kept


def _keyed(folders: dict[str, tuple[Side, str]], listing: Listing, strip: bool) -> Eyes:
    """Files of marked folders by their names, from which the last mark of their own eye is
    taken.
    """
    eyes = Eyes()
    for folder, (side, prefix) in folders.items():
        for file in listing[folder]:
            stem = file.stem
            own = [mark for mark in marks(stem) if mark.side == side] if strip else []
            eyes.add(side, joined(prefix, without(stem, own[-1:]) or stem), file)
    return eyes


# --- by names of files


def _by_file(listing: Listing, default_key: str) -> Eyes:
    """Eyes of marked files; of folders of them, the folder's name is part of the frame's."""
    eyes = Eyes()
    places = [(folder, file) for folder, files in listing.items() for file in files]
    read = read_marks([file.stem for _, file in places], [folder for folder, _ in places])
    for (folder, file), (side, key) in zip(places, read, strict=True):
        if side:
            eyes.add(side, joined(folder.replace("/", "_"), key) or default_key, file)
    return eyes


# --- by the names that recorders use


def may_be_eye(stem: str) -> bool:
    """Whether a file's name tells an eye, if only there is one that tells the other."""
    names = (
        pattern
        for layout in LAYOUTS
        for pattern in (layout.left, layout.right)
        if "/" not in pattern
    )
    return bool(marks(stem)) or any(_key(stem, name) is not None for name in names)


def _by_layout(listing: Listing, default_key: str) -> Eyes:
    everything = "\n".join(
        f"{folder}/{file.name}" for folder, files in listing.items() for file in files
    )
    everything += "\n" + "\n".join(listing)
    for layout in LAYOUTS:
        if max(layout.left.split("*"), key=len).strip("/") not in everything:
            # A hundred thousand names need not be looked at one by one.
            continue
        eyes = Eyes(layout=layout.name)
        for side, pattern in (("left", layout.left), ("right", layout.right)):
            for key, file in _matches(listing, pattern, layout):
                eyes.add("left" if side == "left" else "right", key or default_key, file)
        folders = [pattern.rpartition("/")[0] for pattern in (layout.left, layout.right)]
        if eyes.pairs or (
            all(folders) and set(folders) <= {_tail(folder, folders) for folder in listing}
        ):
            return eyes
    return Eyes()


def _tail(folder: str, folders: Sequence[str]) -> str:
    """Which of some folders a folder is, other folders before it left out."""
    return next((name for name in folders if folder == name or folder.endswith(f"/{name}")), "")


def _has_rivals(files: Sequence[Path], layout: Layout) -> bool:
    """Whether more views are there than the two of a layout and nothing says that these two are the
    pair.
    """
    stems = {file.stem for file in files}
    numbers = {
        stem.removeprefix(layout.left.rstrip("0123456789"))
        for stem in stems - {layout.left, layout.right}
    }
    truth = {f"disp{view[-1]}" for view in (layout.left, layout.right)}
    return any(number.isdecimal() for number in numbers) and not truth <= stems


def _matches(listing: Listing, pattern: str, layout: Layout) -> Iterator[tuple[str, Path]]:
    """Key and file of what is named by one pattern of a layout."""
    parent, _, name = pattern.rpartition("/")
    for folder, files in listing.items():
        if parent and not _tail(folder, (parent,)):
            continue
        if "*" not in name and _has_rivals(files, layout):
            continue
        prefix = _folder_key(folder.removesuffix(parent))
        for file in files:
            if (key := _key(file.stem, name)) is not None:
                yield joined(prefix, key), file


def _key(stem: str, pattern: str) -> str | None:
    """What stands for the star of a pattern in a name; None where the name does not fit."""
    before, star, after = pattern.partition("*")
    if not star:
        return "" if stem == pattern else None
    fits = stem.startswith(before) and stem.endswith(after) and len(stem) > len(before) + len(after)
    return stem[len(before) : len(stem) - len(after)].strip(SEPARATORS) if fits else None
