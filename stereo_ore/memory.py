"""Memory of the process: what a frame frees is kept for the next one."""

from __future__ import annotations

import ctypes
import sys

_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8
"""Parameters of glibc's mallopt(3)."""
_KEPT_BYTES, _MOST_MMAP_BYTES, _ARENAS = 128 << 20, 32 << 20, 2
"""Memory kept for the next frame, the largest piece that glibc allows to be kept, and how many
pools threads share, each of which keeps its own."""


def keep_freed() -> None:
    """Let glibc keep freed memory; elsewhere nothing changes.

    Else it gives images back as soon as they are freed, and the pages of those of the next frame
    are made anew: a twelfth of a frame's time, and a third where Dask's nanny makes it give back
    all at once (MALLOC_TRIM_THRESHOLD_).
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        mallopt(_TRIM_THRESHOLD, _KEPT_BYTES)
        mallopt(_MMAP_THRESHOLD, _MOST_MMAP_BYTES)
        mallopt(_ARENA_MAX, _ARENAS)
