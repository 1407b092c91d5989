"""Many frames on many machines: a recording in chunks over a Dask cluster; results come in order.

Machines share a file system: workers read the recording and write each frame's clouds and pictures
themselves, only lines of text travel. The job waits for them as a file in the output folder, so a
worker that does not see the same files says so before it does any work.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import pickle
import socket
import threading
import time
import uuid
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from stereo_ore import memory
from stereo_ore.errors import ClusterError, MissingExtraError, StereoOreError
from stereo_ore.io.atomic import write_bytes
from stereo_ore.runs.batch import Job
from stereo_ore.runs.folder import FrameLines
from stereo_ore.runs.identity import versions

if TYPE_CHECKING:
    from distributed import Client, Future

_log = logging.getLogger(__name__)

CONNECT_S, WORKERS_S, NEWS_S = 20, 120, 30
"""How long to wait for the scheduler, for its first worker, and before asking whether there still
is one."""

PATIENCE_S = 10.0
"""A shared file system may show a new file this late on another machine."""

LARGEST_CHUNK = 16
"""Frames of a chunk at most: seconds of work, beside which Dask's few milliseconds a task are
nothing."""

CHUNKS_AHEAD = 4
"""Chunks a worker that are under way: a bound on memory, and on how long others wait for one that
is done again."""

RESUME = "The same command with --resume continues"


@dataclass(frozen=True)
class Envelope:
    """What a worker needs to find its job: the file, and the folder that relative paths start
    from.
    """

    file: Path
    folder: Path


@dataclass(frozen=True)
class Shipment:
    """A job as it lies in the output folder, with the versions that all workers must have."""

    job: Job
    versions: Mapping[str, str]


@dataclass(frozen=True)
class ChunkLines:
    """Lines of a chunk's frames, up to the one that ended the work."""

    lines: list[FrameLines]
    error: StereoOreError | None = None


def run_on_cluster(job: Job, indices: Sequence[int], address: str) -> Iterator[FrameLines]:
    """Lines of each frame, in order of `indices`, from the workers of the Dask scheduler at
    `address`.

    Chunks of a worker that is lost are done by others; a frame that is done twice gets the same
    bytes.

    Raises
    ------
    ClusterError
        When the scheduler can't be reached, no worker comes, or a worker sees other files or has
        other versions.
    StereoOreError
        What a worker met in writing its files, or with a strict job in a frame.
    """
    if not indices:
        return
    with _connect(address) as client, _shipped(job) as envelope, _loss_told():
        chunks = iter(split(indices, _wait_for_workers(client)))
        pending: deque[Future] = deque()
        while True:
            ahead = CHUNKS_AHEAD * max(len(client.nthreads()), 1)
            for chunk in itertools.islice(chunks, max(ahead - len(pending), 0)):
                pending.append(client.submit(_work, envelope, chunk, pure=False))
            if not pending:
                return
            done = _result(client, pending.popleft())
            yield from done.lines
            if done.error:
                raise done.error


