"""Image files that hold both eyes: which is which, and what they say that is worth a word."""

from __future__ import annotations

from pathlib import Path

from stereo_ore.config.models import MAX_PIXELS
from stereo_ore.errors import FrameError
from stereo_ore.io.recordings import jpeg
from stereo_ore.io.recordings.images import (
    JPEG,
    Image,
    check_alike,
    decode_image,
    read_bytes,
    split_in_two,
    turn_of,
    turn_words,
)


def read_side_by_side(path: Path, max_pixels: int = MAX_PIXELS) -> tuple[Image, Image]:
    """Both eyes of a file that holds them beside each other or as two pictures, left eye first.

    Which half is the left eye is what a JPEG stereo file says; of one that says nothing, the right
    half.

    Raises
    ------
    FrameError
        As `read_image`, and when the file says that its eyes are arranged otherwise.
    """
    data = read_bytes(path, max_pixels)
    if pair := jpeg.pictures(data):
        left, right = (decode_image(picture, path, max_pixels) for picture in pair)
        check_alike(left, right, path, "its second picture")
        return left, right
    packing = _packing_of(data, path)
    image = decode_image(data, path, max_pixels)
    return split_in_two(image, path, packing or "left-right")


def _packing_of(data: bytes, path: Path) -> str | None:
    """What an image file says of its eyes; None: nothing."""
    said = jpeg.jps_packing(data) if data.startswith(JPEG) else None
    return said or ("right-left" if path.suffix.lower() == ".jps" else None)


def is_stereo_file(path: Path) -> bool:
    """Whether an image file says of itself that it holds both eyes; errors as those of
    `read_image`.
    """
    data = read_bytes(path)
    return _packing_of(data, path) is not None or bool(jpeg.pictures(data))


def file_notes(path: Path) -> tuple[str, ...]:
    """What an image file says that is worth a word: which eye comes first, a turn that is not
    made.
    """
    try:
        data = read_bytes(path)
    except FrameError:
        return ()
    turn, exchanged = (
        turn_of(data),
        _packing_of(data, path) == "right-left" and not jpeg.pictures(data),
    )
    return (
        *([f"{path.name} says that the right eye comes first"] if exchanged else ()),
        *(
            [f"{path.name} asks viewers to turn it {turn_words(turn)}, pixels are taken as stored"]
            if turn != 1
            else ()
        ),
    )


def check_eye_size(left: Image, eye_size: tuple[int, int] | None, path: Path) -> None:
    """FrameError when a picture that was halved is that of one eye, or holds the eyes over and
    under.

    Parameters
    ----------
    left
        (H, W, 3) half of the picture.
    eye_size
        Width and height [px] of one eye of the calibration; None: not known.
    path
        For messages.
    """
    height, width = left.shape[:2]
    arrangements = {
        (width, height): "",
        (
            2 * width,
            height,
        ): "one eye of the calibration: these are images of one eye, not side-by-side ones",
        (
            2 * width,
            height // 2,
        ): "two eyes of the calibration over and under, not beside each other",
    }
    if eye_size and (found := arrangements.get(eye_size)):
        raise FrameError(
            f"is {2 * width}×{height} px, as {found}",
            code="SIZE_MISMATCH",
            file=path,
            remedy=(
                "Give the folder or files of both eyes (--left, --right), or side-by-side images"
            ),
        )
