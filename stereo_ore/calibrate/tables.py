"""CSV tables of touched points and of arm poses, as a spreadsheet or a robot's logger writes
them.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from stereo_ore.calibrate.touched import Touched
from stereo_ore.config.validation import nearest_word
from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration.readings import PoseTable, Reading, poses
from stereo_ore.io.yaml_io import MAX_BYTES, read_text
from stereo_ore.types import F64

POINT_COLUMNS = ("arm_x_m", "arm_y_m", "arm_z_m", "left_u", "left_v", "right_u", "right_v")
PLACE_COLUMNS = ("x_m", "y_m", "z_m")
VECTOR_COLUMNS = ("rx_rad", "ry_rad", "rz_rad")
QUATERNION_COLUMNS = ("qx", "qy", "qz", "qw")

_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+(e[+-]?\d+)?", re.IGNORECASE)


def read_touched(path: Path) -> list[Touched]:
    """Points from a table with the columns ``name`` and `POINT_COLUMNS`; pixels are those of the
    recorded images.

    Raises
    ------
    CalibrationError
        Naming line and column of what is missing or no number.
    """
    rows = _rows(path, POINT_COLUMNS)
    return [Touched(name, (v[0], v[1], v[2]), (v[3], v[4]), (v[5], v[6])) for name, v in rows]


def read_poses(path: Path) -> dict[str, F64]:
    """``T_arm_tool`` by the name of the frame, from ``name``, `PLACE_COLUMNS` and a rotation vector
    or quaternion.

    Raises
    ------
    CalibrationError
        Also when a quaternion is not of length 1.
    """
    table = read_pose_table(path)
    reading = Reading("xyzw" if table.rotations.shape[1] == 4 else "rotvec-rad")
    return dict(zip(table.names, poses(table, reading), strict=True))


def read_pose_table(path: Path) -> PoseTable:
    """The numbers of a table of poses, not yet understood as rotations.

    Raises
    ------
    CalibrationError
        Naming line and column of what is missing or no number; when a quaternion is not of length
        1.
    """
    quaternion = "qw" in _header(path)
    rows = list(_rows(path, PLACE_COLUMNS + (QUATERNION_COLUMNS if quaternion else VECTOR_COLUMNS)))
    values = np.array([row for _, row in rows], np.float64).reshape(-1, 7 if quaternion else 6)
    for name, q in zip((name for name, _ in rows), values[:, 3:], strict=True):
        if quaternion and not abs(float(np.linalg.norm(q)) - 1) < 1e-2:
            raise CalibrationError(
                f"{name}: the quaternion has length {np.linalg.norm(q):.3f}, not 1", file=path
            )
    return PoseTable(tuple(name for name, _ in rows), values[:, :3], values[:, 3:])


def _text(path: Path) -> str:
    """The text of a table as spreadsheets save it: UTF-8, UTF-16 with its mark, or one byte a
    letter.
    """
    try:
        head = path.read_bytes()[: MAX_BYTES + 1]
    except (OSError, ValueError):
        return read_text(path, CalibrationError)
    encoding = "utf-16" if head.startswith((b"\xff\xfe", b"\xfe\xff")) else "cp1252"
    if len(head) > MAX_BYTES or (encoding == "cp1252" and _is_utf8(head)):
        return read_text(path, CalibrationError)
    try:
        return head.decode(encoding)
    except UnicodeDecodeError:
        raise CalibrationError("is no text", file=path, remedy="Save it as CSV (UTF-8)") from None


def _is_utf8(data: bytes) -> bool:
    try:
        data.decode("utf-8")
    except UnicodeDecodeError:
        return False
    return True


def _lines(path: Path) -> list[tuple[int, list[str]]]:
    """The rows of a table that are not blank, stripped, with the number of their line.

    Cells are separated by what stands most often in the first line: commas, semicolons or tabs;
    Excel's line ``sep=;`` says it too.
    """
    text = _text(path).replace("\r\n", "\n").replace("\r", "\n")
    said = re.match(r"\s*sep=(.)\n", text)
    if said:
        text = text[said.end() :]
    first = next((line for line in text.split("\n") if line.strip()), "")
    separator = said[1] if said else max(",;\t", key=first.count)
    reader = csv.reader(io.StringIO(text), skipinitialspace=True, delimiter=separator)
    try:
        lines = [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
    except csv.Error as fault:
        raise CalibrationError(
            f"is no CSV table: {fault}", file=path, key=f"line {reader.line_num}"
        ) from None
    return [(number, row) for number, row in lines if any(row)]


def _header(path: Path) -> list[str]:
    """The names of the columns, in small letters."""
    return next(([cell.lower() for cell in row] for _, row in _lines(path)), [])


def _rows(path: Path, columns: Sequence[str]) -> Iterator[tuple[str, list[float]]]:
    header, seen = _header(path), set[str]()
    for column in ("name", *columns):
        if column not in header:
            raise CalibrationError(
                f"column is missing{nearest_word(column, header)}", file=path, key=column
            )
    for number, row in _lines(path)[1:]:
        cells = dict.fromkeys(header, "") | dict(zip(header, row, strict=False))
        name = cells["name"]
        if name in seen:
            raise CalibrationError(f"name {name!r} is given twice", file=path, key=f"line {number}")
        seen.add(name)
        yield name, [_number(path, number, column, cells[column]) for column in columns]


def _number(path: Path, line: int, column: str, text: str) -> float:
    try:
        value = float(text.replace(",", ".") if _DECIMAL_COMMA.fullmatch(text) else text)
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise CalibrationError(f"{text!r} is not a number", file=path, key=f"line {line}, {column}")
    return value