def split(indices: Sequence[int], workers: int) -> list[tuple[int, ...]]:
    """Chunks of neighbouring frames, small enough that the last ones keep all workers busy."""
    size = max(1, min(LARGEST_CHUNK, len(indices) // (2 * CHUNKS_AHEAD * workers)))
    return [tuple(indices[start : start + size]) for start in range(0, len(indices), size)]


@contextlib.contextmanager
def _connect(address: str) -> Iterator[Client]:
    try:
        from distributed import Client
    except ImportError:
        raise MissingExtraError("distributed", "cluster") from None
    for chatty in ("distributed", "distributed.client", "tornado.application"):
        logging.getLogger(chatty).setLevel(
            logging.CRITICAL
        )  # what goes wrong is told once, by `_loss_told`
    try:
        client = Client(address, timeout=CONNECT_S, set_as_default=False, name="stereo-ore")
    except (OSError, ValueError, TypeError) as fault:
        problem = f"can't be reached: {str(fault) or type(fault).__name__}"
        raise ClusterError(
            problem, file=address, remedy="Is `dask scheduler` running there?"
        ) from None
    with client:
        yield client


@contextlib.contextmanager
def _shipped(job: Job) -> Iterator[Envelope]:
    """The job as a file in the output folder, as long as it is needed; what a killed run has left
    goes.
    """
    folder = job.driver.files.folder.resolve()
    for old in folder.glob(".job-*.pickle"):
        old.unlink(missing_ok=True)
    file = folder / f".job-{uuid.uuid4().hex}.pickle"
    write_bytes(file, pickle.dumps(Shipment(job, versions())))
    try:
        yield Envelope(file, Path.cwd())
    finally:
        file.unlink(missing_ok=True)


@contextlib.contextmanager
def _loss_told() -> Iterator[None]:
    """Word what Dask raises when workers or the scheduler are gone."""
    from distributed import CancelledError, KilledWorker

    try:
        yield
    except KilledWorker as fault:
        problem = f"a chunk of frames has cost {fault.allowed_failures + 1} workers"
        raise ClusterError(problem, remedy=f"Was their memory too small? {RESUME}") from None
    except (CancelledError, OSError):
        raise ClusterError("the connection to the scheduler is lost", remedy=RESUME) from None


def _wait_for_workers(client: Client) -> int:
    """Number of workers, once there is one."""
    if not client.nthreads():
        _log.warning("the cluster has no worker yet; waiting for %d s", WORKERS_S)
    with contextlib.suppress(TimeoutError):
        client.wait_for_workers(1, timeout=WORKERS_S)
    threads = client.nthreads()
    if not threads:
        remedy = f"Start some: dask worker {client.scheduler.address} --nthreads 1"
        raise ClusterError("has no worker", file=client.scheduler.address, remedy=remedy)
    _log.info("cluster with %d worker%s", len(threads), "s" * (len(threads) != 1))
    if max(threads.values()) > 1:
        _log.warning("workers use one thread each: start more of them instead, with --nthreads 1")
    return len(threads)


def _result(client: Client, future: Future) -> ChunkLines:
    while True:
        try:
            found: ChunkLines = future.result(timeout=NEWS_S)
        except TimeoutError:
            if future.status == "error":
                raise
            if not client.nthreads():
                _log.warning("the cluster has lost its workers; waiting for one")
        else:
            return found


_turn = threading.Lock()
"""A worker with several threads takes one chunk after the other: decoders and the current folder
are its process's."""


def _work(envelope: Envelope, indices: Sequence[int]) -> ChunkLines:
    """Do a chunk on a worker."""
    lines: list[FrameLines] = []
    here = (
        contextlib.chdir(envelope.folder) if envelope.folder.is_dir() else contextlib.nullcontext()
    )
    with _turn, here:
        job = _open(envelope)
        for index in indices:
            try:
                lines.append(job(index))
            except StereoOreError as error:
                return ChunkLines(lines, error)
    return ChunkLines(lines)


@lru_cache(maxsize=1)
def _open(envelope: Envelope) -> Job:
    """The job on a worker, read once a process, so that a video stays open from chunk to chunk."""
    import cv2

    shipment: Shipment = pickle.loads(_read(envelope.file))
    job = shipment.job
    if not job.source.path.exists():
        raise _differs("does not see the recording", job.source.path)
    mine = versions()
    if mine != shipment.versions:
        names = sorted(
            name
            for name in {*mine, *shipment.versions}
            if mine.get(name) != shipment.versions.get(name)
        )
        texts = (f"{name} {mine.get(name)}, not {shipment.versions.get(name)}" for name in names)
        remedy = "Install the same versions everywhere, so that results do not depend on the worker"
        raise ClusterError(
            f"worker on {socket.gethostname()} has {'; '.join(texts)}", remedy=remedy
        )
    cv2.setNumThreads(1)
    memory.keep_freed()
    return job


def _read(file: Path) -> bytes:
    end = time.monotonic() + PATIENCE_S
    while not file.exists() and time.monotonic() < end:
        time.sleep(0.2)
    try:
        return file.read_bytes()
    except OSError:
        raise _differs("does not see the output folder", file.parent) from None


def _differs(problem: str, path: Path) -> ClusterError:
    remedy = (
        "Recording and --out must lie on a file system that all workers share, under the same paths"
    )
    return ClusterError(f"worker on {socket.gethostname()} {problem}", file=path, remedy=remedy)
