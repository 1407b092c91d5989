"""Decoders in C write to the process's standard error behind Python's back: here it is heard and
kept.
"""

from __future__ import annotations

import os
import re
import sys
import tempfile
import threading
from collections.abc import Callable
from typing import TypeVar

_Value = TypeVar("_Value")

_DECODER = re.compile(
    rb"libpng|JPEG|JFIF|Adobe color|Inconsistent"
    rb" progression|TIFF|OpenCV|grfmt_|loadsave|bitstrm|cap_\w+\.cpp"
    rb"|@ 0x[0-9a-f]+\]|packet of size"
)
_lock = threading.Lock()


def overheard(action: Callable[[], _Value]) -> tuple[_Value, bytes]:
    """The result of `action` and what decoders wrote to standard error meanwhile, which stays
    silent.

    libjpeg and libtiff have no other way to say that the picture they return is damaged (libtiff
    from OpenCV 5 on). Lines that another thread wrote in that time are passed on.
    """
    with _lock, tempfile.TemporaryFile() as ear:
        try:
            kept = os.dup(2)
        except OSError:  # a service without standard error: nothing to silence, nothing to hear
            return action(), b""
        if sys.stderr:
            sys.stderr.flush()
        try:
            os.dup2(ear.fileno(), 2)
            result = action()
        finally:
            os.dup2(kept, 2)
            os.close(kept)
        ear.seek(0)
        lines = ear.readlines()
    if others := [line for line in lines if not _DECODER.search(line) and line.strip()]:
        os.write(2, b"".join(others))
    return result, b"".join(line for line in lines if _DECODER.search(line))
