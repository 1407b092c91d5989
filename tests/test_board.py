"""Stereo calibration from boards: simulated corners, rendered boards, the real set."""

import subprocess
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from rigs import SIZE, SMALL, example_rig, rectified_to_raw, rendered, rendered_pair

from stereo_ore.calibrate.board import (
    BoardView,
    board_report,
    calibrate_stereo,
    draw_coverage,
    find_view,
)
from stereo_ore.calibrate.detect import Board, Corners, find_corners, plane_residual
from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration import load
from stereo_ore.io.calibration.geometry import from_vector
from stereo_ore.transforms import transform_points
from stereo_ore.types import F64

BOARD = Board(9, 6, 0.04)
CHARUCO = Board(7, 5, 0.05, 0.037)


def poses(count: int, seed: int = 0) -> list[F64]:
    """``T_camera_board`` of boards at many places and tilts."""
    rng = np.random.default_rng(seed)
    turns = rng.uniform(-0.6, 0.6, (count, 3)) * (1, 1, 0.5)
    places = rng.uniform((-0.5, -0.25, 0.5), (0.3, 0.15, 1.2), (count, 3))
    return [from_vector(np.concatenate(pose)) for pose in zip(turns, places, strict=True)]


def simulated(count: int, noise_px: float, seed: int = 0) -> list[BoardView]:
    rng = np.random.default_rng(seed)
    views: list[BoardView] = []
    for T in poses(40 * count, seed):
        eyes = rectified_to_raw(example_rig(), transform_points(T, BOARD.points))
        if all(((px > 0) & (px < SIZE)).all() for px in eyes) and len(views) < count:
            noisy = [px + rng.normal(0, noise_px, px.shape) for px in eyes]
            left, right = (Corners(np.arange(len(px), dtype=np.int32), px) for px in noisy)
            views.append(BoardView(f"view {len(views)}", (left, right)))
    assert len(views) == count
    return views


def test_simulated_views_give_the_camera_back() -> None:
    truth, result = example_rig(), calibrate_stereo(simulated(15, 0.1), BOARD, SIZE)
    found = result.calibration
    assert np.linalg.norm(found.t_right_left - truth.t_right_left) < 0.0005
    assert np.abs(found.R_right_left - truth.R_right_left).max() < 1e-3
    assert found.left.focal_px == pytest.approx(truth.left.focal_px, rel=2e-3)
    assert result.rms_px == pytest.approx(0.1 * np.sqrt(2), rel=0.15)
    assert result.vertical_rms_px < 0.2
    assert len(result.used) == 15


@pytest.mark.parametrize(("coefficients", "length"), [(4, 4), (5, 5), (8, 8)])
def test_the_distortion_model_is_a_choice(coefficients: int, length: int) -> None:
    result = calibrate_stereo(simulated(8, 0.05), BOARD, SIZE, coefficients)
    assert len(result.calibration.left.distortion) == length
    assert result.rms_px < 0.1


def test_a_view_that_moved_between_the_eyes_is_dropped_by_name() -> None:
    views = simulated(12, 0.1)
    left, right = views[4].corners
    views[4] = replace(views[4], corners=(left, Corners(right.ids, right.px + np.array([6, 9]))))
    result = calibrate_stereo(views, BOARD, SIZE)
    assert [view.name for view in result.views if not view.used] == ["view 4"]
    assert "moving" in result.views[4].reason
    assert "view 4" in board_report(result)
    assert result.rms_px < 0.2


def test_too_few_views_are_an_error_that_says_why() -> None:
    views = [*simulated(4, 0.1), BoardView("dark", reason="no board found in the left image")]
    with pytest.raises(CalibrationError, match=r"4 of 5 views.*dark: no board found"):
        calibrate_stereo(views, BOARD, SIZE)


def test_the_coverage_picture_is_written(tmp_path: Path) -> None:
    result = calibrate_stereo(simulated(6, 0.1), BOARD, SIZE)
    draw_coverage(result, tmp_path / "coverage.png")
    assert cv2.imread(str(tmp_path / "coverage.png")).shape == (720, 2560, 3)
    assert 0.1 < min(result.coverage) <= 1


@pytest.mark.parametrize(
    ("fields", "word"),
    [
        ((9, 9, 0.03), "four ways"),
        ((2, 6, 0.03), "2×6"),
        ((9, 6, 0.0), "positive"),
        ((9, 6, 0.03, 0.04), "marker"),
        ((9, 6, 0.03, 0.02, "DICT_NONE"), "DICT_NONE"),
    ],
)
def test_an_impossible_board_is_refused(fields: tuple[object, ...], word: str) -> None:
    with pytest.raises(CalibrationError, match=word):
        Board(*fields)


