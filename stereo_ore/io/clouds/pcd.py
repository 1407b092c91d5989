"""PCD 0.7 of the Point Cloud Library: ASCII, binary and compressed; colours are columns here,
packed in the file.
"""

from __future__ import annotations

import logging
import math
import struct
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from stereo_ore.errors import CloudError
from stereo_ore.io.clouds.colours import pack_rgb, unpack
from stereo_ore.io.clouds.lzf import MOST_TIMES, decompress
from stereo_ore.io.clouds.records import (
    Records,
    columns_of,
    fit_names,
    from_columns,
    known_names,
    require_bytes,
    require_xyz,
)
from stereo_ore.io.clouds.rows import parse_rows

_log = logging.getLogger(__name__)

_KINDS = {"F": "f", "I": "i", "U": "u"}
MOST_FIELDS, _LONGEST_NUMBER = 10_000, 20
_SIZES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}

_GEOMETRY = ("x", "y", "z", "nx", "ny", "nz", "normal_x", "normal_y", "normal_z")
"""Fields that PCL and Open3D take as 4-byte floats only: they see zeros or nothing where these are
doubles."""

MOST_MOVED = 1e-5
"""Share of the cloud's extent by which rounding to 4 bytes may move a point."""

Viewpoint = tuple[float, float, float, float, float, float, float]
"""Place and quaternion (w first) of the sensor."""

ORIGIN: Viewpoint = (0, 0, 0, 1, 0, 0, 0)


def read(path: Path) -> Records:
    """Points of a PCD file; fields with several values a point are split into name_0, name_1 and so
    on.
    """
    with path.open("rb") as file:
        header = _header(file, path)
        dtype, count = _dtype(header, path), _count(header, path)
        points = _body(file, header["DATA"][0], dtype, count, path)
    columns = {
        name: column for name, column in columns_of(points).items() if not name.startswith(PADDING)
    }
    names = known_names(list(columns))
    if len(set(names)) < len(names):
        names = list(columns)
    columns = dict(zip(names, columns.values(), strict=True))
    return require_xyz(unpack(from_columns(columns)) if columns else points, path)


PADDING = "\0"
"""Fields that PCL calls ``_`` are padding, as often as it likes; no column here begins so."""


def _body(
    file: BinaryIO, encoding: str, dtype: np.dtype[np.void], count: int, path: Path
) -> Records:
    left = path.stat().st_size - file.tell()
    if encoding == "ascii":
        require_bytes(2 * count * len(dtype.names or ()) - 1, left, path)
        return parse_rows(file, dtype, count, path)
    if encoding == "binary":
        require_bytes(count * dtype.itemsize, left, path)
        return np.fromfile(file, dtype, count)
    if encoding != "binary_compressed":
        remedy = "Convert it with pcl_convert_pcd_ascii_binary or write it uncompressed"
        raise CloudError(f"DATA {encoding} can't be read", file=path, remedy=remedy)
    return _compressed(file, left, dtype, count, path)


def _compressed(
    file: BinaryIO, left: int, dtype: np.dtype[np.void], count: int, path: Path
) -> Records:
    """Two sizes, then the columns one after the other, packed together."""
    require_bytes(8, left, path)
    packed, size = struct.unpack("<II", file.read(8))
    require_bytes(packed, left - 8, path)
    if size != count * dtype.itemsize or size > MOST_TIMES * max(packed, 1):
        problem = (
            f"the header claims {count:,} points of {dtype.itemsize} bytes, the data {size:,} bytes"
        )
        raise CloudError(problem, file=path, remedy="The file is damaged; export it again")
    try:
        data = decompress(file.read(packed), size)
    except ValueError as fault:
        raise CloudError(
            str(fault), file=path, remedy="The file is damaged; export it again"
        ) from None
    points, at = np.empty(count, dtype), 0
    for name in dtype.names or ():
        kind = dtype[name]
        points[name] = np.frombuffer(data, kind, count, at)
        at += count * kind.itemsize
    return points


def pcd_viewpoint(path: Path) -> Viewpoint | None:
    """Where the sensor of a PCD file was, when that is not the origin."""
    with path.open("rb") as file:
        words = _header(file, path).get("VIEWPOINT", [])
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != 7 or not np.isfinite(values).all():
        return None
    x, y, z, qw, qx, qy, qz = values
    found = (x, y, z, qw, qx, qy, qz)
    return None if found == ORIGIN else found


