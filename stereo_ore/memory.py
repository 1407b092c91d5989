"""Memory of the process: what a frame frees is kept for the next one."""

from __future__ import annotations

import ctypes
import sys

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
"""Parameters of glibc's mallopt(3)."""
_KEPT_BYTES, _MOST_MMAP_BYTES = 256 << 20, 32 << 20
"""Memory kept for the next frame, and the largest piece that glibc allows to be kept."""


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
