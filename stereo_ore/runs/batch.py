"""Many frames: one after the other, or in worker processes; results come in order either way."""

from __future__ import annotations

import hashlib
import json
import os
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from multiprocessing import get_context, parent_process
from pathlib import Path

from stereo_ore.errors import FrameError
from stereo_ore.io.recordings import Source
from stereo_ore.pipeline import Context, fused_indices, process_frame
from stereo_ore.record import record, to_line
from stereo_ore.runs.ahead import ReadAhead
from stereo_ore.runs.folder import FrameLines
from stereo_ore.runs.frame_files import FrameFiles
from stereo_ore.runs.history import fingerprints
from stereo_ore.types import FrameResult, Site

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
WRITES_AHEAD = 2
"""Frames whose files may wait to be written: a bound on memory, for a frame's arrays wait with them."""


@dataclass(frozen=True)
class Job:
    """What a worker needs to turn a frame's index into lines and files; can be sent to another process."""

    source: Source
    context: Context
    files: FrameFiles
    strict: bool = False

    def __call__(self, index: int) -> FrameLines:
        """Process frame `index` and write its files; errors as those of `process` and `finish`."""
        return self.finish(self.process(index))

    def process(self, index: int) -> FrameResult:
        """Process frame `index`.

        Raises
        ------
        FrameError
            With `strict`, for a frame that failed.
        """
        result = process_frame(self.source, index, self.context)
        if self.strict and result.status == "failed":
            reason = result.reasons[-1]
            raise FrameError(f"frame {result.name} failed: {reason.detail}", code=reason.code)
        return result

    def finish(self, result: FrameResult) -> FrameLines:
        """Write the files of a frame and word its lines."""
        indices = fused_indices(self.source, result.index, self.context)
        lines = frame_lines(result, self.context.site, [file for i in indices for file in self.source.files(i)])
        self.files.write(result)
        return lines


def frame_lines(result: FrameResult, site: Site, inputs: Sequence[Path]) -> FrameLines:
    """Record, timing and inputs of a frame that was read from the files `inputs`."""
    stages = {name: round(ms, 3) for name, ms in result.stages_ms.items()}
    timing = {"frame": result.name, "stages_ms": stages, "total_ms": round(sum(stages.values()), 3)}
    files = {str(path): sha256(path) for path in inputs}
    hashes = {"frame": result.name, "files": files, "images": fingerprints(result)}
    return FrameLines(to_line(record(result, site)), json.dumps(timing), json.dumps(hashes))


def run(job: Job, indices: Sequence[int], workers: int = 1) -> Iterator[FrameLines]:
    """Lines of each frame, in order of `indices`; the same for any number of workers."""
    if workers == 1 or len(indices) < 2:
        yield from _overlapped(job, indices)
        return
    # Spawned, not forked: OpenCV's and BLAS's threads do not survive a fork.
    with _single_threaded(), ProcessPoolExecutor(workers, get_context("spawn"), _start_worker, (job,)) as pool:
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


@contextmanager
def _single_threaded() -> Iterator[None]:
    """BLAS and OpenMP of the processes that are started meanwhile have one thread: they read this when loaded."""
    earlier = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
    try:
        yield
    finally:
        for name, value in earlier.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


def _overlapped(job: Job, indices: Sequence[int]) -> Iterator[FrameLines]:
    """Frames one after the other; meanwhile one thread reads those to come and one writes those that are done."""
    order = (i for index in indices for i in fused_indices(job.source, index, job.context))
    with ReadAhead(job.source, order) as source, ThreadPoolExecutor(1, "write") as writer:
        ahead = replace(job, source=source)
        written: deque[Future[FrameLines]] = deque()
        for index in indices:
            try:
                result = ahead.process(index)
            except FrameError:
                yield from (future.result() for future in written)
                raise
            written.append(writer.submit(job.finish, result))
            if len(written) > WRITES_AHEAD:
                yield written.popleft().result()
        yield from (future.result() for future in written)


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
        return _sha256(path, path.stat().st_mtime_ns) if path.is_file() else None  # a pipe has no end
    except OSError:
        return None


@lru_cache(maxsize=64)
def _sha256(path: Path, _mtime_ns: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
