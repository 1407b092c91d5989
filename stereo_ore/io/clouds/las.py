"""LAS and LAZ through laspy (extra ``las``): whole numbers times a scale; other columns as extra
dimensions.
"""

from __future__ import annotations

import logging
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from stereo_ore.errors import CloudError, MissingExtraError
from stereo_ore.io.clouds.records import (
    Columns,
    Records,
    columns_of,
    from_columns,
    require_bytes,
    require_xyz,
)

_log = logging.getLogger(__name__)

FINEST = 1e-5
"""Scale of the coordinates in the file's unit, where 32 bits allow it; laspy's own 0.01 would round
to centimetres."""

_RGB = ("red", "green", "blue")
_HEADER_BYTES, VLR_BYTES, EVLR_BYTES = 375, 54, 60
"""Of LAS 1.4: its header, and the heads of its variable-length records before and behind the
points."""

_COMPRESSED, _MOST_TIMES = 0x80, 1000
"""Flag of LAZ in the point format, and how many times it may make points smaller."""

OWN = ("X", "Y", "Z")


def _laspy() -> Any:
    try:
        import laspy
    except ImportError:
        raise MissingExtraError("laspy", "las") from None
    return laspy


def read(path: Path) -> Records:
    """Points of a LAS or LAZ file with their dimensions; colours of 16 bits that use all of them
    are brought to 8.

    Raises
    ------
    MissingExtraError
        Without laspy.
    CloudError
        When the file is damaged.
    """
    laspy = _laspy()
    _check_header(path)
    try:
        cloud = laspy.read(path)
    except Exception as fault:
        text = " ".join(str(fault).split())[:200] or type(fault).__name__
        raise CloudError(
            f"is not a whole LAS file: {text}", file=path, remedy="Export it again"
        ) from None
    columns = {axis: np.asarray(getattr(cloud, axis), np.float64) for axis in "xyz"}
    for name in cloud.point_format.dimension_names:
        if (
            name not in OWN
            and (column := np.asarray(cloud[name])).ndim == 1
            and (column.any() or name in _RGB)
        ):
            columns[name] = column
    return require_xyz(from_columns(_eight_bits(columns)), path)


def _check_header(path: Path) -> None:
    """Refuse a header that claims more records or points than the file can hold: laspy would look
    for them all. Which of the two counts of points it takes depends on the version: neither may.
    """
    with path.open("rb") as file:
        head = file.read(_HEADER_BYTES)
    if head[:4] != b"LASF" or len(head) < 227:
        raise CloudError(
            "does not begin with a LAS header", file=path, remedy="Is it a LAS or LAZ file?"
        )
    size, (header, start, records, kind, length, points) = (
        path.stat().st_size,
        struct.unpack_from("<HIIBHI", head, 94),
    )
    late, start_late = 0, size
    if header >= _HEADER_BYTES and len(head) == _HEADER_BYTES:
        start_late, late, wide_points = struct.unpack_from("<QIQ", head, 235)
        points = max(points, wide_points)
    require_bytes(records * VLR_BYTES, min(start, size) - header, path, "records")
    require_bytes(late * EVLR_BYTES, size - start_late, path, "records")
    if path.suffix.lower() == ".las" and not kind & _COMPRESSED:
        require_bytes(points * length, size - start, path)
    require_bytes(points * length // _MOST_TIMES, size - start, path)


def _eight_bits(columns: Columns) -> Columns:
    """Colours as bytes: LAS has 16 bits, which some writers fill and others do not."""
    if not set(_RGB) <= columns.keys():
        return columns
    full = any(len(columns[name]) and columns[name].max() > 255 for name in _RGB)
    return columns | {name: (columns[name] >> (8 if full else 0)).astype(np.uint8) for name in _RGB}


def write(path: Path, records: Records) -> None:
    """Points in LAS 1.4 with every column; coordinates rounded to a scale that 32 bits allow.

    Raises
    ------
    MissingExtraError
        Without laspy.
    CloudError
        When a point has no finite coordinates, which LAS can't hold.
    """
    laspy = _laspy()
    columns = columns_of(records)
    xyz = np.stack([np.asarray(columns.pop(axis), np.float64) for axis in "xyz"], -1)
    if not np.isfinite(xyz).all():
        bad = int((~np.isfinite(xyz).all(1)).sum())
        raise CloudError(
            f"{bad:,} points have no finite coordinates, which LAS can't hold",
            remedy="Write PLY or PCD",
        )
    has_colours = all(
        columns.get(name) is not None and columns[name].dtype == np.uint8 for name in _RGB
    )
    header = laspy.LasHeader(point_format=7 if has_colours else 6, version="1.4")
    header.offsets, header.scales = _frame(xyz)
    known = {name.lower() for name in header.point_format.dimension_names}
    extra = {name: column for name, column in columns.items() if not (has_colours and name in _RGB)}
    names = _dimension_names(list(extra), known)
    for name, column in zip(names, extra.values(), strict=True):
        header.add_extra_dim(laspy.ExtraBytesParams(name=name, type=_storable(column).dtype))
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = xyz.T
    for name, column in zip(names, extra.values(), strict=True):
        cloud[name] = _storable(column)
    if has_colours:
        for name in _RGB:
            cloud[name] = columns[name].astype(np.uint16) * 257
    with path.open("wb") as file:
        cloud.write(file, do_compress=path.suffix.lower() == ".laz")


def _frame(xyz: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Offsets and scales: whole numbers about the middle, the finest scale at which 32 bits reach
    both ends.
    """
    if not len(xyz):
        return np.zeros(3), np.full(3, FINEST)
    low, high = xyz.min(0), xyz.max(0)
    offset = np.round((low + high) / 2)
    reach = np.maximum(np.abs(low - offset), np.abs(high - offset))
    scale = 10.0 ** np.maximum(np.ceil(np.log10(np.maximum(reach, 1e-30) / 2e9)), np.log10(FINEST))
    return offset, scale


def _dimension_names(names: list[str], known: set[str]) -> list[str]:
    """Names of at most 32 bytes that LAS does not use itself."""
    found = list[str]()
    for name in names:
        short = re.sub(r"[^\w #-]|[^ -~]", "_", name)[:30]
        short = f"{short[:28]}_x" if short.lower() in known or short in found else short
        found.append(short)
    if found != names:
        _log.warning(
            "columns renamed for LAS: %s",
            ", ".join(f"{a} → {b}" for a, b in zip(names, found, strict=True) if a != b),
        )
    return found


def _storable(column: npt.NDArray[Any]) -> npt.NDArray[Any]:
    if column.dtype.kind == "b":
        return column.astype(np.uint8)
    if column.dtype.kind == "f":
        return column.astype(np.float32 if column.dtype.itemsize <= 4 else np.float64)
    return column.astype(column.dtype.newbyteorder("="))
