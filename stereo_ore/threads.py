"""Threads that stages share work among: as many as OpenCV is given, and kept for the life of the
process.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import TypeVar

import cv2
import numpy as np
import numpy.typing as npt

CHUNK = 8192
"""Rows worked on at a time: bounds the memory of temporaries, and keeps them in the processor's
cache; with fewer of them threads mostly wait for Python's lock."""

Scalar = TypeVar("Scalar", bound=np.generic)
_Result = TypeVar("_Result")


def pool() -> ThreadPoolExecutor:
    """The threads to share work among; a task must not wait for another one.

    They are kept because OpenCV keeps some memory for every new thread that calls it, which a long
    run would feel.
    """
    return _pool(max(cv2.getNumThreads(), 1))


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="stage")


def map_rows(function: Callable[[slice], npt.NDArray[Scalar]], length: int) -> npt.NDArray[Scalar]:
    """What `function` gives for consecutive chunks of rows, one after the other, computed by all
    threads.

    A chunk's result doesn't depend on the others, so the number of threads changes nothing. Columns
    of the result lie in memory at a stretch.
    """
    start, *others = chunks(length)
    first = function(start)
    # Results go to their place at once: a list of them and their concatenation would take the
    # memory of two.
    out = np.empty((*first.shape[:0:-1], length), first.dtype).T
    out[start] = first

    def fill(rows: slice) -> None:
        out[rows] = function(rows)

    list(pool().map(fill, others))
    return out


def each_chunk(function: Callable[[slice], _Result], length: int) -> list[_Result]:
    """What `function` gives for consecutive chunks of rows, computed by all threads."""
    return list(pool().map(function, chunks(length)))


def chunks(length: int, size: int = CHUNK) -> Iterator[slice]:
    """Consecutive slices of at most `size` rows; one empty slice for no rows."""
    return (slice(start, min(start + size, length)) for start in range(0, max(length, 1), size))