def _header(file: BinaryIO, path: Path) -> dict[str, list[str]]:
    header: dict[str, list[str]] = {}
    for _ in range(100):
        words = file.readline(65536).decode("ascii", "replace").split()
        if words and not words[0].startswith("#"):
            # PCL before 1.0 said COLUMNS.
            header[{"COLUMNS": "FIELDS"}.get(words[0].upper(), words[0].upper())] = words[1:]
            if words[0].upper() == "DATA" and len(words) == 2:
                break
    missing = [key for key in ("FIELDS", "SIZE", "TYPE", "DATA") if not header.get(key)]
    if missing:
        raise CloudError(
            f"the header lacks {', '.join(missing)}", file=path, remedy="Is it a PCD file?"
        )
    return header


def _dtype(header: dict[str, list[str]], path: Path) -> np.dtype[np.void]:
    names, sizes, types = header["FIELDS"], header["SIZE"], header["TYPE"]
    repeats = header.get("COUNT", ["1"] * len(names))
    if not len(names) == len(sizes) == len(types) == len(repeats):
        raise CloudError("FIELDS, SIZE, TYPE and COUNT differ in length", file=path)
    if not all(word.isdigit() and len(word) < _LONGEST_NUMBER for word in (*sizes, *repeats)):
        raise CloudError("SIZE and COUNT must be whole numbers", file=path)
    if sum(map(int, repeats)) > MOST_FIELDS:
        raise CloudError(f"COUNT gives more than {MOST_FIELDS:,} values a point", file=path)
    fields = []
    for i, (name, size, kind, repeat) in enumerate(zip(names, sizes, types, repeats, strict=True)):
        if kind not in _KINDS or int(size) not in _SIZES[kind]:
            raise CloudError(f"has the type {kind}{size}×{repeat}", file=path, key=name)
        own = f"{PADDING}{i}" if name == "_" else name
        parts = [own] if repeat == "1" else [f"{own}_{j}" for j in range(int(repeat))]
        fields += [(part, f"<{_KINDS[kind]}{size}") for part in parts]
    if len({name for name, _ in fields}) < len(fields):
        raise CloudError("has a field name twice", file=path, key="FIELDS")
    return np.dtype(fields)


def _count(header: dict[str, list[str]], path: Path) -> int:
    words = header.get("POINTS") or [*header.get("WIDTH", ["?"]), *header.get("HEIGHT", ["1"])]
    if not all(word.isdigit() and len(word) < _LONGEST_NUMBER for word in words):
        raise CloudError("the number of points is missing or is no number", file=path, key="POINTS")
    return math.prod(int(word) for word in words)


def write(path: Path, records: Records, viewpoint: Viewpoint | None = None) -> None:
    """Binary PCD with every column; coordinates and normals as floats of 4 bytes, colours packed.

    Raises
    ------
    CloudError
        When 4 bytes would move points by more than `MOST_MOVED` of the cloud's extent.
    """
    records = fit_names(pack_rgb(records))
    columns = {name: _storable(name, column) for name, column in columns_of(records).items()}
    names, types = list(columns), [column.dtype for column in columns.values()]
    header = [
        "# .PCD v0.7 - Point Cloud Data file format", "VERSION 0.7", f"FIELDS {' '.join(names)}",
        f"SIZE {' '.join(str(kind.itemsize) for kind in types)}",
        f"TYPE {' '.join(kind.kind.upper() for kind in types)}",
        f"COUNT {' '.join('1' for _ in names)}", f"WIDTH {len(records)}", "HEIGHT 1",
        f"VIEWPOINT {' '.join(f'{value:.9g}' for value in viewpoint or ORIGIN)}",
        f"POINTS {len(records)}", "DATA binary",
    ]  # fmt: skip
    with path.open("wb") as file:
        file.write(("\n".join(header) + "\n").encode("ascii"))
        file.write(from_columns(columns).tobytes() if columns else b"")


def _storable(name: str, column: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """A column in a type that PCL's and Open3D's readers know."""
    kind = column.dtype.kind
    if kind == "b":
        return column.astype(np.uint8)
    if kind != "f":
        return column.astype(column.dtype.newbyteorder("<"))
    if name not in _GEOMETRY:
        return column.astype("<f4" if column.dtype.itemsize <= 4 else "<f8")
    with np.errstate(over="ignore"):
        single = column.astype("<f4")
    finite = np.isfinite(column)
    if finite.any():
        extent = float(np.ptp(column[finite])) or 0.1 * float(np.abs(column[finite]).max())
        moved = float(np.abs(column[finite] - single[finite].astype(column.dtype)).max())
        if moved > MOST_MOVED * extent:
            problem = (
                f"4-byte floats, which PCL and Open3D want, would move points by {moved:.3g} along"
                f" {name}"
            )
            remedy = "Write PLY, or take a far origin off the coordinates first"
            raise CloudError(problem, key=name, remedy=remedy)
    return single
