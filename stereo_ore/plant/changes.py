"""Names below a folder that the operating system says have changed: a folder of a year's frames
need not be listed again for each new one.

What is said is a hint. A share says nothing of what other machines write, a system may watch no
more folders, and a lost word costs a later listing, never a frame.
"""

from __future__ import annotations

import logging
import os
from collections import defaultdict
from collections.abc import Container, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from watchfiles.main import FileChange

_log = logging.getLogger(__name__)

_WAIT_MS = 1
"""What was said arrives in a thread; so long is waited for it."""
_POLL_MS = 3_600_000
"""Where a system can't say anything, the library would look at each file so often itself."""


class Changes:
    """What the operating system says of the files below `root`, from the first `gather` on."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._said: Iterator[set[FileChange]] | None = None
        self._names: defaultdict[str, set[str]] = defaultdict(set)

    def gather(self) -> None:
        """Take note of what was said since this was called last."""
        for path in self._new():
            inner, _, name = os.path.relpath(path, self._root).replace(os.sep, "/").rpartition("/")
            self._names[inner].add(name)

    def take(self, folder: str) -> set[str]:
        """Names in a folder, relative to the root with ``/``, that were said to have changed and
        were not taken yet.
        """
        return self._names.pop(folder, set())

    def keep(self, folders: Container[str]) -> None:
        """Forget what was said of all other folders."""
        for folder in [folder for folder in self._names if folder not in folders]:
            del self._names[folder]

    def _new(self) -> list[str]:
        if self._said is None:
            self._said = self._watch()
        return [path for _, path in next(self._said, ())]

    def _watch(self) -> Iterator[set[FileChange]]:
        import watchfiles

        # It writes a line for each change.
        logging.getLogger("watchfiles").setLevel(logging.WARNING)
        try:
            yield from watchfiles.watch(
                self._root,
                watch_filter=None,
                debounce=_WAIT_MS,
                step=_WAIT_MS,
                rust_timeout=_WAIT_MS,
                yield_on_timeout=True,
                force_polling=False,
                poll_delay_ms=_POLL_MS,
            )
        except OSError as fault:
            _log.info("%s is listed for each new file: %s", self._root, fault)
