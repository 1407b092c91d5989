"""A folder that one process works on: another is told so, and leaves it alone."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from types import TracebackType
from typing import Self

from stereo_ore.errors import OutputError

try:
    import fcntl
except ImportError:  # Windows: folders can't be locked there
    fcntl = None  # type: ignore[assignment]

_REMEDY = "Stop that program, or name another folder"


class FolderLock:
    """Holds a folder, which must exist, from its making to `close`; nothing is written into it.

    The lock goes with the process, however that ends. Where the file system knows no locks nothing
    is held.

    Raises
    ------
    OutputError
        When another process, or another part of this one, holds it.
    """

    def __init__(self, folder: Path) -> None:
        self._handle: int | None = None
        if fcntl is None:
            return
        try:
            handle = os.open(folder, os.O_RDONLY)
        except OSError:
            return
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as fault:
            os.close(handle)
            if fault.errno in (errno.EWOULDBLOCK, errno.EACCES):
                problem = "is in use by another stereo-ore"
                raise OutputError(problem, file=folder, remedy=_REMEDY) from None
        else:
            self._handle = handle

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def __del__(self) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the folder."""
        handle, self._handle = getattr(self, "_handle", None), None
        if handle is not None:
            os.close(handle)
