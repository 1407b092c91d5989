"""A UVC camera that delivers both eyes side by side, as the ZED 2 does: always the newest picture,
no backlog.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol

from stereo_ore.errors import SourceError
from stereo_ore.io.recordings.images import Image, split_in_two, to_8_bit
from stereo_ore.plant.frames import LiveFrame, Position
from stereo_ore.types import StereoPair

_log = logging.getLogger(__name__)

RETRY_S = 1.0


class Capture(Protocol):
    """What is used of `cv2.VideoCapture`."""

    def read(self) -> tuple[bool, Any]:
        """The next picture; blocks until there is one. False when the camera is gone."""
        ...

    def release(self) -> None:
        """Give the camera back."""
        ...


class LiveCamera:
    """Grabs in a thread of its own; a camera that is unplugged is opened again once it is back.

    Parameters
    ----------
    open_capture
        Opens the camera; None when it is not there.
    name : str
        For messages.
    """

    def __init__(
        self, open_capture: Callable[[], Capture | None], name: str, *, retry_s: float = RETRY_S
    ) -> None:
        self.name = name
        self._open, self._retry_s = open_capture, retry_s
        self._changed = threading.Condition()
        self._newest: tuple[Image, int] | None = None
        self._skipped = 0
        self._connected = False

    def frames(self, start: Position, stop: threading.Event) -> Iterator[LiveFrame]:
        """The newest picture each time one is asked for."""
        thread = threading.Thread(target=self._grab, args=(stop,), daemon=True, name="camera")
        thread.start()
        index = start.index
        while not stop.is_set():
            with self._changed:
                self._changed.wait_for(lambda: self._newest, 0.2)
                newest, self._newest = self._newest, None
            if newest is not None:
                yield _frame(*newest, index)
                index += 1

    def state(self) -> str:
        """Whether it delivers, and how many pictures came faster than they could be processed."""
        condition = "delivers" if self._connected else "is not there; trying again"
        return f"{self.name} {condition}; {self._skipped} pictures passed over"

    def _grab(self, stop: threading.Event) -> None:
        while not stop.is_set():
            capture = self._open()
            if capture is not None:
                self._grab_from(capture, stop)
                capture.release()
            if self._connected and not stop.is_set():
                _log.warning("%s is gone; trying again", self.name)
            self._connected = False
            stop.wait(self._retry_s)

    def _grab_from(self, capture: Capture, stop: threading.Event) -> None:
        while not stop.is_set():
            found, image = capture.read()
            if not found:
                return
            self._connected = True
            with self._changed:
                self._skipped += self._newest is not None
                self._newest = image, time.time_ns()
                self._changed.notify()


def open_camera(number: int, image_size: tuple[int, int]) -> LiveCamera:
    """UVC camera `number`, asked for two eyes of `image_size` (width, height) beside each other."""
    import cv2

    def open_capture() -> Capture | None:
        capture = cv2.VideoCapture(number)
        if not capture.isOpened():
            return None
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, 2 * image_size[0])
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, image_size[1])
        return capture

    first = open_capture()
    if first is None:
        raise SourceError(
            f"camera {number} can't be opened",
            remedy="Is it plugged in, and free? Try another number",
        )
    first.release()
    return LiveCamera(open_capture, f"camera {number}")


def _frame(image: Image, taken_ns: int, index: int) -> LiveFrame:
    name = f"{taken_ns:019d}"

    def read() -> StereoPair:
        left, right = to_8_bit(*split_in_two(image, Path(name)))
        return StereoPair(
            left, right, name=name, index=index, stamp_ns=taken_ns, stamp_source="arrival"
        )

    return LiveFrame(name, index, taken_ns, (), read)
