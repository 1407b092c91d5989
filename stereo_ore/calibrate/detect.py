"""Corners of a calibration board in an image: chessboard or ChArUco."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from stereo_ore.errors import CalibrationError
from stereo_ore.types import F32, F64, I32, U8

FEWEST_CORNERS = 8
"""Of a ChArUco board that is seen in part."""


@dataclass(frozen=True)
class Board:
    """A flat board: inner corners along its two sides and the side of a square [m].

    `marker_m` [m] and `dictionary` (a name of ``cv2.aruco``) make it a ChArUco board.
    """

    columns: int
    rows: int
    square_m: float
    marker_m: float | None = None
    dictionary: str = "DICT_5X5_100"
    legacy: bool = False
    """ChArUco in the layout of OpenCV before 4.6, which differs for an even number of rows of
    squares."""

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3 or self.square_m <= 0:
            problem = (
                f"a board of {self.columns}×{self.rows} inner corners with squares of"
                f" {self.square_m} m"
            )
            raise CalibrationError(
                problem, key="board", remedy="Needed: at least 3×3 and a positive size in metres"
            )
        if self.marker_m is None and self.columns == self.rows:
            problem = "a chessboard with as many columns as rows can be read in four ways"
            raise CalibrationError(
                problem, key="board", remedy="Use a board with unequal sides, or ChArUco"
            )
        if self.marker_m is not None and not 0 < self.marker_m < self.square_m:
            problem = (
                f"a marker of {self.marker_m} m does not fit into a square of {self.square_m} m"
            )
            raise CalibrationError(problem, key="board.marker_m")
        if not (self.dictionary.startswith("DICT_") and hasattr(cv2.aruco, self.dictionary)):
            raise CalibrationError(
                f"{self.dictionary!r} is no dictionary of cv2.aruco", key="board.dictionary"
            )

    @property
    def points(self) -> F64:
        """The corners on the board, row by row, (columns·rows, 3) [m]."""
        grid = np.mgrid[0 : self.rows, 0 : self.columns].reshape(2, -1)[::-1].T
        return np.column_stack([grid * self.square_m, np.zeros(len(grid))])

    @property
    def has_one_reading(self) -> bool:
        """Whether the board turned by 180° looks different (odd columns + rows, or ChArUco)."""
        return self.marker_m is not None or (self.columns + self.rows) % 2 == 1

    @property
    def layouts(self) -> tuple[Board, ...]:
        """The board as given and, where that is another one, in the older layout."""
        has_two = self.marker_m is not None and self.rows % 2 == 1 and not self.legacy
        return (self, replace(self, legacy=True)) if has_two else (self,)


LEAST_SIDE_PX = 32
"""OpenCV's detectors fail in smaller images, which no board is seen in."""


@dataclass(frozen=True)
class Corners:
    """Which corners of `Board.points` were found, (N,), and where, (N, 2) [px]."""

    ids: I32
    px: F64


def find_corners(gray: U8, board: Board) -> Corners | None:
    """Corners of a board in a grey image, refined below a pixel; None when it is not (wholly) seen.

    Of a chessboard, OpenCV's two detectors and their refinements are tried, since neither finds all
    boards; what fits a plane best is taken.
    """
    if min(gray.shape) < LEAST_SIDE_PX:
        return None
    if board.marker_m is not None:
        return _charuco(gray, board, board.marker_m)
    found = [_oriented(gray, px, board) for px in _chessboard(gray, board)]
    if not found:
        return None
    best = min(found, key=lambda px: plane_residual(px, board))
    return Corners(np.arange(len(best), dtype=np.int32), best)


def same_reading(left: Corners, right: Corners, board: Board) -> Corners:
    """The right corners in the order of the left ones, where the board alone does not tell its two
    ends.
    """
    if board.has_one_reading:
        return right
    turned = Corners(right.ids, right.px[::-1].copy())
    centred = left.px - left.px.mean(0)
    return min((right, turned), key=lambda c: float(np.abs(c.px - c.px.mean(0) - centred).sum()))


