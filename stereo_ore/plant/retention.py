"""What is kept of a run that goes on for a year: clouds, pictures and records up to an age or a
size, and files of the inbox that are done.
"""

from __future__ import annotations

import logging
import os
import re
import shutil
import stat
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from stereo_ore.errors import ConfigError
from stereo_ore.io import segments
from stereo_ore.plant.clock import SYSTEM, Clock

_log = logging.getLogger(__name__)

_KINDS = ("clouds", "overlays", "pictures", "records", "inbox")
UNITS_S = {"min": 60, "h": 3600, "d": 86_400}
UNITS_BYTES = {"MB": 10**6, "GB": 10**9, "TB": 10**12}
AMOUNT = re.compile(r"(\d+(?:\.\d+)?)(min|h|d|MB|GB|TB)", re.ASCII)
SWEEP_S = 60.0
"""Time between two sweeps: a sweep of a hundred thousand files computes 0.4 s."""


@dataclass(frozen=True)
class Limit:
    """How much of one kind of files is kept."""

    kind: str
    age_s: float | None = None
    size_bytes: float | None = None


class _File(NamedTuple):
    """A file, or a closed segment as one; of months of files nothing dearer is made."""

    path: Path | str
    written_ns: int
    size: int


def parse_limits(texts: Sequence[str]) -> list[Limit]:
    """Limits as the command line has them: ``clouds=7d``, ``overlays=30d,20GB``.

    Raises
    ------
    ConfigError
        Where one can't be understood.
    """
    return [_parse(text) for text in texts]


def _parse(text: str) -> Limit:
    kind, _, rest = text.partition("=")
    amounts = [AMOUNT.fullmatch(part.strip()) for part in rest.split(",")]
    if kind not in _KINDS or not all(amounts):
        remedy = f"One of {', '.join(_KINDS)}, then = and an age or a size: clouds=7d,20GB"
        raise ConfigError(f"{text!r} is no limit", key="--keep", remedy=remedy)
    age_s = size = None
    for match in amounts:
        assert match is not None, "checked above"
        number, unit = float(match[1]), match[2]
        if unit in UNITS_S:
            age_s = number * UNITS_S[unit]
        else:
            size = number * UNITS_BYTES[unit]
    return Limit(kind, age_s, size)


class Retention:
    """Removes what is beyond the limits, the oldest first.

    Parameters
    ----------
    folder : Path
        Folder of a live run.
    limits : sequence of Limit
        What is kept; a kind without a limit is kept whole.
    done : callable
        Paths of the inbox's files whose frames are recorded, with their modification times [ns] and
        sizes.
    """

    def __init__(
        self,
        folder: Path,
        limits: Sequence[Limit],
        done: Callable[[], Iterable[tuple[str, tuple[int, int]]]] = tuple,
        clock: Clock = SYSTEM,
    ) -> None:
        self._folder, self._limits, self._done, self._clock = folder, limits, done, clock
        self._next_s = 0.0
        self._told = False

    def sweep_when_due(self, at_once: bool = False) -> None:
        """Sweep once a minute or, when the disk is full, every tenth of that."""
        now = self._clock.monotonic()
        if now >= self._next_s - (0.9 * SWEEP_S if at_once else 0):
            self._next_s = now + SWEEP_S
            self.sweep()

    def sweep(self) -> int:
        """Remove what is beyond the limits; the number of files and segments removed."""
        return sum(self._remove(limit) for limit in self._limits)

    def _remove(self, limit: Limit) -> int:
        files = sorted(self._files(limit.kind), key=lambda file: file.written_ns)
        left = sum(file.size for file in files)
        oldest_ns = -1.0
        if limit.age_s is not None:
            oldest_ns = self._clock.time_ns() - 1e9 * limit.age_s
        count = 0
        for file in files:
            large = limit.size_bytes is not None and left > limit.size_bytes
            if not large and file.written_ns >= oldest_ns:
                break
            left -= file.size
            count += self._remove_one(Path(file.path))
        return count

    def _remove_one(self, path: Path) -> int:
        try:
            shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
        except FileNotFoundError:
            return 0
        except OSError as fault:
            if not self._told:
                _log.warning("%s is kept: it can't be removed: %s", path, fault.strerror)
            self._told = True
            return 0
        return 1

    def _files(self, kind: str) -> Iterator[_File]:
        if kind == "inbox":
            yield from (_File(path, look[0], look[1]) for path, look in list(self._done()))
        elif kind == "records":
            for part in segments.closed(self._folder):
                inside = list(_inside(part))
                written_ns = max((file.written_ns for file in inside), default=0)
                yield _File(part, written_ns, sum(file.size for file in inside))
        else:
            yield from _inside(self._folder / kind)


def _inside(folder: Path) -> Iterator[_File]:
    """Files right in a folder; hidden ones, which are being written, left out."""
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                seen = entry.stat(follow_symlinks=False)
                if stat.S_ISREG(seen.st_mode) and not entry.name.startswith("."):
                    yield _File(entry.path, seen.st_mtime_ns, seen.st_size)
    except OSError:
        return
