"""From a frame to its lines and files: the one way for recorded and for live frames."""

from __future__ import annotations

import hashlib
import json
import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

from stereo_ore.chain import Chain, no_counts
from stereo_ore.draw import overlay
from stereo_ore.errors import FrameError
from stereo_ore.record import record, to_line
from stereo_ore.runs.folder import FrameLines
from stereo_ore.runs.frame_files import FrameFiles
from stereo_ore.runs.history import fingerprints
from stereo_ore.types import FrameResult, Reason, Site, StampSource, StereoPair

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Driver:
    """Does frames one by one; can be sent to another process.

    `unattended`: a fault of this program is a failed frame and no end, since it must not stop the
    frames that follow, nor come back at each restart.
    """

    chain: Chain
    files: FrameFiles
    unattended: bool = False

    def detect(
        self,
        name: str,
        index: int,
        read: Callable[[], Sequence[StereoPair]],
        stamp: tuple[int, StampSource] | None = None,
    ) -> FrameResult:
        """Read and process a frame; what can't be read is a failed frame with a reason.

        Parameters
        ----------
        name, index, stamp
            What the record of a frame that can't be read calls it, and when it was taken.
        read : callable
            Gives the pairs that are measured as one frame, the frame's own first.
        """
        try:
            return self._detect(read)
        except FrameError as fault:
            reason = Reason(fault.code, str(fault))
        except Exception as fault:
            if not self.unattended:
                raise
            _log.exception("frame %s", name)
            reason = Reason("INTERNAL_ERROR", f"{type(fault).__name__}: {fault}")
        ns, origin = stamp or (None, None)
        failed = FrameResult(name, index, ns, "failed", (reason,), no_counts())
        return replace(failed, stamp_source=origin)

    def _detect(self, read: Callable[[], Sequence[StereoPair]]) -> FrameResult:
        start = time.perf_counter()
        pairs = read()
        read_ms = 1000 * (time.perf_counter() - start)
        result = self.chain(*pairs)
        return replace(result, stages_ms={"read": read_ms, **result.stages_ms})

    def finish(self, result: FrameResult, inputs: Sequence[Path]) -> FrameLines:
        """Write the files of a frame that was read from `inputs`, and word its lines."""
        lines = frame_lines(result, self.chain.site, inputs)
        self.files.write(result)
        return lines


def frame_lines(result: FrameResult, site: Site, inputs: Sequence[Path]) -> FrameLines:
    """Record, timing and inputs of a frame that was read from the files `inputs`."""
    stages = {name: round(ms, 3) for name, ms in result.stages_ms.items()}
    total_ms = round(sum(stages.values()), 3)
    timing = {"frame": result.name, "stages_ms": stages, "total_ms": total_ms}
    files = {str(path): sha256(path) for path in inputs}
    hashes = {"frame": result.name, "files": files, "images": fingerprints(result)}
    outlines = None if result.pair is None else overlay.outlines(result)
    lines = (to_line(record(result, site)), json.dumps(timing), json.dumps(hashes))
    return FrameLines(*lines, outlines)


def sha256(path: Path) -> str | None:
    """SHA-256 of a file; None when it can't be read.

    A video or bag that holds many frames is read once.
    """
    try:
        # Only of files: a pipe has no end.
        return _sha256(path, path.stat().st_mtime_ns) if path.is_file() else None
    except OSError:
        return None


@lru_cache(maxsize=64)
def _sha256(path: Path, _mtime_ns: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
