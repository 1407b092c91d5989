"""Stereo calibration from views of a board: both cameras, their pose, and how good they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from stereo_ore.calibrate.detect import Board, Corners, find_corners, same_reading
from stereo_ore.calibrate.points import rectify_points
from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration.geometry import make_calibration
from stereo_ore.types import F64, U8, CameraModel, StereoCalibration

FEWEST_VIEWS = 5
_OUTLIER_FACTOR = 3.0
OUTLIER_FLOOR_PX = 0.5
"""A view is dropped when its error exceeds OUTLIER_FACTOR medians and this floor."""

_MODEL_FLAGS = {4: cv2.CALIB_FIX_K3, 5: 0, 8: cv2.CALIB_RATIONAL_MODEL}


@dataclass(frozen=True)
class BoardView:
    """One pair of images: the corners that both eyes see, ids (N,), pixels (N, 2); or why there are
    none.

    `legacy`: they were found in the ChArUco layout of OpenCV before 4.6.
    """

    name: str
    corners: tuple[Corners, Corners] | None = None
    reason: str = ""
    legacy: bool = False
    left_rms_px: float = float("nan")
    right_rms_px: float = float("nan")
    vertical_rms_px: float = float("nan")

    @property
    def used(self) -> bool:
        """Whether the calibration rests on it."""
        return self.corners is not None and not self.reason

    @property
    def worst_px(self) -> float:
        """The error of the worse eye."""
        return max(self.left_rms_px, self.right_rms_px)


@dataclass(frozen=True)
class BoardResult:
    """The calibration and its witnesses.

    `rms_px` is the reprojection error over both eyes, `vertical_rms_px` the row difference of
    corresponding corners after rectification, `coverage` (2,) the share of each image in which
    corners were seen.
    """

    calibration: StereoCalibration
    views: tuple[BoardView, ...]
    rms_px: float
    vertical_rms_px: float
    coverage: tuple[float, float]

    @property
    def used(self) -> tuple[BoardView, ...]:
        """The views that the calibration rests on."""
        return tuple(view for view in self.views if view.used)


def find_view(name: str, left: U8, right: U8, board: Board) -> BoardView:
    """The board in a pair of grey images; of a ChArUco board, in the layout in which more corners
    are found.
    """
    trials = [_find_view(name, left, right, layout) for layout in board.layouts]
    return max(trials, key=lambda view: 0 if view.corners is None else len(view.corners[0].ids))


def _find_view(name: str, left: U8, right: U8, board: Board) -> BoardView:
    found = find_corners(left, board), find_corners(right, board)
    missing = [
        eye for eye, corners in zip(("left", "right"), found, strict=True) if corners is None
    ]
    if found[0] is None or found[1] is None:
        return BoardView(name, reason=f"no board found in the {' and '.join(missing)} image")
    ids, i, j = np.intersect1d(found[0].ids, found[1].ids, return_indices=True)
    if len(ids) < 6:
        return BoardView(name, reason=f"only {len(ids)} corners are seen by both eyes")
    lefts, rights = Corners(ids, found[0].px[i]), Corners(ids, found[1].px[j])
    return BoardView(name, (lefts, same_reading(lefts, rights, board)), legacy=board.legacy)


def one_layout(views: Sequence[BoardView]) -> list[BoardView]:
    """The views, without those in whose layout the fewer corners were found: a board has one
    layout.
    """
    corners = [
        sum(len(v.corners[0].ids) for v in views if v.corners and v.legacy is legacy)
        for legacy in (False, True)
    ]
    legacy = corners[1] > corners[0]
    reason = "corners fit the other layout of ChArUco boards only"
    return [
        (
            view
            if view.corners is None or view.legacy is legacy
            else BoardView(view.name, reason=reason)
        )
        for view in views
    ]


def calibrate_stereo(
    views: Sequence[BoardView], board: Board, image_size: tuple[int, int], coefficients: int = 5
) -> BoardResult:
    """Intrinsics of both eyes, then all together with their pose; outlying views dropped one after
    the other.

    Parameters
    ----------
    views
        From `find_view`; those without corners keep their reason.
    image_size
        Width and height [px].
    coefficients
        Of the distortion: 4 (k1 k2 p1 p2), 5 (and k3) or 8 (rational).

    Raises
    ------
    CalibrationError
        When fewer than `FEWEST_VIEWS` views are left.
    """
    kept = list(views)
    while True:
        used = [view for view in kept if view.used]
        if len(used) < FEWEST_VIEWS:
            raise CalibrationError(
                f"{len(used)} of {len(kept)} views can be used, {FEWEST_VIEWS} are needed",
                remedy="Record the board at more places, distances and tilts. "
                + "; ".join([f"{view.name}: {view.reason}" for view in kept if view.reason][:5]),
            )
        rms, calibration, errors = _solve(used, board, image_size, coefficients)
        rated = [
            replace(view, left_rms_px=float(left), right_rms_px=float(right))
            for view, (left, right) in zip(used, errors, strict=True)
        ]
        kept = _merge(kept, rated)
        limit = max(
            OUTLIER_FLOOR_PX, _OUTLIER_FACTOR * float(np.median([view.worst_px for view in rated]))
        )
        worst = max(rated, key=lambda view: view.worst_px)
        if worst.worst_px <= limit:
            break
        reason = (
            f"error {worst.worst_px:.2f} px, more than {limit:.2f} px; was the board or a camera"
            " moving?"
        )
        kept = _merge(kept, [replace(worst, reason=reason)])
    return _judge(calibration, kept, rms)


def _merge(views: Sequence[BoardView], changed: Sequence[BoardView]) -> list[BoardView]:
    news = {view.name: view for view in changed}
    return [news.get(view.name, view) for view in views]


def _solve(
    views: Sequence[BoardView], board: Board, size: tuple[int, int], coefficients: int
) -> tuple[float, StereoCalibration, F64]:
    """RMS [px], calibration, errors (views, 2) [px] of the least reprojection error."""
    corners = [view.corners for view in views if view.corners is not None]
    flat = [board.points[left.ids].astype(np.float32) for left, _ in corners]
    lefts, rights = ([pair[eye].px.astype(np.float32) for pair in corners] for eye in (0, 1))
    flags = _MODEL_FLAGS[coefficients]
    cameras = [
        cv2.calibrateCamera(flat, seen, size, None, None, flags=flags)[1:3]
        for seen in (lefts, rights)
    ]
    (K1, D1), (K2, D2) = cameras
    start = np.eye(3), np.zeros((3, 1))
    together = cv2.CALIB_USE_INTRINSIC_GUESS | flags
    solution = cv2.stereoCalibrateExtended(
        flat, lefts, rights, K1, D1, K2, D2, size, *start, flags=together
    )
    rms, (K1, D1, K2, D2, R, t) = (
        solution[0],
        (np.asarray(part, np.float64) for part in solution[1:7]),
    )
    calibration = make_calibration(
        "calibration from boards",
        image_size=size,
        left=_camera(K1, D1, coefficients),
        right=_camera(K2, D2, coefficients),
        rotation=R,
        translation_m=t,
        images="raw",
    )
    return float(rms), calibration, np.asarray(solution[-1], np.float64).reshape(len(views), 2)


def _camera(K: F64, D: F64, coefficients: int) -> CameraModel:
    distortion = tuple(float(k) for k in np.ravel(D)[:coefficients])
    return CameraModel(
        (float(K[0, 0]), float(K[1, 1])), (float(K[0, 2]), float(K[1, 2])), distortion
    )


def _judge(calibration: StereoCalibration, views: Sequence[BoardView], rms: float) -> BoardResult:
    judged = []
    for view in views:
        if view.corners is None:
            judged.append(view)
            continue
        left, right = rectify_points(calibration, *(corners.px for corners in view.corners))
        vertical = float(np.sqrt(np.mean((left[:, 1] - right[:, 1]) ** 2)))
        judged.append(replace(view, vertical_rms_px=vertical))
    used = [view for view in judged if view.used]
    overall = float(np.sqrt(np.mean([view.vertical_rms_px**2 for view in used])))
    coverage = (
        _coverage(used, 0, calibration.image_size),
        _coverage(used, 1, calibration.image_size),
    )
    return BoardResult(calibration, tuple(judged), rms, overall, coverage)


def _coverage(views: Sequence[BoardView], eye: int, size: tuple[int, int], cells: int = 8) -> float:
    """Share of `cells`² fields of the image that hold a corner."""
    px = np.concatenate([view.corners[eye].px for view in views if view.corners])
    field = (px / np.array(size) * cells).astype(int).clip(0, cells - 1)
    return len(np.unique(field, axis=0)) / cells**2


def draw_coverage(result: BoardResult, path: Path) -> None:
    """Write a PNG with the corners of all views in both images; dropped views in red."""
    width, height = result.calibration.image_size
    canvas = np.full((height, 2 * width, 3), 255, np.uint8)
    for index, view in enumerate(result.views):
        if view.corners is None:
            continue
        hue = np.array([[[(index * 37) % 180, 255 if view.used else 0, 190]]], np.uint8)
        colour = cv2.cvtColor(hue, cv2.COLOR_HSV2BGR)[0, 0].tolist() if view.used else [0, 0, 255]
        for eye in (0, 1):
            for x, y in view.corners[eye].px + np.array([eye * width, 0]):
                cv2.circle(
                    canvas, (round(x), round(y)), max(2, width // 320), colour, -1, cv2.LINE_AA
                )
    cv2.line(canvas, (width, 0), (width, height), (0, 0, 0), 2)
    path.write_bytes(cv2.imencode(".png", canvas)[1].tobytes())


def board_report(result: BoardResult) -> str:
    """Lines of text: a row a view, then the sums."""
    rows = [f"{'view':<20} {'left px':>8} {'right px':>8} {'rows px':>8}"]
    for view in result.views:
        errors = (
            f"{view.left_rms_px:8.3f} {view.right_rms_px:8.3f} {view.vertical_rms_px:8.3f}"
            if view.corners
            else ""
        )
        rows.append(f"{view.name:<20} {errors}{f'  dropped: {view.reason}' if view.reason else ''}")
    baseline = 1000 * float(np.linalg.norm(result.calibration.t_right_left))
    rows += [
        "",
        f"{len(result.used)} of {len(result.views)} views used",
        (
            f"reprojection RMS {result.rms_px:.3f} px, rows after rectification"
            f" {result.vertical_rms_px:.3f} px"
        ),
        f"baseline {baseline:.2f} mm",
        "corners cover {:.0%} of the left and {:.0%} of the right image".format(*result.coverage),
    ]
    return "\n".join(rows)
