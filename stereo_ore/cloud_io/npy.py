"""NumPy files: one array (NPY), or named arrays (NPZ). Pickled objects are never loaded."""

from __future__ import annotations

import math
import zipfile
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np
import numpy.typing as npt

from stereo_ore.cloud_io.records import Records, from_array, from_columns, require_bytes, require_xyz
from stereo_ore.errors import CloudError

MAX_UNPACKED_BYTES = 4_000_000_000
XYZ_NAMES = ("xyz", "points", "voxel_xyz")


def read_npy(path: Path) -> Records:
    """An (N, 3 or more) array, or a structured array with x, y, z."""
    with path.open("rb") as file:
        return from_array(_array(file, path.stat().st_size, path), path)


def read_npz(path: Path) -> Records:
    """Columns x, y, z and others of the same length, or an (N, 3) array called xyz, points or voxel_xyz."""
    try:
        with zipfile.ZipFile(path) as archive:
            unpacked = sum(entry.file_size for entry in archive.infolist())
            require_bytes(unpacked, MAX_UNPACKED_BYTES, path, "arrays")
            arrays = {}
            for entry in archive.infolist():
                with archive.open(entry) as file:
                    arrays[entry.filename.removesuffix(".npy")] = _array(cast(BinaryIO, file), entry.file_size, path)
    except (zipfile.BadZipFile, EOFError, OSError) as fault:
        raise CloudError(f"is not a whole NPZ file: {fault}", file=path) from None
    return _from_named(arrays, path)


def _from_named(arrays: dict[str, npt.NDArray[Any]], path: Path) -> Records:
    name = next((name for name in XYZ_NAMES if name in arrays), None)
    if name is None and not {"x", "y", "z"} <= set(arrays):
        wanted = f"x, y, z or one of {', '.join(XYZ_NAMES)}"
        raise CloudError(f"holds {', '.join(arrays) or 'nothing'}; {wanted} wanted", file=path)
    points = from_array(arrays.pop(name), path) if name else None
    base = {} if points is None else {key: points[key] for key in points.dtype.names or ()}
    length = len(points if points is not None else arrays["x"].reshape(-1))
    riders = {key: value for key, value in arrays.items() if value.shape == (length,) and value.dtype.kind in "iufb"}
    columns = base | riders
    if not {"x", "y", "z"} <= set(columns):
        raise CloudError("x, y and z differ in length or are no numbers", file=path)
    return require_xyz(from_columns(columns), path)


def _array(file: BinaryIO, size: int, path: Path) -> npt.NDArray[Any]:
    """One array, after its header was found to fit the bytes that are there."""
    try:
        version = np.lib.format.read_magic(file)
        read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
        if version not in read_header:
            raise CloudError(f"has NPY version {version}; 1.0 and 2.0 can be read", file=path)
        shape, fortran, dtype = read_header[version](file)
        if dtype.hasobject:
            raise CloudError("holds Python objects, which are never loaded", file=path, remedy="Save plain numbers")
        require_bytes(math.prod(shape) * dtype.itemsize, size - 8, path)
        raw = file.read(math.prod(shape) * dtype.itemsize)
        return np.frombuffer(raw, dtype).reshape(shape, order="F" if fortran else "C")
    except (ValueError, EOFError, zipfile.BadZipFile) as fault:
        raise CloudError(f"is not a whole NPY array: {fault}", file=path) from None


def write_npy(path: Path, records: Records) -> None:
    """(N, 3) when there is nothing but x, y, z of one type; else the structured array."""
    names = records.dtype.names or ()
    plain = names == ("x", "y", "z") and len({records.dtype[name] for name in names}) == 1
    values = np.stack([records[name] for name in names], -1) if plain else records
    with path.open("wb") as file:
        np.save(file, values, allow_pickle=False)


def write_npz(path: Path, records: Records) -> None:
    """A named array a column."""
    with path.open("wb") as file:
        np.savez(file, allow_pickle=False, **{name: records[name] for name in records.dtype.names or ()})
