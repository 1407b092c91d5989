"""The empty screen: what the camera measures when no ore is there, and what differs from it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from stereo_ore.errors import ConfigError, FrameError
from stereo_ore.types import F32, Background, Disparity, Mask

LEAST_SIGMA_PX = 0.1
"""Noise of a disparity that few frames can't show."""

NEARER_SIGMA, NEARER_PX = 4.0, 0.75
"""What is nearer than the empty screen by more than these is not the screen."""

MOVED_PX = 0.75
"""A screen that is mostly this far from where it was: the camera or the screen has moved."""

SEEN_SHARE, LEAST_PIXELS = 0.2, 500
"""Share of the model's pixels that must be seen unchanged, and how many are needed to judge at
all."""

FARTHER_SHARE = 0.15
"""Nothing lies behind the empty screen: more pixels than this that do are a sign of another
view."""

_FORMAT = "stereo_ore/background/1"


def build_background(disparities: Sequence[Disparity]) -> Background:
    """The model from one or many frames of the empty screen: median and robust standard deviation
    of each pixel.

    Raises
    ------
    ConfigError
        When there is no frame, or frames differ in size.
    """
    shapes = {disparity.values.shape for disparity in disparities}
    if len(shapes) != 1:
        problem = f"frames of {len(shapes)} sizes" if shapes else "no frame"
        raise ConfigError(
            f"{problem} of the empty screen",
            key="background",
            remedy="Record the empty screen again",
        )
    stack = np.stack([disparity.values for disparity in disparities])
    median = _median(stack)
    sigma = np.maximum(1.4826 * _median(np.abs(stack - median)), np.float32(LEAST_SIGMA_PX))
    return Background(median, sigma.astype(np.float32), len(stack))


def _median(stack: F32) -> F32:
    """Median over axis 0 of what is finite (the lower one of two), NaN where at most half the
    frames have a value.
    """
    count = np.isfinite(stack).sum(0)
    middle = np.take_along_axis(np.sort(stack, 0), np.maximum(count - 1, 0)[None] // 2, 0)[0]
    return np.where(2 * count > len(stack), middle, np.float32(np.nan))


def shows_screen(background: Background, disparity: Disparity) -> Mask:
    """True where a frame shows the empty screen, or what lies behind it, (H, W).

    A pixel that was not measured, now or on the empty screen, says nothing and is False.
    """
    return np.asarray(disparity.values - background.disparity <= _tolerance(background))


def _tolerance(background: Background) -> F32:
    return np.asarray(
        np.maximum(np.float32(NEARER_SIGMA) * background.sigma, np.float32(NEARER_PX)), np.float32
    )


def compare(background: Background, disparity: Disparity) -> float:
    """Median shift [px] of what is not nearer than the empty screen.

    Raises
    ------
    ConfigError
        When the model is of another image size.
    FrameError
        When the camera or the screen has moved since.
    """
    check_size(background, *disparity.values.shape)
    shift = disparity.values - background.disparity
    both = np.isfinite(shift)
    tolerance = _tolerance(background)
    unchanged, farther = both & (np.abs(shift) <= tolerance), both & (shift < -tolerance)
    moved = float(np.median(shift[both])) if both.any() else float("nan")
    modelled = np.isfinite(background.disparity[disparity.region.slices]).sum()
    another = farther.sum() > FARTHER_SHARE * both.sum() or unchanged.sum() < SEEN_SHARE * modelled
    if modelled < LEAST_PIXELS or another or _slid(shift, unchanged):
        raise FrameError(
            f"{unchanged.sum():,} of {modelled:,} pixels are as on the empty screen (median shift"
            f" {moved:.2f} px)",
            code="CAMERA_MOVED",
            remedy="Calibrate the background again: camera or screen has moved",
        )
    return moved


def check_size(background: Background, height: int, width: int) -> None:
    """Refuse a model of another image size.

    Raises
    ------
    ConfigError
        Naming both sizes.
    """
    h, w = background.disparity.shape
    if (h, w) != (height, width):
        raise ConfigError(
            f"the empty screen is {w}×{h} px, the images are {width}×{height} px",
            key="background",
            remedy="Calibrate the background at this resolution",
        )


def _slid(shift: F32, unchanged: Mask) -> bool:
    """Whether even what looks unchanged is shifted as a whole."""
    return bool(abs(np.median(shift[unchanged])) > MOVED_PX / 2)


def save_background(background: Background, path: Path) -> None:
    """Write the model as a compressed NPZ; an interrupted write leaves no torn file."""
    part = path.with_name(path.name + ".part")
    with part.open("wb") as file:
        np.savez_compressed(
            file,
            format=np.array(_FORMAT),
            disparity=background.disparity,
            sigma=background.sigma,
            frames=np.array(background.frames),
        )
    os.replace(part, path)


def load_background(path: Path) -> Background:
    """Read a model.

    Raises
    ------
    ConfigError
        When the file is absent, torn, or something else.
    """
    try:
        with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
            if str(file["format"]) != _FORMAT:
                raise ConfigError(
                    f"has format {file['format']}, not {_FORMAT}", file=path, key="format"
                )
            return Background(
                np.asarray(file["disparity"], np.float32),
                np.asarray(file["sigma"], np.float32),
                int(file["frames"]),
            )
    except OSError as fault:
        raise ConfigError(
            f"can't be read: {fault.strerror or fault}", file=path, key="background"
        ) from None
    except ConfigError:
        raise
    except (
        Exception
    ) as fault:  # NumPy, the zip reader and its decompressors raise what they like on damaged files
        raise ConfigError(
            f"is not a model of the empty screen ({fault})",
            file=path,
            key="background",
            remedy="Make one with `stereo-ore calibrate background`",
        ) from None
