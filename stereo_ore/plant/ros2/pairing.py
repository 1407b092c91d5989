"""Images of two topics as they come in, put together by their stamps.

A topic hands on its images in the order in which they were taken, so an image whose successor has
found its partner will find none any more, whatever the stamps say: a clock that is set back or
forth costs at most the frames of that moment.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

ROS_PATIENCE_S = 5.0
"""An image without a partner is given up after this time: one that was lost on the way comes again
only with the next."""
ROS_MOST_WAITING = 16
"""Images of an eye that wait for their partners: a bound on memory."""


@dataclass(frozen=True)
class TakenEyes:
    """An image: when its message says that it was taken, and when it was here.

    `number` is the publisher's own count of its messages, None where the middleware keeps none.
    """

    stamp_ns: int
    arrived_s: float
    message: Any
    number: int | None = None


@dataclass(frozen=True)
class Coming:
    """A frame of both eyes or of one; `lost` frames before it never came."""

    left: TakenEyes | None
    right: TakenEyes | None
    lost: int = 0

    @property
    def first(self) -> TakenEyes:
        """The left image, or the only one."""
        image = self.left or self.right
        assert image is not None, "a frame has an image"
        return image

    @property
    def complete(self) -> bool:
        """Whether it has both images."""
        return self.left is not None and self.right is not None

    @property
    def arrived_s(self) -> float:
        """When the first of its images was here, on the monotonic clock [s]."""
        return min(image.arrived_s for image in (self.left, self.right) if image)


class Pairer:
    """Pairs images whose stamps are at most `max_skew_ns` apart; an image is used once."""

    def __init__(self, max_skew_ns: int) -> None:
        self._max_skew_ns = max_skew_ns
        self._waiting: tuple[deque[TakenEyes], deque[TakenEyes]] = deque(), deque()
        self._numbers: list[int | None] = [None, None]
        self._missing = [0, 0]
        self._alone = [0, 0]

    def add(self, eye: int, image: TakenEyes) -> list[Coming]:
        """The frames that are decided by an image of the left (0) or right (1) eye, in order."""
        self._count(eye, image)
        mine, others = self._waiting[eye], self._waiting[1 - eye]
        partner = min(others, key=lambda o: abs(o.stamp_ns - image.stamp_ns), default=None)
        if partner is None or abs(partner.stamp_ns - image.stamp_ns) > self._max_skew_ns:
            mine.append(image)
            return [self._single(eye)] if len(mine) > ROS_MOST_WAITING else []
        found = []
        while mine:
            found.append(self._single(eye))
        while others[0] is not partner:
            found.append(self._single(1 - eye))
        others.popleft()
        found.sort(key=lambda coming: coming.arrived_s)
        both = (image, partner) if eye == 0 else (partner, image)
        return [*found, Coming(*both, lost=self._lost())]

    def overdue(self, now_s: float) -> list[Coming]:
        """Frames of one eye whose other one has not come in time."""
        found = [
            self._single(eye)
            for eye, waiting in enumerate(self._waiting)
            for image in tuple(waiting)
            if now_s - image.arrived_s > ROS_PATIENCE_S
        ]
        return sorted(found, key=lambda coming: coming.arrived_s)

    def _single(self, eye: int) -> Coming:
        image = self._waiting[eye].popleft()
        self._alone[eye] += 1
        return Coming(image, None) if eye == 0 else Coming(None, image)

    def _count(self, eye: int, image: TakenEyes) -> None:
        """Note how many messages of an eye have not come."""
        before = self._numbers[eye]
        if image.number is not None and before is not None:
            # A publisher that is started anew begins at 1.
            self._missing[eye] += max(0, image.number - before - 1)
        self._numbers[eye] = image.number

    def _lost(self) -> int:
        """Frames since the last pair of which neither image came."""
        # A missing left image is that of a right one that is alone, or of a frame that is gone.
        gone = (self._missing[eye] - self._alone[1 - eye] for eye in (0, 1))
        lost = max(0, min(gone))
        self._missing, self._alone = [0, 0], [0, 0]
        return lost


class Newest:
    """Frames that wait to be worked on: of the complete ones only the newest keeps its images."""

    def __init__(self) -> None:
        self._frames: list[tuple[Coming, bool]] = []

    def add(self, coming: Coming) -> None:
        """Put a frame behind the others; a complete one takes the place of the one before it."""
        if coming.complete:
            self._frames = [(bare(frame), True) for frame, _ in self._frames]
        self._frames.append((coming if coming.complete else bare(coming), False))

    def __bool__(self) -> bool:
        return bool(self._frames)

    @property
    def pairs(self) -> int:
        """How many complete frames wait."""
        return sum(frame.complete for frame, _ in self._frames)

    @property
    def last(self) -> Coming | None:
        """The newest complete frame."""
        return next((frame for frame, _ in reversed(self._frames) if frame.complete), None)

    def take(self) -> Iterator[tuple[Coming, bool]]:
        """All frames in order, each with whether a newer one is there."""
        frames, self._frames = self._frames, []
        for place, (coming, passed) in enumerate(frames, 1):
            yield coming, passed or (place < len(frames) and not coming.complete)


def bare(coming: Coming) -> Coming:
    """The frame without its images' pixels."""

    def without(image: TakenEyes | None) -> TakenEyes | None:
        return image and TakenEyes(image.stamp_ns, image.arrived_s, None, image.number)

    return Coming(without(coming.left), without(coming.right), coming.lost)
