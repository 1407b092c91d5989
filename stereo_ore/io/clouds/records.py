"""Clouds in files: a record a point, with whatever columns the file has; only x, y and z have a
meaning here.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from stereo_ore.errors import CloudError
from stereo_ore.io.npz_io import LARGEST_SHOWN

_log = logging.getLogger(__name__)

Records = npt.NDArray[np.void]
"""Structured array (N,) with at least the fields x, y, z; others (colours, normals, anything) ride
along."""

Columns = dict[str, npt.NDArray[Any]]

NUMBERS = "iuf"
"""Kinds of NumPy types that a coordinate can have."""

COLUMNS = ("x", "y", "z", "red", "green", "blue", "nx", "ny", "nz", "alpha")

MOST_POINTS_IN_ROWS = 16
"""An array of three or four rows is turned when it has more columns; fewer may be points with their
values."""


def xyz(records: Records) -> npt.NDArray[np.float64]:
    """Coordinates (N, 3) float64 in the file's unit."""
    return np.stack([records[axis].astype(np.float64) for axis in ("x", "y", "z")], -1)


def from_columns(columns: Columns) -> Records:
    """Records of equally long one-dimensional columns."""
    dtype = np.dtype([(name, column.dtype) for name, column in columns.items()])
    records = np.empty(len(next(iter(columns.values()))), dtype)
    for name, column in columns.items():
        records[name] = column
    return records


def columns_of(records: Records) -> Columns:
    """The columns by name."""
    return {name: records[name] for name in records.dtype.names or ()}


def from_array(values: npt.NDArray[Any], path: Path) -> Records:
    """Records of a plain (N, C ≥ 3) array: x, y, z, then columns without a name; (3, N) and (4, N)
    are turned.
    """
    if values.dtype.names and values.ndim == 1:
        return require_xyz(flat(values, path), path)
    if values.ndim != 2 or values.shape[1] < 3 or not np.issubdtype(values.dtype, np.number):
        raise CloudError(
            f"holds {values.dtype} of shape {values.shape}; numbers of shape (N, 3 or more) wanted",
            file=path,
        )
    if values.dtype.kind not in NUMBERS:
        raise CloudError(f"holds {values.dtype}, which are no coordinates", file=path)
    return unnamed(values)


def unnamed(values: npt.NDArray[Any]) -> Records:
    """Records of an (N, C ≥ 3) array: x, y, z, column_3 and so on."""
    names = ["x", "y", "z", *(f"column_{i}" for i in range(3, values.shape[1]))]
    return from_columns({name: values[:, i] for i, name in enumerate(names)})


def upright(values: npt.NDArray[Any], path: Path) -> npt.NDArray[Any]:
    """An array with a point a row; one with a point a column is turned, one with a point a pixel
    (H, W, 3 or more) is read row by row.

    Raises
    ------
    CloudError
        When it may be either.
    """
    if values.ndim == 3 and values.dtype.kind == "f" and 3 <= values.shape[2] <= len(COLUMNS):
        _log.warning("%s: an image of points %s is read row by row", path, values.shape)
        return values.reshape(-1, values.shape[2])
    if values.ndim != 2 or values.shape[0] not in (3, 4) or values.shape[1] <= 4:
        return values
    rows, columns = values.shape
    if columns <= MOST_POINTS_IN_ROWS:
        raise CloudError(
            f"has the shape {values.shape}: {rows} points of {columns} values, or {columns} points"
            f" of {rows}?",
            file=path,
            remedy=f"Save it as ({columns}, {rows}), or with names (a structured array, CSV)",
        )
    _log.warning(
        "%s: an array of shape %s is read as %s points, a point a column",
        path,
        values.shape,
        f"{columns:,}",
    )
    return values.T


def flat(records: Records, path: Path) -> Records:
    """The records with a column a number: fields of several are split, those of text left out and
    named, those without a name called by their number.
    """
    columns, left_out = Columns(), list[str]()
    for number, (given, column) in enumerate(columns_of(records).items()):
        name = given or f"field_{number}"
        if column.dtype.kind not in NUMBERS + "b":
            left_out.append(name)
        elif column.ndim == 1:
            columns[name] = column
        else:
            many = column.reshape(len(records), int(np.prod(column.shape[1:])))
            columns |= {part: many[:, i] for i, part in enumerate(parts_of(name, many.shape[1]))}
    tell_left_out(path, left_out)
    return from_columns(columns) if columns else records


def parts_of(name: str, count: int) -> Sequence[str]:
    """Names of the parts of a column of several numbers."""
    known = {("xyz", 3): "x y z", ("normals", 3): "nx ny nz", ("normal", 3): "nx ny nz"}
    colours = {
        (word, 3): "red green blue" for word in ("rgb", "colors", "colours", "color", "colour")
    }
    words = (known | colours).get((name.lower(), count))
    return words.split() if words else [f"{name}_{i}" for i in range(count)]


def tell_left_out(path: Path, names: Sequence[str]) -> None:
    """Say which columns of a file are none of numbers."""
    if names:
        _log.warning("%s: left out, since not one number a point: %s", path, ", ".join(names))


def known_names(names: Sequence[str]) -> list[str]:
    """Names of columns as they are called here: X → x, R G B → red green blue, Points:0 → x, ``X
    (m)`` → x.
    """
    found = [
        re.sub(r"^Points:([012])$", lambda match: "xyz"[int(match[1])], name.strip().strip('"'))
        for name in names
    ]
    found = [re.sub(r"^([xyzXYZ])\s*[(\[][^)\]]*[)\]]$", r"\1", name) for name in found]
    found = [name.lower() if name.lower() in COLUMNS else name for name in found]
    short = {"r": "red", "g": "green", "b": "blue"}
    lower = [name.lower() for name in found]
    if set(short) <= set(lower) and not set(short.values()) & set(lower):
        found = [short.get(name.lower(), name) for name in found]
    return found


def require_xyz(records: Records, path: Path) -> Records:
    """The records, or CloudError when x, y or z is missing or is no number."""
    names = records.dtype.names or ()
    for axis in ("x", "y", "z"):
        if axis not in names:
            raise CloudError(
                f"has no column {axis}; its columns are {', '.join(names) or 'none'}", file=path
            )
        if records.dtype[axis].kind not in NUMBERS:
            raise CloudError(
                f"column {axis} is {records.dtype[axis]}, not one number a point",
                file=path,
                key=axis,
            )
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


def fit_names(records: Records) -> Records:
    """The records with names that a header of PLY or PCD can hold: ASCII without blanks, each one
    once.
    """
    names = records.dtype.names or ()
    fitted = list[str]()
    for name in names:
        plain = re.sub(r"[^!-~]+", "_", name) or "column"
        plain = "column_" if plain == "_" else plain
        number = 2
        unique = plain
        while unique in fitted or (unique != name and unique in names):
            unique, number = f"{plain}_{number}", number + 1
        fitted.append(unique)
    changed = [f"{old} → {new}" for old, new in zip(names, fitted, strict=True) if old != new]
    if changed:
        _log.warning(
            "columns renamed, since PLY and PCD have ASCII names without blanks: %s",
            ", ".join(changed),
        )
        return from_columns(dict(zip(fitted, columns_of(records).values(), strict=True)))
    return records
