"""Many frames: one after the other, or in worker processes; results come in order either way."""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from multiprocessing import get_context, parent_process

from stereo_ore import memory
from stereo_ore.errors import FrameError
from stereo_ore.io.recordings import Source
from stereo_ore.runs.ahead import ReadAhead
from stereo_ore.runs.driver import Driver
from stereo_ore.runs.folder import FrameLines
from stereo_ore.types import FrameResult

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
WRITES_AHEAD = 2
"""Frames whose files may wait to be written: a bound on memory, for a frame's arrays wait with
them."""


@dataclass(frozen=True)
class Job:
    """What a worker needs to turn a frame's index into lines and files; can be sent to another
    process.
    """

    source: Source
    driver: Driver
    strict: bool = False

    def __call__(self, index: int) -> FrameLines:
        """Process frame `index` and write its files; errors as those of `detect` and `finish`."""
        return self.finish(self.detect(index))

    def fused(self, index: int) -> range:
        """The frames that are measured as one with frame `index`: itself, or as many as
        `matching.fuse` says.
        """
        return range(
            index, min(index + self.driver.chain.config.matching.fuse, len(self.source.names))
        )

    def detect(self, index: int) -> FrameResult:
        """Process frame `index`.

        Raises
        ------
        FrameError
            With `strict`, for a frame that failed.
        """
        name, indices = self.source.names[index], self.fused(index)
        stamp = self.source.stamp(index)
        result = self.driver.detect(
            name, index, lambda: [self.source.read(i) for i in indices], stamp
        )
        if self.strict and result.status == "failed":
            reason = result.reasons[-1]
            raise FrameError(f"frame {result.name} failed: {reason.detail}", code=reason.code)
        return result

    def finish(self, result: FrameResult) -> FrameLines:
        """Write the files of a frame and word its lines."""
        inputs = [file for i in self.fused(result.index) for file in self.source.files(i)]
        return self.driver.finish(result, inputs)


def run_in_batches(job: Job, indices: Sequence[int], workers: int = 1) -> Iterator[FrameLines]:
    """Lines of each frame, in order of `indices`; the same for any number of workers."""
    if workers == 1 or len(indices) < 2:
        yield from _overlapped(job, indices)
        return
    # Spawned, not forked: OpenCV's and BLAS's threads do not survive a fork.
    with (
        _single_threaded(),
        ProcessPoolExecutor(workers, get_context("spawn"), _start_worker, (job,)) as pool,
    ):
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
    """BLAS and OpenMP of the processes that are started meanwhile have one thread: they read this
    when loaded.
    """
    earlier = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
    try:
        yield
    finally:
        for name, value in earlier.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


def _overlapped(job: Job, indices: Sequence[int]) -> Iterator[FrameLines]:
    """Frames one after the other; meanwhile one thread reads those to come and one writes those
    that are done.
    """
    order = (i for index in indices for i in job.fused(index))
    with ReadAhead(job.source, order) as source, ThreadPoolExecutor(1, "write") as writer:
        ahead = replace(job, source=source)
        written: deque[Future[FrameLines]] = deque()
        for index in indices:
            try:
                result = ahead.detect(index)
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
    memory.keep_freed()
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
