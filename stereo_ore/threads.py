"""Threads that stages share work among: as many as OpenCV is given, and kept for the life of the process."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import cache

import cv2


def pool() -> ThreadPoolExecutor:
    """The threads to share work among; a task must not wait for another one.

    They are kept because OpenCV keeps some memory for every new thread that calls it, which a long run would feel.
    """
    return _pool(max(cv2.getNumThreads(), 1))


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="stage")
