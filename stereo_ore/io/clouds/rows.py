"""Text bodies of PLY and PCD: numbers between blanks, whatever the lines."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import IO

import numpy as np

from stereo_ore.errors import CloudError
from stereo_ore.io.clouds.numbers import column
from stereo_ore.io.clouds.records import Records, from_columns

REMARKS = (b"comment ", b"obj_info ")


def parse_rows(file: IO[bytes], dtype: np.dtype[np.void], count: int, path: Path) -> Records:
    """Exactly `count` points from the file's position; blank lines and breaks within a point mean
    nothing.
    """
    if count == 0 or not dtype.names:
        return np.empty(count if dtype.names else 0, dtype)
    start = file.tell()
    quick = _quick(file, dtype, count)
    if quick is not None:
        return quick
    file.seek(start)
    wanted = count * len(dtype.names)
    words = list(islice(_words(file), wanted))
    if len(words) < wanted:
        rows = len(words) // len(dtype.names)
        problem = f"has {rows:,} rows of {len(dtype.names)} numbers; the header says {count:,}"
        raise CloudError(problem, file=path, remedy="The file is cut off; export it again")
    names = dtype.names
    return from_columns(
        {
            name: column(words[i :: len(names)], dtype[name], name, path)
            for i, name in enumerate(names)
        }
    )


def _quick(file: IO[bytes], dtype: np.dtype[np.void], count: int) -> Records | None:
    """The points where each has a line of its own and plain numbers; None otherwise."""
    lines = (line.decode("ascii", "replace") for line in islice(file, count))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            values = np.loadtxt(lines, dtype, comments=None, ndmin=1)
    except (ValueError, OverflowError, UserWarning, DeprecationWarning, RuntimeWarning):
        return None
    return values if values.shape == (count,) else None


def _words(file: IO[bytes]) -> Iterator[str]:
    for line in file:
        if not line.startswith(REMARKS):
            yield from line.decode("ascii", "replace").split()
