"""A recording whose times are given by the user."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from stereo_ore.errors import ConfigError
from stereo_ore.io.recordings.base import Source, make_pair
from stereo_ore.io.recordings.stamps import Stamp
from stereo_ore.types import StereoCalibration, StereoPair


@dataclass(frozen=True)
class Retimed:
    """Another `Source` with other stamps.

    Attributes
    ----------
    source
        The recording.
    start_ns
        When its first frame was taken [ns since 1970, UTC]; None: as the recording says.
    period_ns
        Time from frame to frame; None: as the recording says.
    """

    source: Source
    start_ns: int | None
    period_ns: float | None

    @property
    def path(self) -> Path:
        """Where it was opened."""
        return self.source.path

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the frames, which stay."""
        return self.source.names

    @property
    def calibration(self) -> StereoCalibration | None:
        """The calibration that the recording carries."""
        return self.source.calibration

    @property
    def description(self) -> Mapping[str, Any]:
        """What the record of a run says about it."""
        return {**self.source.description, "start_ns": self.start_ns, "period_ns": self.period_ns}

    def files(self, index: int) -> tuple[Path, ...]:
        """The files that frame `index` is read from."""
        return self.source.files(index)

    def stamp(self, index: int) -> Stamp | None:
        """The stamp of frame `index`, counted from the first frame."""
        first = self.source.stamp(0)
        start_ns = self.start_ns if self.start_ns is not None else first and first.ns
        if start_ns is None:
            return None
        if self.period_ns is not None:
            return Stamp(start_ns + round(index * self.period_ns), "options")
        own = self.source.stamp(index)
        return Stamp(start_ns + own.ns - first.ns, "options") if own and first else None

    def read(self, index: int) -> StereoPair:
        """Frame `index` with its stamp."""
        pair = self.source.read(index)
        return make_pair(self, index, pair.left, pair.right)


def retime(source: Source, start_ns: int | None, fps: float | None) -> Source:
    """The same recording, begun at `start_ns` and with `fps` frames a second, each where it is
    given.
    """
    if start_ns is None and fps is None:
        return source
    return Retimed(source, start_ns, None if fps is None else 1e9 / fps)


def parse_time(text: str) -> int:
    """A time in ISO 8601 [ns since 1970, UTC]; without a time zone it is UTC.

    Raises
    ------
    ConfigError
        When it is no such time.
    """
    try:
        time = datetime.fromisoformat(text)
        since = (time if time.tzinfo else time.replace(tzinfo=UTC)) - datetime(
            1970, 1, 1, tzinfo=UTC
        )
    except (ValueError, OverflowError):
        raise ConfigError(
            f"{text!r} is no time",
            key="--start-time",
            remedy="Write it as 2026-03-31T14:05:00.250+02:00",
        ) from None
    return (since.days * 86_400 + since.seconds) * 10**9 + since.microseconds * 1000
