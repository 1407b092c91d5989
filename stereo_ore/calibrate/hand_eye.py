"""Hand-eye calibration from poses of the arm with a board: A·X·B = Y with X, Y unknown.

Camera fixed, board on the tool: A = T_tool_arm, X = T_arm_camera, Y = T_tool_board. Camera on the
tool, board on the ground: A = T_arm_tool, X = T_tool_camera, Y = T_arm_board. B = T_camera_board.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np

from stereo_ore.calibrate.detect import Board, Corners
from stereo_ore.calibrate.points import rectify_points, triangulate
from stereo_ore.calibrate.pose import fit_rigid, refine_pose
from stereo_ore.calibrate.touched import HandEyeResult
from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration.geometry import from_vector, to_vector
from stereo_ore.stages.rectify import make_rectifier
from stereo_ore.transforms import inverse, nearest_rotation, transform_points
from stereo_ore.types import F64, Rig, StereoCalibration

FEWEST_POSES = 3
LEAST_TURN_RAD = 0.1
"""Spread of the turns about the second axis; turns about one axis alone leave a shift along it
open."""

_OUTLIER_FACTOR = 4.0
OUTLIER_FLOOR_MM = 5.0
ROBUST_M = 0.001
"""Distance beyond which a corner pulls with a constant force, so that a wrong pose stands out from
the others."""

LIMIT_FACTOR = 6.0
"""A good fit leaves this many times the board's own residual at most; arms are less certain than
boards."""

HAND_EYE_METHODS = ("TSAI", "PARK", "HORAUD", "ANDREFF", "DANIILIDIS")

Mount = Literal["fixed", "tool"]


@dataclass(frozen=True)
class ArmView:
    """A pose of the arm, ``T_arm_tool``, with the board's corners as both eyes saw them there."""

    name: str
    T_arm_tool: F64
    left: Corners
    right: Corners


@dataclass(frozen=True)
class _Seen:
    """A and B of one pose, each (4, 4)."""

    A: F64
    B: F64


def fit_hand_eye(
    views: Sequence[ArmView], board: Board, calibration: StereoCalibration, mount: Mount = "fixed"
) -> HandEyeResult:
    """The camera's pose in the arm frame (`mount` fixed) or in the tool frame (`mount` tool).

    All closed-form methods at hand are tried; from the best, by the spread of the board's corners,
    the least spread is sought together with the board's own pose.

    Raises
    ------
    CalibrationError
        When there are fewer than three poses, or they turn about one axis only.
    """
    rig = make_rectifier(calibration).rig
    seen = [_see(view, board, calibration, rig, mount) for view in views]
    used = np.ones(len(seen), bool)
    while True:
        kept = [item for item, use in zip(seen, used, strict=True) if use]
        _check_poses(kept)
        X, method = _closed_form(kept, board)
        X, Y = _least_spread(X, _board_pose(X, kept, board), kept, board)
        spread = 1000 * _spread(X, Y, seen, board)
        limit = max(OUTLIER_FLOOR_MM, _OUTLIER_FACTOR * float(np.median(spread[used])))
        worst = int(np.argmax(np.where(used, spread, -1)))
        if spread[worst] <= limit:
            names = tuple(view.name for view in views)
            own = board_poses(views, board, calibration)[1]
            return HandEyeResult(
                X, f"{method}, least spread of the corners", names, spread, used, own
            )
        used = used & (np.arange(len(seen)) != worst)


def board_poses(
    views: Sequence[ArmView], board: Board, calibration: StereoCalibration
) -> tuple[list[F64], float]:
    """``T_camera_board`` of each view, and the residual [mm] that a good fit may have.

    That is `LIMIT_FACTOR` times the root mean square distance of the triangulated corners from the
    fitted board: what the images allow, whatever the arm says.
    """
    rig = make_rectifier(calibration).rig
    poses, squares = [], []
    for view in views:
        ids, i, j = np.intersect1d(view.left.ids, view.right.ids, return_indices=True)
        B = _see(view, board, calibration, rig, "tool").B
        seen = triangulate(calibration, view.left.px[i], view.right.px[j])
        squares.append(((transform_points(B, board.points[ids]) - seen) ** 2).sum(1))
        poses.append(B)
    return poses, (
        LIMIT_FACTOR * 1000 * float(np.sqrt(np.nanmean(np.concatenate(squares))))
        if squares
        else float("nan")
    )


def _see(
    view: ArmView, board: Board, calibration: StereoCalibration, rig: Rig, mount: Mount
) -> _Seen:
    ids, i, j = np.intersect1d(view.left.ids, view.right.ids, return_indices=True)
    corners = board.points[ids]
    left, right = rectify_points(calibration, view.left.px[i], view.right.px[j])
    K = np.array([[rig.fx, 0, rig.cx], [0, rig.fy, rig.cy], [0, 0, 1]])
    _, rotation, shift = cv2.solvePnP(corners, left, K, None)
    B = refine_pose(
        from_vector(np.concatenate([rotation, shift]).ravel()), corners, left, right, rig
    )
    A = inverse(view.T_arm_tool) if mount == "fixed" else view.T_arm_tool
    return _Seen(A, B)


