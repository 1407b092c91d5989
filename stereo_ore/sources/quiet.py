"""Decoders in C write to the process's standard error behind Python's back: here it is heard and kept."""

from __future__ import annotations

import os
import sys
import tempfile
import threading
from collections.abc import Callable
from typing import TypeVar

Value = TypeVar("Value")
_lock = threading.Lock()


def overheard(action: Callable[[], Value]) -> tuple[Value, bytes]:
    """The result of `action` and what was written to standard error meanwhile, which stays silent.

    libjpeg and libtiff have no other way to say that the picture they return is damaged (libtiff from OpenCV 5 on).
    """
    with _lock, tempfile.TemporaryFile() as ear:
        sys.stderr.flush()
        kept = os.dup(2)
        try:
            os.dup2(ear.fileno(), 2)
            result = action()
        finally:
            os.dup2(kept, 2)
            os.close(kept)
        ear.seek(0)
        return result, ear.read()
