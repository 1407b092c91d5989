"""Image files as BGR, or a typed error: a damaged file must never become half a picture."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from stereo_ore.config.models import MAX_PIXELS
from stereo_ore.errors import FrameError
from stereo_ore.io.recordings import jpeg
from stereo_ore.io.recordings.image_header import claimed_size, tiff_pages, tiff_tags
from stereo_ore.io.recordings.quiet import overheard
from stereo_ore.threads import pool
from stereo_ore.types import U8

STEREO_SUFFIXES = (".jps", ".mpo")
"""Files that hold both eyes, whatever they are called."""
IMAGE_SUFFIXES = (
    ".png",
    ".jpg",
    ".jpeg",
    ".tif",
    ".tiff",
    ".bmp",
    ".pgm",
    ".ppm",
    ".webp",
    *STEREO_SUFFIXES,
)
BYTES_PER_PIXEL, _HEADER_BYTES = 8, 1_000_000
"""Four channels of 16 bit, uncompressed, and what else a file may hold."""
JPEG, _PNG, _TIFF = b"\xff\xd8", b"\x89PNG\r\n\x1a\n", (b"II", b"MM")
_PNG_END = b"IEND\xaeB`\x82"
_DAMAGE = re.compile(rb"libpng error|TIFF_Error")
TURNS = {3: "by 180°", 6: "by 90° clockwise", 8: "by 90° anticlockwise"}
"""Exif's orientations in words; the others mirror."""
BRIGHT_SHARE = 1e-4
"""Share of the pixels that may be brighter than the depth of the recording allows: defects of the
sensor."""
MOST_SCANS = 64
"""Scans of a progressive JPEG: decoders go through the whole picture for each, whatever little it
holds."""


Image = npt.NDArray[Any]
"""(H, W, 3) BGR, uint8 or uint16."""


def read_image(path: Path, max_pixels: int = MAX_PIXELS) -> Image:
    """Decode an image file as stored: (H, W, 3) BGR, uint8 or uint16; grey is repeated, alpha
    dropped.

    Raises
    ------
    FrameError
        When the file is missing, empty, cut off, damaged, too large, or no image.
    """
    return decode_image(read_bytes(path, max_pixels), path, max_pixels)


def read_both(left: Path, right: Path, max_pixels: int = MAX_PIXELS) -> tuple[Image, Image]:
    """Both eyes' files as `read_image`, decoded side by side, which takes half the time.

    Raises
    ------
    FrameError
        As `read_image`, and when the files say that one eye is to be turned and the other is not.
    """
    files = (left, read_bytes(left, max_pixels)), (right, read_bytes(right, max_pixels))
    for path, data in files:
        _check(path, data, max_pixels)
    _check_turns(files)
    images, complaints = overheard(lambda: list(pool().map(_decode, [data for _, data in files])))
    if complaints or any(image is None for image in images):
        # One after the other, to hear whose they are.
        images = [decode_image(data, path, max_pixels) for path, data in files]
    one, other = (_usable(image, path) for image, (path, _) in zip(images, files, strict=True))
    return one, other


def turn_of(data: bytes) -> int:
    """The turn that an image file asks viewers for, as Exif counts them; 1: none. Pixels are read
    as stored.
    """
    if data.startswith(JPEG):
        return jpeg.orientation(data)
    if data.startswith(_PNG):
        place = data.find(b"eXIf", 8, data.find(b"IDAT", 8) + 1)
        data = data[place + 4 :] if place > 0 else b""
    return int(tiff_tags(data).get(jpeg.ORIENTATION, 1)) if data.startswith(_TIFF) else 1


def turn_words(turn: int) -> str:
    """A turn in words."""
    return TURNS.get(turn, "over" if turn in (2, 4, 5, 7) else "in no way")


def _check_turns(files: Sequence[tuple[Path, bytes]]) -> None:
    (left, one), (right, other) = ((path, turn_of(data)) for path, data in files)
    if one != other:
        turned, other_file = (left, right) if one != 1 else (right, left)
        words = turn_words(one if one != 1 else other)
        raise FrameError(
            f"says that it is to be turned {words}, {other_file.name} does not say so",
            code="ORIENTATION_MISMATCH",
            file=turned,
            remedy=(
                "Calibrations belong to pixels as stored; turn the eyes alike: exiftool"
                " -Orientation= FILES"
            ),
        )


