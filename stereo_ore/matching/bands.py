"""Work on an image in bands of rows: they fit into the processor's cache, and threads share them."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import cv2

ROWS = 96


def in_bands(height: int, halo: int, work: Callable[[slice, slice, slice], None]) -> None:
    """Call `work` for each band; the bands do not depend on the number of threads, so the result does not either.

    Parameters
    ----------
    height : int
        Rows of the image.
    halo : int
        Rows above and below that the windows of a band's rim look at.
    work : callable
        Called with the rows of the image to read, the part of those that is the band itself, and the band's rows.
    """

    def call(start: int) -> None:
        stop = min(start + ROWS, height)
        first, last = max(start - halo, 0), min(stop + halo, height)
        work(slice(first, last), slice(start - first, stop - first), slice(start, stop))

    with ThreadPoolExecutor(max(cv2.getNumThreads(), 1)) as pool:
        for done in [pool.submit(call, start) for start in range(0, height, ROWS)]:
            done.result()
