"""Pictures as data URIs, small enough that a page holds many."""

from __future__ import annotations

import base64
from pathlib import Path

import cv2
import numpy as np

from stereo_ore.errors import FrameError
from stereo_ore.io.recordings.images import read_image
from stereo_ore.types import U8

OVERLAY_WIDTH, OVERLAY_QUALITY = 1280, 75
THUMBNAIL_WIDTH, THUMBNAIL_QUALITY = 176, 60


def overlay(path: Path) -> str | None:
    """A frame's picture, large."""
    return _jpeg(path, OVERLAY_WIDTH, OVERLAY_QUALITY)


def thumbnail(path: Path) -> str | None:
    """A frame's picture for the filmstrip."""
    return _jpeg(path, THUMBNAIL_WIDTH, THUMBNAIL_QUALITY)


def _jpeg(path: Path, width: int, quality: int) -> str | None:
    """None for a file that is damaged: the page then lacks a picture, and the records still
    count.
    """
    try:
        image = read_image(path)
    except FrameError:
        return None
    data = cv2.imencode(
        ".jpg", _shrink(np.asarray(image, np.uint8), width), [cv2.IMWRITE_JPEG_QUALITY, quality]
    )[1]
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()


def _shrink(image: U8, width: int) -> U8:
    if image.shape[1] <= width:
        return image
    height = round(image.shape[0] * width / image.shape[1])
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