def read_bytes(path: Path, max_pixels: int = MAX_PIXELS) -> bytes:
    """The bytes of a file that may be an image of `max_pixels`; errors as those of `read_image`."""
    most = BYTES_PER_PIXEL * max_pixels + _HEADER_BYTES
    try:
        if not path.is_file() and path.exists():
            raise FrameError("can't be read: it is no file", code="UNREADABLE_IMAGE", file=path)
        with path.open("rb") as file:
            data = file.read(most + 1)
    except OSError as fault:
        raise FrameError(
            f"can't be read: {fault.strerror}", code="UNREADABLE_IMAGE", file=path
        ) from None
    if len(data) > most:
        problem = f"has more than {most:,} bytes, which no image of {max_pixels:,} pixels has"
        raise FrameError(
            problem, code="IMAGE_TOO_LARGE", file=path, remedy="Record or copy it again"
        )
    return data


def decode_image(data: bytes, path: Path, max_pixels: int = MAX_PIXELS) -> Image:
    """Decode the bytes of an image file; as `read_image`. `path` is for messages."""
    _check(path, data, max_pixels)
    image, complaints = overheard(lambda: _decode(data))
    damaged = _DAMAGE.search(complaints) or jpeg.damage(data, complaints)
    return _usable(None if damaged else image, path)


def _check(path: Path, data: bytes, max_pixels: int) -> None:
    """Refuse what need not be decoded to be known as damaged or too large."""
    if not data:
        raise FrameError(
            "is empty", code="UNREADABLE_IMAGE", file=path, remedy="Record or copy it again"
        )
    _check_complete(path, data)
    if data.startswith(b"\xff\xd8") and (scans := data.count(b"\xff\xda")) > MOST_SCANS:
        problem = f"has {scans:,} scans; a camera's JPEG has at most {MOST_SCANS}"
        raise FrameError(
            problem, code="UNREADABLE_IMAGE", file=path, remedy="Record or copy it again"
        )
    _check_claim(path, data, max_pixels)


def _usable(image: Image | None, path: Path) -> Image:
    """What was decoded, if it was, as BGR."""
    if image is None:
        raise FrameError(
            "can't be decoded as an image",
            code="UNREADABLE_IMAGE",
            file=path,
            remedy="Record or copy it again",
        )
    if image.dtype not in (np.uint8, np.uint16):
        raise FrameError(
            f"has {image.dtype} pixels; 8 or 16 bit are read", code="UNREADABLE_IMAGE", file=path
        )
    return as_bgr(image, path)


def is_complete(data: bytes) -> bool | None:
    """Whether a PNG or JPEG is there to its end, with or without bytes behind it; None for other
    formats.

    A file whose inside is damaged but whose last bytes are an end is complete: it will not get
    better.
    """
    if data.startswith(JPEG):
        return data.endswith(b"\xff\xd9") or jpeg.end_of(data) is not None
    if data.startswith(_PNG):
        return data.endswith(_PNG_END) or claimed_size(data) is not None
    return None


def _check_complete(path: Path, data: bytes) -> None:
    # Decoders fill the missing part of a cut-off file with grey and only warn.
    if is_complete(data) is False:
        raise FrameError(
            "is cut off: its end marker is missing",
            code="TRUNCATED_IMAGE",
            file=path,
            remedy="Copy it again; was the disk full?",
        )
    if data.startswith(_TIFF) and (pages := tiff_pages(data)) > 1:
        raise FrameError(
            f"holds {pages} pages: which of them is this frame's picture is not known",
            code="UNREADABLE_IMAGE",
            file=path,
            remedy="Write a file a picture, for example with tiffsplit",
        )


def _check_claim(path: Path, data: bytes, max_pixels: int) -> None:
    """Refuse before decoding what is too large, and formats that are not read: their claims are not
    known.
    """
    size = claimed_size(data)
    if size is None:
        remedy = "PNG, JPEG, TIFF, BMP, WebP, PGM and PPM are read; record or copy it again"
        raise FrameError(
            "can't be decoded as an image", code="UNREADABLE_IMAGE", file=path, remedy=remedy
        )
    check_pixels(*size, path, max_pixels)


