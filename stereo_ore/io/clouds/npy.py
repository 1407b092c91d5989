"""NumPy files: one array (NPY), or named arrays (NPZ). Pickled objects are never loaded."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from stereo_ore.errors import CloudError
from stereo_ore.io.clouds.records import (
    Records,
    from_array,
    from_columns,
    parts_of,
    require_xyz,
    tell_left_out,
    upright,
)
from stereo_ore.io.npz_io import load_array, load_arrays

XYZ_NAMES = ("xyz", "points", "voxel_xyz", "positions", "vertices")
"""Names of an array of points; ``positions`` are Open3D's. The only array of a file needs none."""


def read_npy(path: Path) -> Records:
    """An (N, 3 or more) array, or a structured array with x, y, z."""
    return from_array(upright(load_array(path, CloudError), path), path)


def read_npz(path: Path) -> Records:
    """Columns x, y, z and others of the same length, or an (N, 3) array called xyz, points or
    voxel_xyz.
    """
    return _from_named(load_arrays(path, CloudError), path)


def _from_named(arrays: dict[str, npt.NDArray[Any]], path: Path) -> Records:
    known = XYZ_NAMES if len(arrays) > 1 else arrays
    name = next((name for name in known if name in arrays), None)
    if name is None and not {"x", "y", "z"} <= set(arrays):
        wanted = f"x, y, z or one of {', '.join(XYZ_NAMES)}"
        raise CloudError(f"holds {', '.join(arrays) or 'nothing'}; {wanted} wanted", file=path)
    points = from_array(upright(arrays.pop(name), path), path) if name else None
    base = {} if points is None else {key: points[key] for key in points.dtype.names or ()}
    length = len(points if points is not None else arrays["x"].reshape(-1))
    columns, left_out = dict(base), list[str]()
    for key, value in arrays.items():
        if value.dtype.kind not in "iufb" or value.shape[:1] != (length,) or value.ndim > 2:
            left_out.append(key)
        elif value.ndim == 1:
            columns[key] = value
        else:
            columns |= {
                part: value[:, i]
                for i, part in enumerate(parts_of(key, value.shape[1]))
                if part not in base
            }
    tell_left_out(path, left_out)
    if not {"x", "y", "z"} <= set(columns):
        raise CloudError("x, y and z differ in length or are no numbers", file=path)
    return require_xyz(from_columns({key: value for key, value in columns.items() if key}), path)


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
        np.savez(
            file, allow_pickle=False, **{name: records[name] for name in records.dtype.names or ()}
        )
