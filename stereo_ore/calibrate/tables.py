"""CSV tables of touched points and of arm poses, as a spreadsheet or a robot's logger writes them."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from stereo_ore.calibrate.touched import Touched
from stereo_ore.config.validation import nearest
from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration.geometry import rotation_matrix
from stereo_ore.io.yaml_io import read_text
from stereo_ore.types import F64

POINT_COLUMNS = ("arm_x_m", "arm_y_m", "arm_z_m", "left_u", "left_v", "right_u", "right_v")
PLACE_COLUMNS = ("x_m", "y_m", "z_m")
VECTOR_COLUMNS = ("rx_rad", "ry_rad", "rz_rad")
QUATERNION_COLUMNS = ("qx", "qy", "qz", "qw")


def read_touched(path: Path) -> list[Touched]:
    """Points from a table with the columns ``name`` and `POINT_COLUMNS`; pixels are those of the recorded images.

    Raises
    ------
    CalibrationError
        Naming line and column of what is missing or no number.
    """
    rows = _rows(path, POINT_COLUMNS)
    return [Touched(name, (v[0], v[1], v[2]), (v[3], v[4]), (v[5], v[6])) for name, v in rows]


def read_poses(path: Path) -> dict[str, F64]:
    """``T_arm_tool`` by the name of the frame, from ``name``, `PLACE_COLUMNS` and a rotation vector or quaternion.

    Raises
    ------
    CalibrationError
        Also when a quaternion is not of length 1.
    """
    header = _header(path)
    quaternion = "qw" in header
    poses = {}
    for name, values in _rows(path, PLACE_COLUMNS + (QUATERNION_COLUMNS if quaternion else VECTOR_COLUMNS)):
        T = np.eye(4)
        T[:3, 3] = values[:3]
        rotation = np.array(values[3:])
        T[:3, :3] = _from_quaternion(path, name, rotation) if quaternion else rotation_matrix(rotation)
        poses[name] = T
    return poses


def _from_quaternion(path: Path, name: str, q: F64) -> F64:
    """The rotation of a unit quaternion (x, y, z, w)."""
    if not abs(float(np.linalg.norm(q)) - 1) < 1e-2:
        raise CalibrationError(f"{name}: the quaternion has length {np.linalg.norm(q):.3f}, not 1", file=path)
    x, y, z, w = q / np.linalg.norm(q)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + 2 * w * cross + 2 * cross @ cross, np.float64)


def _lines(path: Path) -> list[tuple[int, list[str]]]:
    """The rows of a table that are not blank, stripped, with the number of their line."""
    reader = csv.reader(io.StringIO(read_text(path, CalibrationError)), skipinitialspace=True)
    try:
        lines = [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
    except csv.Error as fault:
        raise CalibrationError(f"is no CSV table: {fault}", file=path, key=f"line {reader.line_num}") from None
    return [(number, row) for number, row in lines if any(row)]


def _header(path: Path) -> list[str]:
    return next((row for _, row in _lines(path)), [])


def _rows(path: Path, columns: Sequence[str]) -> Iterator[tuple[str, list[float]]]:
    header, seen = _header(path), set[str]()
    for column in ("name", *columns):
        if column not in header:
            raise CalibrationError(f"column is missing{nearest(column, header)}", file=path, key=column)
    for number, row in _lines(path)[1:]:
        cells = dict.fromkeys(header, "") | dict(zip(header, row, strict=False))
        name = cells["name"]
        if name in seen:
            raise CalibrationError(f"name {name!r} is given twice", file=path, key=f"line {number}")
        seen.add(name)
        yield name, [_number(path, number, column, cells[column]) for column in columns]


def _number(path: Path, line: int, column: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise CalibrationError(f"{text!r} is not a number", file=path, key=f"line {line}, {column}")
    return value
