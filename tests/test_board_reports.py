"""Boards that people have: ChArUco of the layout before OpenCV 4.6, and squares counted instead of
inner corners."""

from pathlib import Path

import numpy as np
import pytest

from stereo_ore.calibrate.board import calibrate_stereo
from stereo_ore.calibrate.check_report import _metres
from stereo_ore.calibrate.detect import Board
from stereo_ore.cli.calibrate.make import find_views
from stereo_ore.errors import CalibrationError


@pytest.mark.parametrize(
    ("folder", "board", "tolerance_mm"),
    [
        ("surprises/opencv-01-charuco-legacy", Board(7, 5, 0.030, 0.022), 1.0),
        pytest.param(
            "reports/13-charuco-legacy/legacy_7x6",
            Board(6, 5, 0.040, 0.030),
            0.5,
            marks=pytest.mark.slow,
        ),
    ],
    ids=["opencv-01-charuco-legacy", "13-charuco-legacy"],
)
def test_both_layouts_of_charuco_boards_are_tried(
    folder: str, board: Board, tolerance_mm: float, shared_data: Path
) -> None:
    views, size = find_views(shared_data / folder, board)
    assert all(view.legacy for view in views)
    result = calibrate_stereo(views, board, size, 4)
    assert len(result.used) == len(views)
    assert 1000 * np.linalg.norm(result.calibration.t_right_left) == pytest.approx(
        120, abs=tolerance_mm
    )


def test_a_board_has_two_layouts_only_with_an_even_number_of_rows_of_squares() -> None:
    assert [layout.legacy for layout in Board(7, 5, 0.03, 0.02).layouts] == [False, True]
    assert len(Board(7, 6, 0.03, 0.02).layouts) == 1
    assert len(Board(7, 6, 0.03).layouts) == 1


@pytest.mark.slow
def test_squares_counted_instead_of_inner_corners(shared_data: Path) -> None:
    with pytest.raises(CalibrationError, match=r"--board 9x6"):
        find_views(shared_data / "reports2/01-handeye-angles/board", Board(10, 7, 0.04))


def test_a_distance_that_is_none_is_a_word() -> None:
    assert _metres(float("nan")) == "beyond infinity"
    assert _metres(2.5) == "2.50 m"
