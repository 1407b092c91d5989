"""Colours of points: three columns of bytes everywhere but in PCD, which packs them into one
field.
"""

from __future__ import annotations

import numpy as np

from stereo_ore.io.clouds.records import Columns, Records, columns_of, from_columns

_RGB = ("red", "green", "blue")
SHIFTS = (16, 8, 0, 24)
"""Bits by which red, green, blue and alpha are shifted in a packed colour."""


def unpack(records: Records) -> Records:
    """The records with ``rgb`` or ``rgba``, 32 bits that may pass for a float, as columns of
    bytes.
    """
    known = columns = columns_of(records)
    for packed, names in (("rgb", _RGB), ("rgba", (*_RGB, "alpha"))):
        column = columns.get(packed)
        if column is None or column.dtype.itemsize != 4 or set(names) & columns.keys():
            continue
        bits = np.ascontiguousarray(column).view(np.uint32)
        parts = {
            name: (bits >> np.uint32(shift) & np.uint32(255)).astype(np.uint8)
            for name, shift in zip(names, SHIFTS, strict=False)
        }
        columns = _in_place(columns, packed, parts)
    return records if columns is known else from_columns(columns)


def pack_rgb(records: Records) -> Records:
    """The records with red, green, blue as one field ``rgb``, or with alpha as ``rgba``, where they
    are bytes.

    The former are the bits of a float, the latter a whole number, as PCL has them: its
    ``pcl_pcd2ply`` writes four bytes for the three that it announces where ``rgb`` is whole.
    """
    columns = columns_of(records)
    names = (*_RGB, "alpha") if "alpha" in columns else _RGB
    if not set(names) <= columns.keys() or any(columns[name].dtype != np.uint8 for name in names):
        return records
    packed = np.zeros(len(records), np.uint32)
    for name, shift in zip(names, SHIFTS, strict=False):
        packed |= columns[name].astype(np.uint32) << np.uint32(shift)
    whole = {"rgba": packed} if len(names) == 4 else {"rgb": packed.view(np.float32)}
    replaced = _in_place(columns, names[0], whole)
    return from_columns(
        {name: column for name, column in replaced.items() if name not in names[1:]}
    )


def as_bytes(columns: Columns) -> Columns:
    """Columns called red, green, blue and alpha as bytes, where they are whole numbers from 0 to
    255.
    """
    names = [name for name in (*_RGB, "alpha") if name in columns]
    fits = all(
        columns[name].dtype.kind in "iu"
        and (not columns[name].size or 0 <= columns[name].min() <= columns[name].max() <= 255)
        for name in names
    )
    return {
        name: column.astype(np.uint8) if fits and name in names else column
        for name, column in columns.items()
    }


def _in_place(columns: Columns, old: str, new: Columns) -> Columns:
    found = Columns()
    for name, column in columns.items():
        found |= new if name == old else {name: column}
    return found
