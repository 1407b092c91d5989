"""Clouds in files: a record a point, with whatever columns the file has; only x, y and z have a meaning here."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from stereo_ore.errors import CloudError
from stereo_ore.io.npz_io import LARGEST_SHOWN

Records = npt.NDArray[np.void]
"""Structured array (N,) with at least the fields x, y, z; others (colours, normals, anything) ride along."""

NUMBERS = "iuf"
"""Kinds of NumPy types that a coordinate can have."""

COLUMNS = ("x", "y", "z", "red", "green", "blue", "nx", "ny", "nz")


def xyz(records: Records) -> npt.NDArray[np.float64]:
    """Coordinates (N, 3) float64 in the file's unit."""
    return np.stack([records[axis].astype(np.float64) for axis in ("x", "y", "z")], -1)


def from_columns(columns: dict[str, npt.NDArray[Any]]) -> Records:
    """Records of equally long one-dimensional columns."""
    dtype = np.dtype([(name, column.dtype) for name, column in columns.items()])
    records = np.empty(len(next(iter(columns.values()))), dtype)
    for name, column in columns.items():
        records[name] = column
    return records


def from_array(values: npt.NDArray[Any], path: Path) -> Records:
    """Records of a plain (N, C ≥ 3) array: x, y, z, then columns without a name."""
    if values.dtype.names and values.ndim == 1:
        return require_xyz(values, path)
    if values.ndim != 2 or values.shape[1] < 3 or not np.issubdtype(values.dtype, np.number):
        raise CloudError(
            f"holds {values.dtype} of shape {values.shape}; numbers of shape (N, 3 or more) wanted", file=path
        )
    if values.dtype.kind not in NUMBERS:
        raise CloudError(f"holds {values.dtype}, which are no coordinates", file=path)
    names = ["x", "y", "z", *(f"column_{i}" for i in range(3, values.shape[1]))]
    return from_columns({name: values[:, i] for i, name in enumerate(names)})


def require_xyz(records: Records, path: Path) -> Records:
    """The records, or CloudError when x, y or z is missing or is no number."""
    names = records.dtype.names or ()
    for axis in ("x", "y", "z"):
        if axis not in names:
            raise CloudError(f"has no column {axis}; its columns are {', '.join(names) or 'none'}", file=path)
        if records.dtype[axis].kind not in NUMBERS:
            raise CloudError(f"column {axis} is {records.dtype[axis]}, not one number a point", file=path, key=axis)
    return records


def require_bytes(claimed: int, available: int, path: Path, what: str = "points") -> None:
    """Refuse a header that claims more than the file can hold, before anything is allocated."""
    if claimed > available:
        raise CloudError(
            f"the header claims {what} of at least {min(claimed, LARGEST_SHOWN):,} bytes; "
            f"the file has {max(available, 0):,} for them",
            file=path,
            remedy="The file is cut off or damaged; export it again",
        )
