"""What verbs have in common that read from ROS 2 or publish there."""

from __future__ import annotations

import logging
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from stereo_ore.chain import Chain
    from stereo_ore.plant.frames import LiveSource
    from stereo_ore.plant.ros2.view import View
    from stereo_ore.plant.sinks.base import TargetSink
    from stereo_ore.plant.sinks.settings import SinksSettings
    from stereo_ore.types import StereoCalibration

_log = logging.getLogger(__name__)

Ros2Out = Annotated[
    bool,
    typer.Option(
        "--ros2-out", help="Publish cloud, targets, lumps and overlay as topics of ROS 2."
    ),
]


def prefer_sourced() -> None:
    """Begin anew where libraries of the extra would take the place of a sourced ROS 2's own."""
    from stereo_ore.plant.ros2.install import cleaned_environment

    if (environment := cleaned_environment()) is not None:
        _log.debug("beginning anew with the sourced ROS 2's libraries")
        os.execve(sys.executable, sys.orig_argv, environment)


def open_live(
    topics: tuple[str | None, str | None],
    max_skew_ms: float,
    calib: Path | None,
    size: tuple[int, int] | None,
    max_pixels: int,
) -> tuple[LiveSource, StereoCalibration]:
    """Frames of a driver's topics, and their calibration: the one given, else that of the topics.

    Raises
    ------
    typer.BadParameter
        For one topic of two.
    StereoOreError
        As `open_topics` and `calibration_of`.
    """
    from stereo_ore.io.calibration import load
    from stereo_ore.plant.ros2 import opening
    from stereo_ore.plant.ros2.source import Wanted

    prefer_sourced()
    match topics:
        case (None, None):
            named = None
        case (str(left), str(right)):
            named = left, right
        case _:
            raise typer.BadParameter("give both --left-topic and --right-topic, or neither")
    source = opening.open_topics(Wanted(named, max_skew_ms, max_pixels))
    if calib is None:
        return source, opening.calibration_of_topics(source)
    calibration = load(calib, image_size=size, recorded_size=source.size)
    opening.compare_with_topics(source, calibration, calib)
    return source, calibration


def topics_out(settings: SinksSettings, view: View | None) -> list[TargetSink]:
    """The sinks that publish a run as topics, of ROS 2 and for Foxglove, as far as wanted.

    Raises
    ------
    StereoOreError
        Without ROS 2, or without the geometry of the images.
    """
    from stereo_ore.errors import OutputError

    found: list[TargetSink] = []
    if settings.ros2 is not None:
        prefer_sourced()
        from stereo_ore.plant.ros2.install import require

        require()
    if settings.ros2 is None and settings.foxglove is None:
        return found
    if view is None:
        raise OutputError("the run has kept no calibration", remedy="Repeat the run")
    if settings.ros2 is not None:
        from stereo_ore.plant.ros2.sink import Ros2Sink

        found.append(Ros2Sink(settings.ros2, view))
    if settings.foxglove is not None:
        from stereo_ore.io.results import Results
        from stereo_ore.plant.sinks.foxglove import FoxgloveSink

        there = settings.foxglove.host, settings.foxglove.port
        found.append(FoxgloveSink(*there, Results(view.folder), view.T_arm_camera))
    return found


def live_view(out: Path, chain: Chain, valid_for_s: float, frame_id: str) -> View:
    """What topics show of a live run; `frame_id` is what a driver calls the left camera, if one
    does.
    """
    from stereo_ore.plant.ros2.view import CAMERA_FRAME, View

    arm, camera = chain.site.T_arm_camera, chain.calibration.camera
    return View(out, chain.rig, arm, camera, valid_for_s, frame_id or CAMERA_FRAME)