@pytest.mark.parametrize("board", [BOARD, CHARUCO], ids=["chessboard", "charuco"])
@pytest.mark.parametrize("turn", [0.0, np.pi / 2, np.pi, -2.0])
def test_corners_are_found_in_order_whatever_the_turn(board: Board, turn: float) -> None:
    T = from_vector(np.array([0, 0, turn, 0, 0, 0.0])) @ from_vector(
        np.array([0.2, -0.25, 0, -0.18, -0.12, 0])
    )
    T[2, 3] += 0.6
    image, truth = rendered(board, T)
    corners = find_corners(image, board)
    assert corners is not None
    assert np.abs(corners.px - truth[corners.ids]).max() < 0.3
    assert (
        len(corners.ids) >= (1.0 if board.marker_m is None else 0.85) * board.columns * board.rows
    )


def test_corners_of_sharp_boards_lie_within_a_twentieth_of_a_pixel() -> None:
    """An image that is normalised first moves them by a quarter of a pixel."""
    errors = []
    for turn in (0.0, np.pi / 2, np.pi, -2.0):
        T = from_vector(np.array([0, 0, turn, 0, 0, 0.0])) @ from_vector(
            np.array([0.2, -0.25, 0, -0.18, -0.12, 0])
        )
        T[2, 3] += 0.6
        image, truth = rendered(BOARD, T)
        corners = find_corners(image, BOARD)
        assert corners is not None
        errors.append(corners.px - truth[corners.ids])
    assert np.sqrt((np.concatenate(errors) ** 2).sum(1).mean()) < 0.05


def test_no_board_and_half_a_board(tmp_path: Path) -> None:
    T = from_vector(np.array([0.2, -0.2, 0, -0.18, -0.12, 0.6]))
    image, truth = rendered(CHARUCO, T)
    image[:, : int(np.median(truth[:, 0]))] = 150
    part = find_corners(image, CHARUCO)
    assert part is not None
    assert 8 <= len(part.ids) < 35
    assert np.abs(part.px - truth[part.ids]).max() < 0.3
    empty = np.full((480, 640), 128, np.uint8)
    view = find_view("empty", rendered(BOARD, T)[0], empty, BOARD)
    assert (view.used, view.reason) == (False, "no board found in the right image")
    assert plane_residual(truth + np.array([3, 0]) * (np.arange(35) % 2)[:, None], CHARUCO) > 1


def test_rendered_charuco_pairs_give_the_camera_back() -> None:
    turns = (
        (0.5, 0, 0),
        (-0.5, 0, 0.2),
        (0, 0.5, 0),
        (0, -0.5, -0.2),
        (0.4, 0.4, 0),
        (-0.4, 0.4, 0),
        (0.3, -0.4, 0.1),
    )
    shifts = ((0, 0), (-0.1, 0.05), (0.1, 0.05), (-0.1, -0.05), (0.1, -0.05), (0.05, 0), (-0.05, 0))
    views = []
    for index, (turn, shift) in enumerate(zip(turns, shifts, strict=True)):
        T = from_vector(np.array([*turn, shift[0] - 0.13, shift[1] - 0.1, 0.55 + 0.05 * index]))
        views.append(find_view(f"view {index}", *rendered_pair(CHARUCO, T), CHARUCO))
    result = calibrate_stereo(views, CHARUCO, SMALL, 4)
    assert result.rms_px < 0.15
    assert len(result.used) == 7
    assert -result.calibration.t_right_left[0] == pytest.approx(0.12, abs=0.001)
    assert result.calibration.left.focal_px[0] == pytest.approx(520, rel=0.01)


def test_the_real_set_of_boards(shared_data: Path, tmp_path: Path) -> None:
    out, picture = tmp_path / "camera.yaml", tmp_path / "coverage.png"
    line = [
        "stereo-ore",
        "calibrate",
        "stereo",
        shared_data / "boards/opencv",
        "--board",
        "9x6",
        "--square-mm",
        "25",
    ]
    done = subprocess.run(
        [*line, "--out", out, "--picture", picture], capture_output=True, text=True, check=True
    )
    assert "13 of 13 views used" in done.stdout
    rms = float(done.stdout.partition("reprojection RMS ")[2].split()[0])
    assert rms <= 0.22
    found = load(out)
    assert 1000 * np.linalg.norm(found.t_right_left) == pytest.approx(83.2, abs=0.5)
    assert found.image_size == (640, 480)
    assert picture.exists()
