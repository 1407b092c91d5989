"""Folders of left and right images in the layouts that cameras and their tools write."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stereo_ore.config.models import MAX_PIXELS
from stereo_ore.errors import FrameError, SourceError
from stereo_ore.io.recordings.images import check_alike, is_image, read_both, to_8_bit
from stereo_ore.io.recordings.names import frame_names, name_stamp, natural_key, split_name
from stereo_ore.io.recordings.side_by_side import SideBySideImages
from stereo_ore.types import StereoCalibration, StereoPair

Files = dict[str, Path]


@dataclass(frozen=True)
class ImagePairs:
    """Frames of two files each; either may be missing."""

    path: Path
    names: tuple[str, ...]
    pairs: tuple[tuple[Path | None, Path | None], ...]
    calibration: StereoCalibration | None = None
    max_pixels: int = MAX_PIXELS

    @property
    def description(self) -> Mapping[str, Any]:
        """Kind, number of frames, and how many lack an eye."""
        unpaired = sum(None in pair for pair in self.pairs)
        return {"kind": "image pairs", "frames": len(self.names), "unpaired": unpaired}

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
        images = read_both(left, right, self.max_pixels)
        check_alike(*images, left, right.name)
        return StereoPair(
            *to_8_bit(*images), name=self.names[index], index=index, stamp_ns=name_stamp(self.names[index])
        )


def open_two_files(left: Path, right: Path) -> ImagePairs:
    """One frame of two named files."""
    for file in (left, right):
        if not file.is_file():
            raise SourceError("no such file", file=file, remedy="Check the path")
    side, key = split_name(left.stem)
    name = key or left.resolve().parent.name if side else left.stem
    return ImagePairs(left.parent, frame_names([name]), ((left, right),))


def open_folder(path: Path) -> ImagePairs | SideBySideImages:
    """Open a folder of images in whichever known layout it has.

    Raises
    ------
    SourceError
        When it has none of them, saying what is in it.
    """
    subfolders = {child.name.lower(): child for child in sorted(path.iterdir()) if child.is_dir()}
    if {"left", "right"} <= subfolders.keys():
        return _paired(path, _by_stem(subfolders["left"]), _by_stem(subfolders["right"]))
    images = sorted(filter(is_image, path.iterdir()), key=lambda file: natural_key(file.stem))
    if _marked(images):
        return _paired(path, *_by_mark(images, path.resolve().name))
    frames = [(child, sorted(filter(is_image, child.iterdir()))) for child in subfolders.values()]
    if any(_marked(files) for _, files in frames):
        return _paired(path, *_by_folder(frames))
    if images and not any(split_name(image.stem)[0] for image in images):
        return SideBySideImages(path, frame_names([file.stem for file in images]), tuple(images))
    raise _unknown_layout(path, images)


def _marked(images: Iterable[Path]) -> bool:
    """Whether left and right images are among them."""
    return {"left", "right"} <= {split_name(image.stem)[0] for image in images}


def _by_mark(images: Iterable[Path], default_key: str, prefix: str = "") -> tuple[Files, Files]:
    """Left and right images by frame; an image without a mark is no part of any frame."""
    sides: dict[str, Files] = {"left": {}, "right": {}}
    for image in images:
        side, key = split_name(image.stem)
        if side:
            _add(sides[side], prefix + key if key else default_key, image)
    return sides["left"], sides["right"]


def _by_folder(frames: Iterable[tuple[Path, list[Path]]]) -> tuple[Files, Files]:
    lefts, rights = Files(), Files()
    for folder, images in frames:
        left, right = _by_mark(images, folder.name, f"{folder.name}_")
        lefts |= left
        rights |= right
    return lefts, rights


def _by_stem(folder: Path) -> Files:
    """Images by the frame's key, which may (left/left0001.png) or may not (left/0001.png) carry the side."""
    files = Files()
    for file in sorted(filter(is_image, folder.iterdir())):
        _add(files, split_name(file.stem)[1] or file.stem, file)
    return files


def _add(files: Files, key: str, file: Path) -> None:
    if key in files:
        raise SourceError(
            f"{file.name} and {files[key].name} are for the same eye of frame {key!r}",
            file=file.parent,
            remedy="Keep one of them",
        )
    files[key] = file


def _paired(path: Path, left: Files, right: Files) -> ImagePairs:
    keys = sorted(left.keys() | right.keys(), key=natural_key)
    if not left.keys() & right.keys():
        raise SourceError(
            f"has {len(left)} left and {len(right)} right images, none of which belong together",
            file=path,
            remedy="Left and right images must have the same name but for the mark",
        )
    return ImagePairs(path, frame_names(keys), tuple((left.get(key), right.get(key)) for key in keys))


def _unknown_layout(path: Path, images: list[Path]) -> SourceError:
    children = sorted(path.iterdir())
    if images:
        found = f"holds images of one eye only, such as {images[0].name}"
    else:
        found = f"holds no stereo images that are known ({len(children)} entries)"
    files = [child.name for child in children if child.is_file() and not is_image(child)]
    hint = f"; it holds {files[0]}: name a recording file itself" if files else ""
    expected = "Expected left/ and right/, left*.png and right*.png, or side-by-side images"
    return SourceError(found, file=path, remedy=expected + hint)
