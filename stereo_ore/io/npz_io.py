"""Strict NumPy files: no pickled objects, nothing allocated that the file does not hold, one error
for all damage.
"""

from __future__ import annotations

import math
import warnings
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np
import numpy.typing as npt

from stereo_ore.errors import StereoOreError

MAX_UNPACKED_BYTES = 4_000_000_000
"""A compressed file may unpack to so many; it is read only after its own table of contents says
less."""

LARGEST_SHOWN = 10**30
"""Python refuses to write numbers of thousands of digits."""

_Array = npt.NDArray[Any]


def load_array(path: Path, error: type[StereoOreError]) -> _Array:
    """The array of an NPY file; `error` for anything that is none."""
    with _known_faults(path, error, "NPY"), path.open("rb") as file:
        return _array(file, path.stat().st_size, path, error)


def load_arrays(
    path: Path, error: type[StereoOreError], most_bytes: int | None = None
) -> dict[str, _Array]:
    """The arrays of an NPZ file by name; `error` for anything that is none, or unpacks to more than
    `most_bytes`, which is `MAX_UNPACKED_BYTES` where none is given.
    """
    most = MAX_UNPACKED_BYTES if most_bytes is None else most_bytes
    with _known_faults(path, error, "NPZ"), zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
        _require(sum(entry.file_size for entry in entries), most, path, error)
        arrays = {}
        for entry in entries:
            with archive.open(entry) as file:
                arrays[entry.filename.removesuffix(".npy")] = _array(
                    cast(BinaryIO, file), entry.file_size, path, error
                )
        return arrays


def _array(file: BinaryIO, size: int, path: Path, error: type[StereoOreError]) -> _Array:
    """One array, after its header was found to fit the bytes that are there."""
    version = np.lib.format.read_magic(file)
    read_header = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    if version not in read_header:
        raise error(f"has NPY version {version}; 1.0 and 2.0 can be read", file=path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of old spellings in the header
        shape, fortran, dtype = read_header[version](file)
    if dtype.hasobject:
        raise error(
            "holds Python objects, which are never loaded", file=path, remedy="Save plain numbers"
        )
    if min(shape, default=0) < 0:
        raise error(
            f"claims the shape {shape}", file=path, remedy="The file is damaged; export it again"
        )
    claimed = math.prod(shape) * dtype.itemsize
    _require(claimed, size, path, error)
    return np.frombuffer(file.read(claimed), dtype).reshape(shape, order="F" if fortran else "C")


def _require(claimed: int, available: int, path: Path, error: type[StereoOreError]) -> None:
    if claimed > available:
        problem = (
            f"the header claims arrays of {min(claimed, LARGEST_SHOWN):,} bytes; {available:,} can"
            " be there"
        )
        raise error(problem, file=path, remedy="The file is cut off or damaged; export it again")


@contextmanager
def _known_faults(path: Path, error: type[StereoOreError], kind: str) -> Iterator[None]:
    """Whatever the zip reader, its decompressors and NumPy raise on a damaged file, as `error`."""
    try:
        yield
    except StereoOreError:
        raise
    except FileNotFoundError:
        raise error("no such file", file=path, remedy="Check the path") from None
    except Exception as fault:
        text = " ".join(str(fault).split())[:200] or type(fault).__name__
        remedy = "The file is damaged or something else; export it again"
        raise error(f"is not a whole {kind} file: {text}", file=path, remedy=remedy) from None
