"""Clouds in and out: PLY, PCD, XYZ/TXT/CSV, NPY, NPZ. A format is a line of the registry; every column is kept."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Mapping
from pathlib import Path

from stereo_ore.errors import CloudError, OutputError
from stereo_ore.io.clouds import npy, pcd, ply, text
from stereo_ore.io.clouds.records import Records, from_array, from_columns, xyz

__all__ = ["FORMATS", "Records", "format_of", "from_array", "from_columns", "read", "write", "xyz"]

FORMATS: Mapping[str, tuple[Callable[[Path], Records], Callable[[Path, Records], None]]] = {
    ".ply": (ply.read, ply.write),
    ".pcd": (pcd.read, pcd.write),
    ".xyz": (text.read, text.write),
    ".txt": (text.read, text.write),
    ".csv": (text.read, text.write),
    ".npy": (npy.read_npy, npy.write_npy),
    ".npz": (npy.read_npz, npy.write_npz),
}


def format_of(path: Path) -> str:
    """The format a file's name stands for; CloudError for an unknown one."""
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise CloudError(f"{suffix or 'a name without an ending'} is no known cloud format", file=path,
                         remedy=f"Use one of {', '.join(FORMATS)}")  # fmt: skip
    return suffix


def read(path: Path) -> Records:
    """Points of a file with all their columns, in the file's own unit.

    Raises
    ------
    CloudError
        When the file is missing, damaged, of an unknown format, has no x, y, z, or claims more than it holds.
    """
    reader, _ = FORMATS[format_of(path)]
    try:
        if path.exists() and not path.is_file():
            raise CloudError("is no file", file=path, remedy="Name a file of points")
        return reader(path)
    except FileNotFoundError:
        raise CloudError("no such file", file=path, remedy="Check the path") from None
    except OSError as fault:
        raise CloudError(f"can't be read: {fault.strerror or fault}", file=path) from None


def write(path: Path, records: Records) -> None:
    """Write points with all their columns; the file appears whole or not at all.

    Raises
    ------
    CloudError
        For an unknown format.
    OutputError
        When the file can't be written.
    """
    _, writer = FORMATS[format_of(path)]
    partial = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        writer(partial, records)
        partial.replace(path)
    except OSError as fault:
        raise OutputError(f"can't be written: {fault.strerror or fault}", file=path) from None
    finally:
        with contextlib.suppress(OSError):
            partial.unlink()
