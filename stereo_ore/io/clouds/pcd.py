"""PCD 0.7 of the Point Cloud Library, ASCII and binary; packed colours stay as they are."""

from __future__ import annotations

import math
from pathlib import Path
from typing import BinaryIO

import numpy as np

from stereo_ore.errors import CloudError
from stereo_ore.io.clouds.records import Records, require_bytes, require_xyz
from stereo_ore.io.clouds.text import parse_rows

KINDS = {"F": "f", "I": "i", "U": "u"}
MOST_FIELDS, LONGEST_NUMBER = 10_000, 20
SIZES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}


def read(path: Path) -> Records:
    """Points of a PCD file; fields with several values a point are split into name_0, name_1 and so on."""
    with path.open("rb") as file:
        header = _header(file, path)
        dtype, count = _dtype(header, path), _count(header, path)
        left = path.stat().st_size - file.tell()
        encoding = header["DATA"][0]
        if encoding == "ascii":
            require_bytes(2 * count * len(dtype.names or ()) - 1, left, path)
            return require_xyz(parse_rows(file, dtype, count, path), path)
        if encoding != "binary":
            remedy = "Convert it with pcl_convert_pcd_ascii_binary or write it uncompressed"
            raise CloudError(f"DATA {encoding} can't be read", file=path, remedy=remedy)
        require_bytes(count * dtype.itemsize, left, path)
        return require_xyz(np.fromfile(file, dtype, count), path)


def _header(file: BinaryIO, path: Path) -> dict[str, list[str]]:
    header: dict[str, list[str]] = {}
    for _ in range(100):
        words = file.readline(65536).decode("ascii", "replace").split()
        if words and not words[0].startswith("#"):
            header[words[0].upper()] = words[1:]
            if words[0].upper() == "DATA" and len(words) == 2:
                break
    missing = [key for key in ("FIELDS", "SIZE", "TYPE", "DATA") if not header.get(key)]
    if missing:
        raise CloudError(f"the header lacks {', '.join(missing)}", file=path, remedy="Is it a PCD file?")
    return header


def _dtype(header: dict[str, list[str]], path: Path) -> np.dtype[np.void]:
    names, sizes, types = header["FIELDS"], header["SIZE"], header["TYPE"]
    repeats = header.get("COUNT", ["1"] * len(names))
    if not len(names) == len(sizes) == len(types) == len(repeats):
        raise CloudError("FIELDS, SIZE, TYPE and COUNT differ in length", file=path)
    if not all(word.isdigit() and len(word) < LONGEST_NUMBER for word in (*sizes, *repeats)):
        raise CloudError("SIZE and COUNT must be whole numbers", file=path)
    if sum(map(int, repeats)) > MOST_FIELDS:
        raise CloudError(f"COUNT gives more than {MOST_FIELDS:,} values a point", file=path)
    fields = []
    for i, (name, size, kind, repeat) in enumerate(zip(names, sizes, types, repeats, strict=True)):
        if kind not in KINDS or int(size) not in SIZES[kind]:
            raise CloudError(f"has the type {kind}{size}×{repeat}", file=path, key=name)
        parts = [name] if repeat == "1" else [f"{name}_{j}" for j in range(int(repeat))]
        # PCL calls padding "_", as often as it likes.
        fields += [(f"{part}{i}" if name == "_" else part, f"<{KINDS[kind]}{size}") for part in parts]
    if len({name for name, _ in fields}) < len(fields):
        raise CloudError("has a field name twice", file=path, key="FIELDS")
    return np.dtype(fields)


def _count(header: dict[str, list[str]], path: Path) -> int:
    words = header.get("POINTS") or [*header.get("WIDTH", ["?"]), *header.get("HEIGHT", ["1"])]
    if not all(word.isdigit() and len(word) < LONGEST_NUMBER for word in words):
        raise CloudError("the number of points is missing or is no number", file=path, key="POINTS")
    return math.prod(int(word) for word in words)


def write(path: Path, records: Records) -> None:
    """Binary PCD with every column."""
    dtype = records.dtype.newbyteorder("<")
    names = dtype.names or ()
    kinds = [{"b": "U"}.get(dtype[name].kind, dtype[name].kind.upper()) for name in names]
    header = [
        "# .PCD v0.7 - Point Cloud Data file format", "VERSION 0.7", f"FIELDS {' '.join(names)}",
        f"SIZE {' '.join(str(dtype[name].itemsize) for name in names)}", f"TYPE {' '.join(kinds)}",
        f"COUNT {' '.join('1' for _ in names)}", f"WIDTH {len(records)}", "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(records)}", "DATA binary",
    ]  # fmt: skip
    with path.open("wb") as file:
        file.write(("\n".join(header) + "\n").encode("ascii"))
        file.write(records.astype(dtype).tobytes())