def plane_residual(px: F64, board: Board) -> float:
    """Root mean square distance [px] of all corners from the best perspective picture of the flat
    board.
    """
    H, _ = cv2.findHomography(board.points[:, :2], px)
    if H is None:
        return float("inf")
    seen = cv2.perspectiveTransform(board.points[None, :, :2], np.asarray(H, np.float64))[0]
    return float(np.sqrt(((seen - px) ** 2).sum(1).mean()))


def _chessboard(gray: U8, board: Board) -> list[F64]:
    """Candidates (columns·rows, 2) [px] of both detectors, as found and refined.

    The newer one places corners a quarter of a pixel beside themselves in an image that it has
    normalised; it does so only where it finds nothing otherwise.
    """
    size = (board.columns, board.rows)
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    found_old, old = cv2.findChessboardCorners(gray, size, flags=flags)
    thorough = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    found_new, new = cv2.findChessboardCornersSB(gray, size, flags=thorough)
    if not found_new:
        found_new, new = cv2.findChessboardCornersSB(
            gray, size, flags=thorough | cv2.CALIB_CB_NORMALIZE_IMAGE
        )
    candidates = [np.asarray(new, np.float64).reshape(-1, 2)] if found_new else []
    rough = [
        np.asarray(px, np.float32).reshape(-1, 2)
        for found, px in ((found_old, old), (found_new, new))
        if found
    ]
    return candidates + [_refine(gray, px, clear=1 / 3) for px in rough]


def _refine(gray: U8, px: F32, clear: float) -> F64:
    """Saddle points near the rough corners (N, 2); the window is `clear` times the distance of the
    nearest two.
    """
    apart = np.linalg.norm(px[:, None] - px[None], axis=2) + np.diag([np.inf] * len(px))
    half = int(np.clip(clear * apart.min(), 2, 11))
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-3)
    return np.asarray(
        cv2.cornerSubPix(gray, px.copy(), (half, half), (-1, -1), stop), np.float64
    ).reshape(-1, 2)


def _oriented(gray: U8, px: F64, board: Board) -> F64:
    """Corners row by row from the end where the first square is dark, seen from the printed
    side.
    """
    grid = px.reshape(board.rows, board.columns, 2)
    across, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if across[0] * down[1] - across[1] * down[0] < 0:
        grid = grid[:, ::-1]
    if board.has_one_reading and not _first_square_is_dark(gray, grid):
        grid = grid[::-1, ::-1]
    return grid.reshape(-1, 2).copy()


def _first_square_is_dark(gray: U8, grid: F64) -> bool:
    middles = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
    columns, rows = np.rint(middles).astype(int).reshape(-1, 2).T
    levels = gray[rows.clip(0, gray.shape[0] - 1), columns.clip(0, gray.shape[1] - 1)].reshape(
        middles.shape[:2]
    )
    first_kind = np.indices(levels.shape).sum(0) % 2 == 0
    return bool(levels[first_kind].mean() < levels[~first_kind].mean())


def _charuco(gray: U8, board: Board, marker_m: float) -> Corners | None:
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    size = (board.columns + 1, board.rows + 1)
    target = cv2.aruco.CharucoBoard(size, board.square_m, marker_m, dictionary)
    target.setLegacyPattern(board.legacy)
    detector = cv2.aruco.CharucoDetector(target)
    px, ids, _, _ = detector.detectBoard(gray)
    if ids is None or len(ids) < FEWEST_CORNERS:
        return None
    # OpenCV 4.10 gives these corners half a pixel off, 5.0 does not; the saddle points are the same
    # for both.
    refined = _refine(
        gray, np.asarray(px, np.float32).reshape(-1, 2), clear=(1 - marker_m / board.square_m) / 2
    )
    return Corners(np.asarray(ids, np.int32).ravel(), refined)
