"""From no topics, or two names, to a source that delivers, and to its calibration."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from pathlib import Path

from stereo_ore.errors import SourceError
from stereo_ore.io.recordings.topics import check_images, choose_topics
from stereo_ore.plant.ros2.install import domain
from stereo_ore.plant.ros2.node import Node
from stereo_ore.plant.ros2.source import IMAGES, Topics, Wanted
from stereo_ore.types import StereoCalibration

_log = logging.getLogger(__name__)

WAIT_S = 30.0
"""A driver that does not deliver within this time is an error at the start."""
TOLD_AFTER_S = 2.0
POLL_S = 0.05
NOT_FOUND = (
    "Does the driver run, in this domain? One on another machine is found with"
    " ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET"
)
_SETTLED_S = 1.0
"""Topics become known one after the other: a choice is made when none has come for this time."""


def open_topics(wanted: Wanted) -> Topics:
    """Find the topics and wait for their first pair.

    Raises
    ------
    MissingExtraError, OutputError
        Without ROS 2.
    SourceError
        When no pair of topics is found, or does not deliver, in time.
    """
    node = Node("stereo_ore_frames", spins=True)
    try:
        source = Topics(node, wanted.topics or _find(node), wanted)
        left, right = source.topics
        _log.info("ROS 2: %s and %s (%s)", left, right, domain())
        _wait(lambda: source.delivers, f"no pair of {left} and {right}")
    except BaseException:
        node.close()
        raise
    return source


def calibration_of_topics(source: Topics) -> StereoCalibration:
    """The calibration in the topics' `camera_info`.

    Raises
    ------
    SourceError
        When there is none in time.
    CalibrationError
        When it is of no use.
    """
    left, right = source.topics
    remedy = "Give a calibration with --calib"
    _wait(
        lambda: source.find_infos() and source.infos.complete,
        f"no camera_info of {left} and {right}",
        remedy,
    )
    _log.info("calibration: camera_info of %s and %s", left, right)
    return source.infos.use()


def compare_with_topics(source: Topics, calibration: StereoCalibration, file: Path) -> None:
    """Say how the topics' calibration differs from the one that is given, where they have one.

    Raises
    ------
    CalibrationError
        When a calibration of raw images is given for rectified ones.
    """
    check_images(source.topics[0], calibration, file)
    if not source.find_infos():
        return
    end = time.monotonic() + _SETTLED_S
    while not source.infos.complete and time.monotonic() < end:
        time.sleep(POLL_S)
    if source.infos.complete and (words := source.infos.compare(calibration)):
        _log.warning("camera_info of %s %s: %s counts", source.topics[0], words, file)


def _find(node: Node) -> tuple[str, str]:
    """The topics of the one pair of eyes that drivers publish."""
    known: set[str] = set()
    changed_s = time.monotonic()

    def settled() -> bool:
        nonlocal known, changed_s
        found = {topic for topic, kind in node.topics().items() if kind in IMAGES}
        if found != known:
            known, changed_s = found, time.monotonic()
        return len(known) > 1 and time.monotonic() - changed_s > _SETTLED_S

    _wait(settled, f"no image topics ({domain()})")
    return choose_topics(known, None, "ROS 2")


def _wait(condition: Callable[[], object], problem: str, remedy: str | None = None) -> None:
    """SourceError when a condition does not come true in time."""
    began, told = time.monotonic(), False
    while not condition():
        waited_s = time.monotonic() - began
        if waited_s > WAIT_S:
            raise SourceError(
                f"{problem} within {WAIT_S:.0f} s", file="ROS 2", remedy=remedy or NOT_FOUND
            )
        if waited_s > TOLD_AFTER_S and not told:
            told = True
            _log.info("ROS 2: %s yet; waiting (%s)", problem, domain())
        time.sleep(POLL_S)
