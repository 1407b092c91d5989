"""Clouds in and out: PLY, PCD, text, NPY, NPZ, LAS. A format is a line of the registry; every
column is kept.
"""

from __future__ import annotations

import contextlib
import logging
import os
from collections.abc import Callable, Mapping
from pathlib import Path

from stereo_ore.errors import CloudError, OutputError
from stereo_ore.io.clouds import las, npy, pcd, ply, text
from stereo_ore.io.clouds.pcd import Viewpoint
from stereo_ore.io.clouds.records import Records, from_array, from_columns, xyz

__all__ = [
    "CLOUD_FORMATS",
    "Records",
    "Viewpoint",
    "format_of",
    "from_array",
    "from_columns",
    "read",
    "viewpoint",
    "write",
    "xyz",
]

_log = logging.getLogger(__name__)

CLOUD_FORMATS: Mapping[str, tuple[Callable[[Path], Records], Callable[[Path, Records], None]]] = {
    ".ply": (ply.read, ply.write),
    ".pcd": (pcd.read, pcd.write),
    ".xyz": (text.read, text.write),
    ".txt": (text.read, text.write),
    ".csv": (text.read, text.write),
    ".asc": (text.read, text.write),
    ".pts": (text.read, text.write),
    ".npy": (npy.read_npy, npy.write_npy),
    ".npz": (npy.read_npz, npy.write_npz),
    ".las": (las.read, las.write),
    ".laz": (las.read, las.write),
}


def format_of(path: Path) -> str:
    """The format a file's name stands for; CloudError for an unknown one."""
    suffix = path.suffix.lower()
    if suffix not in CLOUD_FORMATS:
        raise CloudError(
            f"{suffix or 'a name without an ending'} is no known cloud format",
            file=path,
            remedy=f"Use one of {', '.join(CLOUD_FORMATS)}",
        )
    return suffix


def read(path: Path) -> Records:
    """Points of a file with all their columns, in the file's own unit.

    Raises
    ------
    CloudError
        When the file is missing, damaged, of an unknown format, has no x, y, z, or claims more than
        it holds.
    """
    reader, _ = CLOUD_FORMATS[format_of(path)]
    try:
        if path.exists() and not path.is_file():
            raise CloudError("is no file", file=path, remedy="Name a file of points")
        return reader(path)
    except FileNotFoundError:
        raise CloudError("no such file", file=path, remedy="Check the path") from None
    except OSError as fault:
        raise CloudError(f"can't be read: {fault.strerror or fault}", file=path) from None


def viewpoint(path: Path) -> Viewpoint | None:
    """Where the sensor was: x, y, z and a quaternion with w first, of a PCD file that does not say
    the origin.
    """
    return pcd.pcd_viewpoint(path) if format_of(path) == ".pcd" else None


def write(path: Path, records: Records, viewpoint: Viewpoint | None = None) -> None:
    """Write points with all their columns; the file appears whole or not at all.

    `viewpoint` is kept by PCD; of the other formats none has a place for it, which is said.

    Raises
    ------
    CloudError
        For an unknown format, and for points that the format can't hold.
    OutputError
        When the file can't be written.
    """
    _, writer = CLOUD_FORMATS[format_of(path)]
    if viewpoint is not None and writer is not pcd.write:
        _log.warning("%s: this format has no place for the viewpoint %s", path, viewpoint)
    partial = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if viewpoint is not None and writer is pcd.write:
            pcd.write(partial, records, viewpoint)
        else:
            writer(partial, records)
        partial.replace(path)
    except CloudError as fault:
        raise CloudError(fault.problem, file=path, key=fault.key, remedy=fault.remedy) from None
    except OSError as fault:
        raise OutputError(f"can't be written: {fault.strerror or fault}", file=path) from None
    finally:
        with contextlib.suppress(OSError):
            partial.unlink()
