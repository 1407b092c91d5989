"""A recording and its calibration, as the options of a verb name them."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from stereo_ore.errors import SourceError

if TYPE_CHECKING:
    from stereo_ore.io.recordings import OpenedSource, Source
    from stereo_ore.types import StereoCalibration

_log = logging.getLogger(__name__)


def open_for_command(
    source: Path | None,
    left: Path | None,
    right: Path | None,
    topics: tuple[str | None, str | None],
    max_skew_ms: float,
) -> OpenedSource:
    """The recording that the options of a verb name."""
    from stereo_ore.io.recordings import BagOptions, open_source, open_two_files

    if left and right and source is None:
        return open_two_files(left, right, max_skew_ms)
    if source is None or left or right:
        raise typer.BadParameter("give either SOURCE or both --left and --right")
    match topics:
        case (None, None):
            return open_source(source, BagOptions(None, max_skew_ms))
        case (str(left_topic), str(right_topic)):
            return open_source(source, BagOptions((left_topic, right_topic), max_skew_ms))
    raise typer.BadParameter("give both --left-topic and --right-topic, or neither")


def calibration_for(
    recording: Source, calib: Path | None, image_size: tuple[int, int] | None = None
) -> StereoCalibration:
    """The calibration given or, without one, that of the recording."""
    from stereo_ore.io.calibration import load
    from stereo_ore.io.recordings import frame_size
    from stereo_ore.io.recordings.topics import check_images

    if calib:
        loaded = load(calib, image_size=image_size, recorded_size=frame_size(recording))
        if topics := getattr(recording, "topics", None):
            check_images(topics[0], loaded, calib)
        return loaded
    if recording.calibration is None:
        raise SourceError(
            "carries no calibration", file=recording.path, remedy="Give one with --calib"
        )
    _log.info("calibration: camera_info of the recording")
    return recording.calibration
