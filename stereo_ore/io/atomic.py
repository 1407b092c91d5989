"""Files that are whole or not there: written under a temporary name, then renamed."""

from __future__ import annotations

import os
import uuid
from collections.abc import Callable, Iterable
from pathlib import Path

from stereo_ore.errors import OutputError

_REMEDY = "Check path, space and permissions"


def write_bytes(path: Path, data: bytes) -> None:
    """Write `data` as `path` in one step; errors as those of `in_one_step`."""
    in_one_step(path, lambda temporary: temporary.write_bytes(data))


def write_lines(path: Path, lines: Iterable[str]) -> None:
    """Write UTF-8 lines, ends included, as `path` in one step, without holding them all in
    memory.
    """

    def write(temporary: Path) -> None:
        with temporary.open("w", encoding="utf-8", newline="") as file:
            file.writelines(lines)

    in_one_step(path, write)


def in_one_step(path: Path, write: Callable[[Path], object]) -> None:
    """Let `write` make a file under a temporary name, then give it the name `path`.

    Raises
    ------
    OutputError
        When the folder is not writable or the disk is full; nothing is then left under the final
        name.
    """
    # A name of its own: a worker that was given up for lost may still write the same file.
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write(temporary)
        os.replace(temporary, path)
    except OSError as fault:
        temporary.unlink(missing_ok=True) if temporary.parent.is_dir() else None
        raise OutputError(
            f"can't be written: {fault.strerror}", file=path, remedy=_REMEDY
        ) from None


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text as `path` in one step; what names of files have that is no UTF-8 becomes
    escapes.
    """
    write_bytes(path, text.encode(errors="backslashreplace"))


def write_bytes_where_new(path: Path, data: bytes) -> None:
    """Write `data` as `write_bytes` does, unless the file holds just that."""
    if not (path.is_file() and path.read_bytes() == data):
        write_bytes(path, data)


def guarded(path: Path, action: Callable[[], object]) -> None:
    """Do `action` on `path`; an operating system's refusal becomes an `OutputError`."""
    try:
        action()
    except OSError as fault:
        raise OutputError(
            f"can't be written: {fault.strerror}", file=path, remedy=_REMEDY
        ) from None


def remove_leftovers(folder: Path) -> None:
    """Remove what processes that were killed in `write_bytes` have left in a folder."""
    for file in folder.glob(".*.tmp"):
        file.unlink(missing_ok=True)


def make_folder(path: Path) -> None:
    """Make a folder, before work whose results go there."""
    guarded(path, lambda: path.mkdir(parents=True, exist_ok=True))
