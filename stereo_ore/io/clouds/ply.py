"""PLY, ASCII and binary of either byte order: the vertex element, all its scalar properties."""

from __future__ import annotations

import io
import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np

from stereo_ore.errors import CloudError
from stereo_ore.io.clouds.colours import unpack
from stereo_ore.io.clouds.numbers import EXACT
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

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4",
    "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_NAMES = {
    "i1": "char",
    "u1": "uchar",
    "i2": "short",
    "u2": "ushort",
    "i4": "int",
    "u4": "uint",
    "f4": "float",
    "f8": "double",
}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
MAX_HEADER_LINES = 1000


@dataclass
class _Element:
    name: str
    count: int
    properties: list[tuple[str, str]] = field(default_factory=list)
    has_list: bool = False


def read(path: Path) -> Records:
    """Vertices of a PLY file; faces and other elements are left alone."""
    with _opened(path) as file:
        encoding, elements = _header(file, path)
        before = []
        for element in elements:
            if element.name == "vertex":
                break
            before.append(element)
        else:
            raise CloudError("has no vertex element", file=path)
        if element.has_list or any(e.has_list for e in before):
            raise CloudError(
                "has a list property in or before its vertices",
                file=path,
                remedy="Write points only",
            )
        points = _body(file, path, encoding, before, element)
    columns = columns_of(points)
    names = known_names(list(columns))
    if len(set(names)) == len(names) and names != list(columns):
        points = from_columns(dict(zip(names, columns.values(), strict=True)))
    return require_xyz(unpack(points), path)


def _opened(path: Path) -> BinaryIO:
    """The file; of one whose lines end as on an old Macintosh, its text with the usual ends."""
    file = path.open("rb")
    head = file.read(64)
    file.seek(0)
    if not (head.startswith(b"ply\r") and b"\n" not in head and b"format ascii" in head):
        return file
    with file:
        return io.BytesIO(file.read().replace(b"\r", b"\n"))


def _body(
    file: BinaryIO, path: Path, encoding: str, before: list[_Element], vertex: _Element
) -> Records:
    start = file.tell()
    left = file.seek(0, 2) - start
    file.seek(start)
    order = _ORDERS[encoding]
    dtype = np.dtype([(name, order + kind) for name, kind in vertex.properties])
    if encoding == "ascii":
        require_bytes(2 * vertex.count * len(vertex.properties) - 1, left, path)
        for _ in range(sum(e.count for e in before)):
            if not file.readline():
                break
        return parse_rows(file, dtype, vertex.count, path)
    skip = sum(e.count * sum(np.dtype(kind).itemsize for _, kind in e.properties) for e in before)
    require_bytes(skip + vertex.count * dtype.itemsize, left, path)
    file.seek(skip, 1)
    points = np.empty(vertex.count if dtype.names else 0, dtype)
    if len(points):
        file.readinto(points.view(np.uint8))  # type: ignore[attr-defined]
    return points


def _header(file: BinaryIO, path: Path) -> tuple[str, list[_Element]]:
    if file.readline(8).strip() != b"ply":
        raise CloudError("does not begin with 'ply'", file=path)
    encoding, elements = "", list[_Element]()
    for _ in range(MAX_HEADER_LINES):
        line = file.readline(4096)
        words = line.decode("ascii", "replace").split()
        if words[:1] == ["end_header"]:
            if not encoding:
                raise CloudError("has no format line", file=path)
            return encoding, elements
        if words[:1] == ["format"]:
            encoding = _encoding(words, path)
        elif words[:1] == ["element"]:
            elements.append(_element(words, path))
        elif words[:1] == ["property"]:
            _property(words, elements, path)
        elif not line:
            break
    raise CloudError("has no end_header", file=path)


def _encoding(words: list[str], path: Path) -> str:
    if len(words) < 2 or words[1] not in _ORDERS:
        raise CloudError(
            f"format {' '.join(words[1:])!r} is none of {', '.join(_ORDERS)}", file=path
        )
    return words[1]


def _element(words: list[str], path: Path) -> _Element:
    if len(words) != 3 or not words[2].isdigit():
        raise CloudError(f"header line {' '.join(words)!r} is not 'element NAME COUNT'", file=path)
    return _Element(words[1], int(words[2]))


def _property(words: list[str], elements: list[_Element], path: Path) -> None:
    if not elements:
        raise CloudError("has a property before any element", file=path)
    element = elements[-1]
    if words[1:2] == ["list"]:
        element.has_list = True
    elif len(words) == 3 and words[1] in _TYPES and words[2] not in dict(element.properties):
        element.properties.append((words[2], _TYPES[words[1]]))
    else:
        raise CloudError(
            f"header line {' '.join(words)!r} is no property that can be read", file=path
        )


def write(path: Path, records: Records) -> None:
    """Binary little-endian PLY with every column; integers wider than 32 bits become doubles."""
    records = fit_names(records)
    fields = [(name, _kind(records.dtype[name])) for name in records.dtype.names or ()]
    for name, column in columns_of(records).items():
        if (
            column.dtype.itemsize == 8
            and column.dtype.kind in "iu"
            and len(column)
            and np.abs(column).max() > EXACT
        ):
            _log.warning(
                "column %s: PLY has no whole numbers of 64 bits; they are rounded to doubles", name
            )
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(records)}"]
    header += [f"property {_NAMES[kind]} {name}" for name, kind in fields]
    with path.open("wb") as file:
        file.write(("\n".join([*header, "end_header"]) + "\n").encode("ascii"))
        file.write(
            records.astype(np.dtype([(name, "<" + kind) for name, kind in fields])).tobytes()
        )


def _kind(dtype: np.dtype[np.generic]) -> str:
    kind = f"{dtype.kind}{dtype.itemsize}"
    return {"b1": "u1", "f2": "f4"}.get(kind, kind if kind in _NAMES else "f8")
