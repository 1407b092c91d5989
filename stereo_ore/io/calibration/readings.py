"""What tables of arm poses usually hold, and which of it fits the board: Euler angles, degrees,
inverses, units.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration.geometry import UNITS_M, rotation_matrix
from stereo_ore.transforms import inverse, nearest_rotation
from stereo_ore.types import F64

SAME_UNIT = 0.05
"""Share by which a fitted scale may differ from a unit's."""

SAME_TURNS_RAD = 0.05
"""A reading whose turns differ by more from the board's on average is none."""

_NAMES = {
    "rotvec": "rotation vectors",
    "xyzw": "quaternions x y z w",
    "wxyz": "quaternions with w first",
    "inverse": "arm_from_tool was inverted: poses of the base seen from the tool",
}
_ORDERS = ("xyz", "xzy", "yxz", "yzx", "zxy", "zyx")
"""R is the product of the turns about the columns' axes in this order: zyx =
Rz(rz)·Ry(ry)·Rx(rx)."""


@dataclass(frozen=True)
class PoseTable:
    """Poses as a table has them: names, places (N, 3), rotation columns (N, 3) or quaternions (N,
    4).
    """

    names: tuple[str, ...]
    places: F64
    rotations: F64


@dataclass(frozen=True)
class Reading:
    """How the numbers of a table are meant; `mirror` is the axis whose sign is turned in a
    left-handed table.
    """

    rotation: str = ""
    inverse: bool = False
    unit: str = "m"
    mirror: str = ""

    @property
    def code(self) -> str:
        """The value of ``--table`` that stands for it."""
        unit = () if self.unit == "m" else (self.unit,)
        return ",".join([self.rotation, *(["inverse"] if self.inverse else []), *unit])

    @property
    def words(self) -> str:
        """What the table holds, in words."""
        kind, _, unit = self.rotation.partition("-")
        if kind in _NAMES:
            text = _NAMES[kind] + (
                f" in {'degrees' if unit == 'deg' else 'radians'}" if unit else ""
            )
        else:
            turns = "·".join(f"R{axis}" for axis in kind.removesuffix("r"))
            columns = "columns z, y, x" if kind.endswith("r") else "columns x, y, z"
            text = (
                f"Euler angles in {'degrees' if unit == 'deg' else 'radians'}, {turns} ({columns})"
            )
        text += f"; {_NAMES['inverse']}" if self.inverse else ""
        text += f"; {self.unit} for metres" if self.unit != "m" else ""
        return text + (
            f"; left-handed axes (turn the sign of {self.mirror})" if self.mirror else ""
        )


def parse_reading(code: str) -> Reading:
    """The reading of a ``--table`` value such as ``zyx-deg,inverse,mm``."""
    words = code.split(",")
    units = [word for word in words[1:] if word != "inverse"]
    if words[0] not in _codes() or len(units) > 1 or not set(units) <= UNITS_M.keys():
        remedy = (
            f"Use one of {', '.join(_codes())}, with inverse or a unit ({', '.join(UNITS_M)})"
            " behind commas"
        )
        raise CalibrationError(f"{code!r} is no reading of a table", key="--table", remedy=remedy)
    return Reading(words[0], "inverse" in words[1:], units[0] if units else "m")


def _codes() -> list[str]:
    euler = [
        f"{order}{end}-{unit}"
        for order in (*_ORDERS, "zyz", "zxz")
        for end in ("", "r")
        for unit in ("rad", "deg")
    ]
    return ["rotvec-rad", "rotvec-deg", *euler, "xyzw", "wxyz"]


def poses(table: PoseTable, reading: Reading) -> list[F64]:
    """``T_arm_tool`` of each row, read that way."""
    found = []
    mirror = np.diag([-1.0 if axis == reading.mirror else 1.0 for axis in "xyz"])
    for place, R in zip(table.places, _rotations(table.rotations, reading.rotation), strict=True):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = mirror @ R @ mirror, mirror @ place * UNITS_M[reading.unit]
        found.append(inverse(T) if reading.inverse else T)
    return found


def _rotations(values: F64, code: str) -> list[F64]:
    """The rotations (3, 3) of rows, read as `code` says."""
    kind, _, unit = code.partition("-")
    if kind in ("xyzw", "wxyz"):
        order = [0, 1, 2, 3] if kind == "xyzw" else [1, 2, 3, 0]
        return [from_quaternion(row[order]) for row in values]
    angles = np.radians(values) if unit == "deg" else values
    if kind == "rotvec":
        return [rotation_matrix(row) for row in angles]
    return [
        _euler(row[::-1] if kind.endswith("r") else row, kind.removesuffix("r")) for row in angles
    ]


def _euler(angles: F64, order: str) -> F64:
    """The product of turns about the axes in `order`; of the usual orders an angle belongs to its
    column's axis.
    """
    by_axis = len(set(order)) == 3
    R = np.eye(3)
    for place, axis in enumerate(order):
        vector = np.zeros(3)
        vector["xyz".index(axis)] = angles["xyz".index(axis) if by_axis else place]
        R = R @ rotation_matrix(vector)
    return R


def from_quaternion(q: F64) -> F64:
    """The rotation of a quaternion (x, y, z, w) of any length but zero."""
    x, y, z, w = q / np.linalg.norm(q)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + 2 * w * cross + 2 * cross @ cross, np.float64)


def fitting_readings(
    table: PoseTable, boards: Sequence[F64], fixed: bool
) -> Iterator[tuple[Reading, float]]:
    """Readings whose motions go with the board's, each with the root mean square of what is left
    [m].

    Parameters
    ----------
    table
        Rows in the order of `boards`.
    boards
        ``T_camera_board`` of each row.
    fixed
        Whether the camera stands still and the board is on the tool.
    """
    codes = [
        code for code in _codes() if ((code in ("xyzw", "wxyz")) == (table.rotations.shape[1] == 4))
    ]
    pairs = list(itertools.combinations(range(len(boards)), 2))
    turns = [(boards[j] @ inverse(boards[i])) for i, j in pairs]
    for code, inverted, mirror in itertools.product(codes, (False, True), ("", "y", "x", "z")):
        reading = Reading(code, inverted, "m", mirror)
        A = [inverse(T) if fixed else T for T in poses(table, reading)]
        fit = _fit([inverse(A[j]) @ A[i] for i, j in pairs], turns)
        if fit is None:
            continue
        scale, left = fit
        for unit, metres in UNITS_M.items():
            if abs(scale / metres - 1) < SAME_UNIT:
                yield Reading(code, inverted, unit, mirror), left


def _fit(A: Sequence[F64], B: Sequence[F64]) -> tuple[float, float] | None:
    """Scale of the arm's lengths, and residual [m], of A·X = X·B (Park & Martin 1994); None where
    the turns differ.
    """
    axes_A, axes_B = (np.array([_vector(T[:3, :3]) for T in side]) for side in (A, B))
    R = nearest_rotation(axes_A.T @ axes_B)
    if np.sqrt(((axes_A - axes_B @ R.T) ** 2).sum(1).mean()) > SAME_TURNS_RAD:
        return None
    left = np.concatenate([np.column_stack([T[:3, :3] - np.eye(3), T[:3, 3]]) for T in A])
    right = np.concatenate([R @ T[:3, 3] for T in B])
    solution = np.linalg.lstsq(left, right, rcond=None)[0]
    return float(solution[3]), float(np.sqrt(((left @ solution - right) ** 2).mean() * 3))


def _vector(R: F64) -> F64:
    import cv2

    return np.asarray(cv2.Rodrigues(R)[0], np.float64).ravel()