def _check_poses(seen: Sequence[_Seen]) -> None:
    if len(seen) < FEWEST_POSES:
        remedy = "Move the arm to ten or more poses that show the board"
        raise CalibrationError(
            f"{len(seen)} poses, {FEWEST_POSES} are needed", key="poses", remedy=remedy
        )
    turns = np.array([to_vector(A)[:3] for A, _ in _motions(seen)])
    second = np.linalg.svd(turns, compute_uv=False)[1] / np.sqrt(len(turns))
    if second < LEAST_TURN_RAD:
        problem = (
            f"the poses turn about one axis only (about a second one by {np.degrees(second):.1f}°"
            " on average)"
        )
        raise CalibrationError(
            problem, key="poses", remedy="Tilt the tool about two different axes, by 20° and more"
        )


def _motions(seen: Sequence[_Seen]) -> list[tuple[F64, F64]]:
    """Relative motions (A', B') between all poses, for which A'·X = X·B'."""
    return [
        (inverse(second.A) @ first.A, second.B @ inverse(first.B))
        for i, first in enumerate(seen)
        for second in seen[i + 1 :]
    ]


def _closed_form(seen: Sequence[_Seen], board: Board) -> tuple[F64, str]:
    """X of the method with the least spread, and its name."""
    found = {"Park (own)": _park(seen)}
    if hasattr(cv2, "calibrateHandEye"):  # the Python of OpenCV 5.0.0 lacks it
        for name in HAND_EYE_METHODS:
            found[name.capitalize()] = _opencv(seen, name)
    rated = {
        name: float((_spread(X, _board_pose(X, seen, board), seen, board) ** 2).mean())
        for name, X in found.items()
        if np.isfinite(X).all()
    }
    best = min(rated, key=lambda name: rated[name])
    return found[best], best


def _park(seen: Sequence[_Seen]) -> F64:
    """Park & Martin 1994: the rotation from the axes of the motions, then the shift by least
    squares.
    """
    motions = _motions(seen)
    axes_A, axes_B = (np.array([to_vector(pair[side])[:3] for pair in motions]) for side in (0, 1))
    X = np.eye(4)
    X[:3, :3] = nearest_rotation(axes_A.T @ axes_B)
    left = np.concatenate([A[:3, :3] - np.eye(3) for A, _ in motions])
    right = np.concatenate([X[:3, :3] @ B[:3, 3] - A[:3, 3] for A, B in motions])
    X[:3, 3] = np.linalg.lstsq(left, right, rcond=None)[0]
    return X


def _opencv(seen: Sequence[_Seen], method: str) -> F64:
    A, B = (
        [(T[:3, :3], T[:3, 3]) for T in side]
        for side in zip(*((item.A, item.B) for item in seen), strict=True)
    )
    solve: Any = getattr(cv2, "calibrateHandEye")  # noqa: B009 - absent from the type stubs
    R, t = solve(
        *zip(*A, strict=True),
        *zip(*B, strict=True),
        method=getattr(cv2, f"CALIB_HAND_EYE_{method}"),
    )
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = R, np.ravel(t)
    return X


def _board_pose(X: F64, seen: Sequence[_Seen], board: Board) -> F64:
    """The mean of Y = A·X·B over the poses."""
    placed = np.mean([transform_points(item.A @ X @ item.B, board.points) for item in seen], axis=0)
    return fit_rigid(placed, board.points)


def _spread(X: F64, Y: F64, seen: Sequence[_Seen], board: Board) -> F64:
    """Root mean square distance [m] of the board's corners from where Y puts them, a number a
    pose.
    """
    at = transform_points(Y, board.points)
    away = [transform_points(item.A @ X @ item.B, board.points) - at for item in seen]
    return np.asarray(np.sqrt(np.square(away).sum(2).mean(1)), np.float64)


def _least_spread(X: F64, Y: F64, seen: Sequence[_Seen], board: Board) -> tuple[F64, F64]:
    """X and Y together, with the least (robust) distances of all corners.

    In metres of the arm, not in pixels: the arm's own poses are less certain than the board's in
    the images, and the simulated error of X is half of that with pixels.
    """
    from scipy.optimize import least_squares

    def error(vector: F64) -> F64:
        X_now, at = (
            X @ from_vector(vector[:6]),
            transform_points(Y @ from_vector(vector[6:]), board.points),
        )
        return np.concatenate(
            [
                (transform_points(item.A @ X_now @ item.B, board.points) - at).ravel()
                for item in seen
            ]
        )

    best = least_squares(error, np.zeros(12), loss="soft_l1", f_scale=ROBUST_M).x
    return X @ from_vector(best[:6]), Y @ from_vector(best[6:])
