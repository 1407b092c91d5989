"""Messages as this program's types: images and calibrations of ROS 1, ROS 2 and Foxglove."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from stereo_ore.config.models import MAX_PIXELS
from stereo_ore.errors import FrameError
from stereo_ore.io.calibration import ros
from stereo_ore.io.calibration.formats import Hints
from stereo_ore.io.recordings.images import Image, as_bgr, check_pixels, decode_image
from stereo_ore.types import F64, StereoCalibration

FOXGLOVE = ("foxglove.", "foxglove_msgs/msg/")
"""Foxglove's messages in protobuf and in ROS."""
IMAGE_TYPES = (
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/CompressedImage",
    *(
        prefix + name
        for prefix in FOXGLOVE
        for name in ("RawImage", "CompressedImage", "CompressedVideo")
    ),
    "ffmpeg_image_transport_msgs/msg/FFMPEGPacket",
)
CAMERA_INFO = ("sensor_msgs/msg/CameraInfo", *(prefix + "CameraCalibration" for prefix in FOXGLOVE))
VIDEO_FORMATS = ("h264", "h265", "hevc", "avc", "x264", "x265")

_ENCODINGS: dict[str, tuple[str, int, int | None]] = {  # element type, channels, conversion to BGR
    "mono8": ("u1", 1, None),
    "8uc1": ("u1", 1, None),
    "mono16": ("u2", 1, None),
    "16uc1": ("u2", 1, None),
    "bgr8": ("u1", 3, None),
    "8uc3": ("u1", 3, None),
    "bgr16": ("u2", 3, None),
    "rgb8": ("u1", 3, cv2.COLOR_RGB2BGR),
    "rgb16": ("u2", 3, cv2.COLOR_RGB2BGR),
    "bgra8": ("u1", 4, None),
    "8uc4": ("u1", 4, None),
    "bgra16": ("u2", 4, None),
    "rgba8": ("u1", 4, cv2.COLOR_RGBA2BGR),
    "rgba16": ("u2", 4, cv2.COLOR_RGBA2BGR),
    # ROS names a Bayer pattern by its first row, OpenCV by the pixels around (1, 1): the two meet
    # crosswise.
    **{
        f"bayer_{pattern}{8 * size}": (f"u{size}", 1, conversion)
        for pattern, conversion in (
            ("rggb", cv2.COLOR_BayerBG2BGR),
            ("bggr", cv2.COLOR_BayerRG2BGR),
            ("gbrg", cv2.COLOR_BayerGR2BGR),
            ("grbg", cv2.COLOR_BayerGB2BGR),
        )
        for size in (1, 2)
    },
    "yuv422": ("u1", 2, cv2.COLOR_YUV2BGR_UYVY),
    "uyvy": ("u1", 2, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": ("u1", 2, cv2.COLOR_YUV2BGR_YUY2),
    "yuyv": ("u1", 2, cv2.COLOR_YUV2BGR_YUY2),
    "nv12": ("u1", 1, cv2.COLOR_YUV2BGR_NV12),
    "nv21": ("u1", 1, cv2.COLOR_YUV2BGR_NV21),
}
_HALF_MORE = ("nv12", "nv21")
"""Encodings whose colours stand in half as many rows again below the brightness."""


def image(message: Any, path: Path, max_pixels: int = MAX_PIXELS) -> Image:
    """The picture of an Image or CompressedImage: (H, W, 3) BGR, uint8 or uint16; `path` is for
    messages.

    Raises
    ------
    FrameError
        When the encoding is unknown or the data do not fit the size.
    """
    if hasattr(message, "format"):
        try:
            return decode_image(bytes(message.data), path, max_pixels)
        except FrameError as fault:
            problem = f"{fault.problem} (its format is said to be {message.format!r:.60})"
            raise FrameError(problem, code=fault.code, file=path, remedy=fault.remedy) from None
    known = _ENCODINGS.get(message.encoding.lower())
    if known is None:
        raise FrameError(
            f"image encoding {message.encoding!r} is not known",
            code="UNREADABLE_IMAGE",
            file=path,
            remedy=f"Known: {', '.join(_ENCODINGS)}",
        )
    check_pixels(int(message.width), int(message.height), path, max_pixels)
    kind, channels, conversion = known
    pixels = _unpack(message, np.dtype(kind), channels, path)
    return as_bgr(pixels if conversion is None else cv2.cvtColor(pixels, conversion), path)


def _unpack(message: Any, kind: np.dtype[Any], channels: int, path: Path) -> Image:
    """(H, W) or (H, W, channels) array of an Image, row padding removed."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    height += height // 2 if message.encoding.lower() in _HALF_MORE else 0
    row = width * channels * kind.itemsize
    data = np.frombuffer(bytes(message.data), np.uint8)
    if height < 1 or width < 1 or step < row or len(data) < height * step:
        raise FrameError(
            f"{width}×{height} {message.encoding} with a step of {step} does not fit its"
            f" {len(data)} bytes",
            code="TRUNCATED_IMAGE",
            file=path,
        )
    rows = np.ascontiguousarray(data[: height * step].reshape(height, step)[:, :row])
    pixels = rows.view(
        kind.newbyteorder(">" if getattr(message, "is_bigendian", False) else "<")
    ).astype(kind)
    return pixels.reshape((height, width) if channels == 1 else (height, width, channels))


def is_video(message: Any) -> bool:
    """Whether an image message holds a part of a video: its format or encoding says so."""
    said = getattr(message, "format", "") or getattr(message, "encoding", "")
    return any(name in said.lower() for name in VIDEO_FORMATS)


def stamp_ns(message: Any) -> int:
    """The header's or Foxglove's stamp [ns]; 0 where the driver left it empty."""
    stamp = message.header.stamp if hasattr(message, "header") else message.timestamp
    seconds, parts = (("sec", "nanosec"), ("seconds", "nanos"))[hasattr(stamp, "seconds")]
    return int(getattr(stamp, seconds)) * 1_000_000_000 + int(getattr(stamp, parts))


def calibration(left: Any, right: Any, rectified: bool, path: Path) -> StereoCalibration:
    """The calibration in the CameraInfo of both eyes, for rectified or raw images.

    Raises
    ------
    CalibrationError
        When the cameras were never calibrated or contradict each other.
    """
    hints = Hints(images="rectified" if rectified else "raw")
    return ros.combine_infos((path, path), _eye(left), _eye(right), hints)


def _eye(info: Any) -> dict[str, Any]:
    fields = {letter: matrix(info, letter) for letter in "KDRP"}
    size = {"width": float(info.width), "height": float(info.height)}
    window = {}
    if (roi := getattr(info, "roi", None)) is not None:
        window = {
            "roi": (roi.x_offset, roi.y_offset, roi.width, roi.height),
            "binning": (info.binning_x, info.binning_y),
        }
    return _resolved({**fields, **size, **window, "model": info.distortion_model or "plumb_bob"})


def _resolved(eye: dict[str, Any]) -> dict[str, Any]:
    """The eye with the size of the whole sensor, where a driver gives the window's although it has
    an offset.

    K is then the sensor's or the window's: whichever has its principal point in the image. Both or
    neither stay as they are, to be refused.
    """
    x, y, width, height = eye.get("roi", (0, 0, 0, 0))
    if not (x or y) or (eye["width"], eye["height"]) != (width, height):
        return eye
    cx, cy = eye["K"][2], eye["K"][5]
    of_sensor, of_window = (
        0 < cx - x < width and 0 < cy - y < height,
        0 < cx < width and 0 < cy < height,
    )
    if of_sensor and not of_window:
        return {**eye, "width": float(x + width), "height": float(y + height)}
    if of_window and not of_sensor:
        return {**eye, "roi": (0, 0, 0, 0)}
    return eye


def matrix(info: Any, letter: str) -> F64:
    """K, D, R or P of a CameraInfo, flat; ROS 1 names them by capitals, ROS 2 by small letters."""
    return np.asarray(
        getattr(info, letter if hasattr(info, letter) else letter.lower()), np.float64
    )
