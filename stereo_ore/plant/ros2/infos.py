"""The ``camera_info`` that comes with the images of two topics."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from stereo_ore.errors import CalibrationError, FrameError
from stereo_ore.io.recordings import ros_messages
from stereo_ore.io.recordings.camera_infos import content
from stereo_ore.io.recordings.topics import is_rectified
from stereo_ore.stages.rectify import make_rectifier
from stereo_ore.types import StereoCalibration

_log = logging.getLogger(__name__)

KEPT = 64
"""Messages of an eye that are kept to be found by their stamp."""
MOST_DEPTH, MOST_CENTRE_PX = 0.005, 1.0
"""Calibrations that differ by more in the depth of a disparity (a share), or in where the image's
middle is, are told apart."""


class Infos:
    """Latest messages of both eyes; `topics` are those of the images."""

    def __init__(self, topics: tuple[str, str]) -> None:
        self.topics = topics
        self._latest: list[Any] = [None, None]
        self._stamped: tuple[deque[tuple[int, Any]], ...] = (
            deque(maxlen=KEPT),
            deque(maxlen=KEPT),
        )
        self._used: tuple[tuple[bytes, ...], ...] | None = None

    def add(self, eye: int, info: Any) -> None:
        """Note a message of the left (0) or right (1) eye; one of zeros only is none."""
        if np.any(ros_messages.matrix(info, "K")):
            self._latest[eye] = info
            self._stamped[eye].append((ros_messages.stamp_ns(info), info))

    @property
    def complete(self) -> bool:
        """Whether there is one of both eyes."""
        return all(info is not None for info in self._latest)

    def use(self) -> StereoCalibration:
        """The calibration in the latest messages; from now on others are told by `check`.

        Raises
        ------
        CalibrationError
            When it describes an impossible camera, or holds no baseline.
        """
        left, right = self._latest
        found = self._calibration()
        self._used = content(left), content(right)
        return found

    def check(self, stamps_ns: Iterable[int]) -> None:
        """FrameError when the messages of a frame are not those whose calibration is used."""
        if self._used is None:
            return
        for eye, (stamp_ns, used) in enumerate(zip(stamps_ns, self._used, strict=True)):
            if content(self._of(eye, stamp_ns)) != used:
                raise FrameError(
                    "camera_info is another one than at the start",
                    code="CALIBRATION_CHANGED",
                    file=self.topics[eye],
                    remedy="Start `serve` again: it goes on with the new one",
                )

    def compare(self, given: StereoCalibration) -> str | None:
        """How the calibration in the messages differs from the one that is used; None: it does
        not.
        """
        try:
            theirs = self._calibration()
        except CalibrationError as fault:
            return f"can't be used: {fault.problem}"
        if theirs.image_size != given.image_size:
            return f"is for images of {theirs.image_size}, not {given.image_size}"
        mine, other = make_rectifier(given).rig, make_rectifier(theirs).rig
        depth = other.fx * other.baseline_m / (mine.fx * mine.baseline_m) - 1
        shift = max(abs(other.cx - mine.cx), abs(other.cy - mine.cy))
        if abs(depth) <= MOST_DEPTH and shift <= MOST_CENTRE_PX:
            return None
        return f"gives depths {100 * depth:+.1f} % apart, the image's middle {shift:.1f} px"

    def _of(self, eye: int, stamp_ns: int) -> Any:
        """The message of a stamp, else the latest."""
        same = (info for stamp, info in self._stamped[eye] if stamp == stamp_ns)
        return next(same, self._latest[eye])

    def _calibration(self) -> StereoCalibration:
        left, right = self._latest
        try:
            return ros_messages.calibration(
                left, right, is_rectified(self.topics[0]), Path(self.topics[0])
            )
        except CalibrationError as fault:
            remedy = f"{fault.remedy or 'Its camera_info is of no use'}; or give --calib"
            raise CalibrationError(
                fault.problem, file=fault.file, key=fault.key, remedy=remedy
            ) from None
