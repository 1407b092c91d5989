"""Many frames: one after the other, or in worker processes; results come in order either way."""

from __future__ import annotations

import hashlib
import json
import os
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from multiprocessing import get_context, parent_process
from pathlib import Path

from stereo_ore.errors import FrameError
from stereo_ore.pipeline import Context, fused_indices, process_frame
from stereo_ore.record import record, to_line
from stereo_ore.sinks.frame_files import FrameFiles
from stereo_ore.sinks.run_folder import FrameLines
from stereo_ore.sources import Source
from stereo_ore.types import FrameResult, Site


@dataclass(frozen=True)
class Job:
    """What a worker needs to turn a frame's index into lines and files; can be sent to another process."""

    source: Source
    context: Context
    files: FrameFiles
    strict: bool = False

    def __call__(self, index: int) -> FrameLines:
        """Process frame `index` and write its files.

        Raises
        ------
        FrameError
            With `strict`, for a frame that failed.
        """
        result = process_frame(self.source, index, self.context)
        if self.strict and result.status == "failed":
            reason = result.reasons[-1]
            raise FrameError(f"frame {result.name} failed: {reason.detail}", code=reason.code)
        indices = fused_indices(self.source, index, self.context)
        lines = frame_lines(result, self.context.site, [file for i in indices for file in self.source.files(i)])
        self.files.write(result)
        return lines


def frame_lines(result: FrameResult, site: Site, inputs: Sequence[Path]) -> FrameLines:
    """Record, timing and inputs of a frame that was read from the files `inputs`."""
    stages = {name: round(ms, 3) for name, ms in result.stages_ms.items()}
    timing = {"frame": result.name, "stages_ms": stages, "total_ms": round(sum(stages.values()), 3)}
    hashes = {"frame": result.name, "files": {str(path): sha256(path) for path in inputs}}
    return FrameLines(to_line(record(result, site)), json.dumps(timing), json.dumps(hashes))


def run(job: Job, indices: Sequence[int], workers: int = 1) -> Iterator[FrameLines]:
    """Lines of each frame, in order of `indices`; the same for any number of workers."""
    if workers == 1 or len(indices) < 2:
        yield from map(job, indices)
        return
    # Spawned, not forked: OpenCV's and BLAS's threads do not survive a fork.
    with ProcessPoolExecutor(workers, get_context("spawn"), _start_worker, (job,)) as pool:
        pending: deque[Future[FrameLines]] = deque()
        try:
            for index in indices:
                pending.append(pool.submit(_work, index))
                # A bound on the queue bounds memory when a frame takes longer than those after it.
                if len(pending) > 2 * workers:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


_job: Job | None = None


def _start_worker(job: Job) -> None:
    import cv2

    global _job
    _job = job
    cv2.setNumThreads(1)
    # A pool's worker waits for work for ever; when the run was killed nobody else tells it to go.
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    assert parent is not None, "a worker has a parent"
    parent.join()
    os._exit(1)


def _work(index: int) -> FrameLines:
    assert _job is not None, "the pool's initialiser ran"
    return _job(index)


def sha256(path: Path) -> str | None:
    """SHA-256 of a file; None when it can't be read. A video or bag that holds many frames is read once."""
    try:
        return _sha256(path, path.stat().st_mtime_ns)
    except OSError:
        return None


@lru_cache(maxsize=64)
def _sha256(path: Path, _mtime_ns: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
