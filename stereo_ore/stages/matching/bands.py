"""Work on an image in bands of rows, which threads share."""

from __future__ import annotations

from collections.abc import Callable

from stereo_ore.threads import pool

BANDS = 4
"""As many as OpenCV's 3WAY works on; more of them would read more rows twice."""


def in_bands(height: int, halo: int, work: Callable[[slice, slice, slice], None]) -> None:
    """Call `work` for each band; the bands do not depend on the number of threads, so the result
    does not either.

    Parameters
    ----------
    height : int
        Rows of the image.
    halo : int
        Rows above and below that the windows of a band's rim look at.
    work : callable
        Called with the rows of the image to read, the part of those that is the band itself, and
        the band's rows.
    """

    def call(index: int) -> None:
        start, stop = height * index // BANDS, height * (index + 1) // BANDS
        first, last = max(start - halo, 0), min(stop + halo, height)
        if stop > start:
            work(slice(first, last), slice(start - first, stop - first), slice(start, stop))

    for done in [pool().submit(call, index) for index in range(BANDS)]:
        done.result()