def check_pixels(width: int, height: int, path: Path, max_pixels: int) -> None:
    """FrameError when a picture of this size is more than may be decoded."""
    if width * height > max_pixels:
        problem = f"claims {width:,}×{height:,} pixels; at most {max_pixels:,} are decoded"
        remedy = "Is it damaged? If it is that large, raise source.max_pixels"
        raise FrameError(problem, code="IMAGE_TOO_LARGE", file=path, remedy=remedy)


def _decode(data: bytes) -> Image | None:
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None


def as_bgr(image: Image, path: Path) -> Image:
    """An image of 1 to 4 channels as BGR: grey is repeated, alpha dropped."""
    channels = 1 if image.ndim == 2 else image.shape[2]
    if channels in (3, 4):
        return np.ascontiguousarray(image[:, :, :3])
    if channels in (1, 2):
        grey = image if image.ndim == 2 else image[:, :, 0]
        return np.repeat(grey[:, :, None], 3, axis=2)
    raise FrameError(
        f"has {channels} channels; 1 to 4 are read", code="UNREADABLE_IMAGE", file=path
    )


def check_alike(left: Image, right: Image, left_name: str | Path, right_name: str) -> None:
    """FrameError when the two eyes differ in size or depth."""
    if left.shape != right.shape:
        (h0, w0), (h1, w1) = left.shape[:2], right.shape[:2]
        raise FrameError(
            f"is {w0}×{h0} but {right_name} is {w1}×{h1}",
            code="SIZE_MISMATCH",
            file=left_name,
            remedy="Record again",
        )
    if left.dtype != right.dtype:
        problem = f"has {left.dtype} pixels but {right_name} has {right.dtype}"
        raise FrameError(problem, code="SIZE_MISMATCH", file=left_name, remedy="Record again")


def split_in_two(image: Image, path: Path, packing: str = "left-right") -> tuple[Image, Image]:
    """Left and right eye of a side-by-side image.

    Parameters
    ----------
    image
        (H, 2 W, 3) picture.
    path
        For messages.
    packing
        "left-right" or "right-left"; other words name an arrangement that is not read.

    Raises
    ------
    FrameError
        When the eyes are not beside each other.
    """
    check_packing(packing, path)
    if image.shape[1] % 2:
        raise FrameError(
            f"is {image.shape[1]} px wide: two eyes need an even width",
            code="SIZE_MISMATCH",
            file=path,
            remedy="Is this a side-by-side image? Use --left and --right for two files",
        )
    half = image.shape[1] // 2
    halves = image[:, :half].copy(), image[:, half:].copy()
    return halves if packing == "left-right" else halves[::-1]


def check_packing(packing: str, path: Path) -> None:
    """FrameError when a file says that its eyes are not beside each other."""
    if packing not in ("left-right", "right-left"):
        raise FrameError(
            f"says that it holds {packing}",
            code="SIZE_MISMATCH",
            file=path,
            remedy=(
                "Only pictures with both eyes beside each other are read; ffmpeg's filter stereo3d"
                " makes them, or write each eye to a file of its own"
            ),
        )


def depth_of(images: Sequence[Image]) -> int:
    """Bits that the pixels of a recording use, 8 to 16, but for a few that are brighter (defects of
    the sensor).
    """
    for bits in range(15, 7, -1):
        bright = sum(int(np.count_nonzero(image >> bits)) for image in images)
        if bright > BRIGHT_SHARE * sum(image.size for image in images):
            return bits + 1
    return 8


def to_8_bit(left: Image, right: Image, depth: int | None = None) -> tuple[U8, U8]:
    """Bring the images of one pair to 8 bit by one common shift, so that brightnesses stay
    comparable.

    Parameters
    ----------
    left, right
        (H, W, 3) uint8 or uint16.
    depth
        Bits of the recording; None: as many as the pair uses. A 12-bit camera in 16-bit files keeps
        its contrast.
    """
    if left.dtype == np.uint8:
        return left, right
    shift = (depth or depth_of((left, right))) - 8
    one, other = (np.minimum(image >> shift, 255).astype(np.uint8) for image in (left, right))
    return one, other
