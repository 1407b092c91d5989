"""Image files as BGR, or a typed error: a damaged file must never become half a picture."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from stereo_ore.config.models import MAX_PIXELS
from stereo_ore.errors import FrameError
from stereo_ore.io.recordings.image_header import claimed_size
from stereo_ore.io.recordings.quiet import overheard
from stereo_ore.threads import pool
from stereo_ore.types import U8

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
BYTES_PER_PIXEL, HEADER_BYTES = 8, 1_000_000
"""Four channels of 16 bit, uncompressed, and what else a file may hold."""
MOST_SCANS = 64
"""Scans of a progressive JPEG: decoders go through the whole picture for each, whatever little it holds."""
_END_MARKS = {b"\x89PNG": b"IEND", b"\xff\xd8": b"\xff\xd9"}
_DAMAGE = re.compile(rb"Corrupt JPEG|Premature end of JPEG|Inconsistent progression|libpng error|TIFF_Error")


def is_image(path: Path) -> bool:
    """True for a file name that can hold an image, hidden files left out."""
    return path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".")


Image = npt.NDArray[Any]
"""(H, W, 3) BGR, uint8 or uint16."""


def read_image(path: Path, max_pixels: int = MAX_PIXELS) -> Image:
    """Decode an image file as stored: (H, W, 3) BGR, uint8 or uint16; grey is repeated, alpha dropped.

    Raises
    ------
    FrameError
        When the file is missing, empty, cut off, damaged, too large, or no image.
    """
    return decode_image(_bytes_of(path, max_pixels), path, max_pixels)


def read_both(left: Path, right: Path, max_pixels: int = MAX_PIXELS) -> tuple[Image, Image]:
    """Both eyes' files as `read_image`, decoded side by side, which takes half the time."""
    files = (left, _bytes_of(left, max_pixels)), (right, _bytes_of(right, max_pixels))
    for path, data in files:
        _check(path, data, max_pixels)
    images, complaints = overheard(lambda: list(pool().map(_decode, [data for _, data in files])))
    if complaints or any(image is None for image in images):
        # One after the other, to hear whose they are.
        images = [decode_image(data, path, max_pixels) for path, data in files]
    one, other = (_usable(image, path) for image, (path, _) in zip(images, files, strict=True))
    return one, other


def _bytes_of(path: Path, max_pixels: int) -> bytes:
    most = BYTES_PER_PIXEL * max_pixels + HEADER_BYTES
    try:
        if not path.is_file() and path.exists():
            raise FrameError("can't be read: it is no file", code="UNREADABLE_IMAGE", file=path)
        with path.open("rb") as file:
            data = file.read(most + 1)
    except OSError as fault:
        raise FrameError(f"can't be read: {fault.strerror}", code="UNREADABLE_IMAGE", file=path) from None
    if len(data) > most:
        problem = f"has more than {most:,} bytes, which no image of {max_pixels:,} pixels has"
        raise FrameError(problem, code="IMAGE_TOO_LARGE", file=path, remedy="Record or copy it again")
    return data


def decode_image(data: bytes, path: Path, max_pixels: int = MAX_PIXELS) -> Image:
    """Decode the bytes of an image file; as `read_image`. `path` is for messages."""
    _check(path, data, max_pixels)
    image, complaints = overheard(lambda: _decode(data))
    return _usable(None if _DAMAGE.search(complaints) else image, path)


def _check(path: Path, data: bytes, max_pixels: int) -> None:
    """Refuse what need not be decoded to be known as damaged or too large."""
    if not data:
        raise FrameError("is empty", code="UNREADABLE_IMAGE", file=path, remedy="Record or copy it again")
    _check_complete(path, data)
    if data.startswith(b"\xff\xd8") and (scans := data.count(b"\xff\xda")) > MOST_SCANS:
        problem = f"has {scans:,} scans; a camera's JPEG has at most {MOST_SCANS}"
        raise FrameError(problem, code="UNREADABLE_IMAGE", file=path, remedy="Record or copy it again")
    _check_claim(path, data, max_pixels)


def _usable(image: Image | None, path: Path) -> Image:
    """What was decoded, if it was, as BGR."""
    if image is None:
        raise FrameError(
            "can't be decoded as an image", code="UNREADABLE_IMAGE", file=path, remedy="Record or copy it again"
        )
    if image.dtype not in (np.uint8, np.uint16):
        raise FrameError(f"has {image.dtype} pixels; 8 or 16 bit are read", code="UNREADABLE_IMAGE", file=path)
    return as_bgr(image, path)


def _check_complete(path: Path, data: bytes) -> None:
    # Decoders fill the missing part of a cut-off file with grey and only warn.
    for magic, mark in _END_MARKS.items():
        if data.startswith(magic) and mark not in data[-1024:]:
            raise FrameError(
                "is cut off: its end marker is missing",
                code="TRUNCATED_IMAGE",
                file=path,
                remedy="Copy it again; was the disk full?",
            )


def _check_claim(path: Path, data: bytes, max_pixels: int) -> None:
    """Refuse before decoding what is too large, and formats that are not read: their claims are not known."""
    size = claimed_size(data)
    if size is None:
        remedy = "PNG, JPEG, TIFF and BMP are read; record or copy it again"
        raise FrameError("can't be decoded as an image", code="UNREADABLE_IMAGE", file=path, remedy=remedy)
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
    raise FrameError(f"has {channels} channels; 1 to 4 are read", code="UNREADABLE_IMAGE", file=path)


def check_alike(left: Image, right: Image, left_name: str | Path, right_name: str) -> None:
    """FrameError when the two eyes differ in size or depth."""
    if left.shape != right.shape:
        (h0, w0), (h1, w1) = left.shape[:2], right.shape[:2]
        raise FrameError(
            f"is {w0}×{h0} but {right_name} is {w1}×{h1}", code="SIZE_MISMATCH", file=left_name, remedy="Record again"
        )
    if left.dtype != right.dtype:
        problem = f"has {left.dtype} pixels but {right_name} has {right.dtype}"
        raise FrameError(problem, code="SIZE_MISMATCH", file=left_name, remedy="Record again")


def split_in_two(image: Image, path: Path) -> tuple[Image, Image]:
    """Left and right half of a side-by-side image."""
    if image.shape[1] % 2:
        raise FrameError(
            f"is {image.shape[1]} px wide: two eyes need an even width",
            code="SIZE_MISMATCH",
            file=path,
            remedy="Is this a side-by-side image? Use --left and --right for two files",
        )
    half = image.shape[1] // 2
    return image[:, :half].copy(), image[:, half:].copy()


def to_8_bit(left: Image, right: Image) -> tuple[U8, U8]:
    """Bring the images of one pair to 8 bit by one common shift, so that brightnesses stay comparable.

    The shift is the smallest that fits the brightest value of both: a 12-bit camera in 16-bit files keeps its contrast.
    """
    shift = max(int(max(left.max(), right.max())).bit_length() - 8, 0)
    return (left >> shift).astype(np.uint8), (right >> shift).astype(np.uint8)
