"""Image files as 8-bit BGR, or a typed error: a damaged file must never become half a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from stereo_ore.errors import FrameError
from stereo_ore.types import U8

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
MAX_PIXELS = 100_000_000
_END_MARKS = {b"\x89PNG": b"IEND", b"\xff\xd8": b"\xff\xd9"}


def is_image(path: Path) -> bool:
    """True for a file name that can hold an image, hidden files left out."""
    return path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".")


Image = npt.NDArray[Any]
"""(H, W, 3) BGR, uint8 or uint16."""


def read_image(path: Path) -> Image:
    """Decode an image as stored: (H, W, 3) BGR, uint8 or uint16; grey is repeated, alpha dropped.

    Raises
    ------
    FrameError
        When the file is missing, empty, cut off, too large, or no image.
    """
    data = _read_bytes(path)
    _check_complete(path, data)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None:
        raise FrameError(
            "can't be decoded as an image", code="UNREADABLE_IMAGE", file=path, remedy="Record or copy it again"
        )
    if image.shape[0] * image.shape[1] > MAX_PIXELS:
        raise FrameError(f"has {image.shape[0] * image.shape[1]:,} pixels", code="IMAGE_TOO_LARGE", file=path)
    if image.dtype not in (np.uint8, np.uint16):
        raise FrameError(f"has {image.dtype} pixels; 8 or 16 bit are read", code="UNREADABLE_IMAGE", file=path)
    return _as_bgr(path, image)


def _read_bytes(path: Path) -> bytes:
    try:
        data = path.read_bytes()
    except OSError as fault:
        raise FrameError(f"can't be read: {fault.strerror}", code="UNREADABLE_IMAGE", file=path) from None
    if not data:
        raise FrameError("is empty", code="UNREADABLE_IMAGE", file=path, remedy="Record or copy it again")
    return data


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


def _as_bgr(path: Path, image: Image) -> Image:
    channels = 1 if image.ndim == 2 else image.shape[2]
    if channels in (3, 4):
        return np.ascontiguousarray(image[:, :, :3])
    if channels in (1, 2):
        grey = image if image.ndim == 2 else image[:, :, 0]
        return np.repeat(grey[:, :, None], 3, axis=2)
    raise FrameError(f"has {channels} channels; 1 to 4 are read", code="UNREADABLE_IMAGE", file=path)


def to_8_bit(*images: Image) -> tuple[U8, ...]:
    """Bring the images of one pair to 8 bit by one common shift, so that brightnesses stay comparable.

    The shift is the smallest that fits the brightest value of all: a 12-bit camera in 16-bit files keeps its contrast.
    """
    top = max(int(image.max()) for image in images)
    shift = max(top.bit_length() - 8, 0)
    return tuple(image if image.dtype == np.uint8 else (image >> shift).astype(np.uint8) for image in images)
