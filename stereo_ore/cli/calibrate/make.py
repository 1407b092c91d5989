"""``calibrate stereo``: a calibration from a recording of a board."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from stereo_ore.cli.calibrate.options import two_numbers, writing
from stereo_ore.errors import CalibrationError, FrameError

if TYPE_CHECKING:
    from stereo_ore.calibrate.board import BoardView
    from stereo_ore.calibrate.detect import Board
    from stereo_ore.io.recordings.base import Source
    from stereo_ore.types import U8, StereoPair

_log = logging.getLogger(__name__)

_TRIED = 3
"""Pairs in which a board of another size is looked for, when the one that was said is in none."""


def stereo(
    source: Annotated[Path, typer.Argument(help="Recorded pairs of a board, in any known layout.")],
    board: Annotated[str, typer.Option(help="Inner corners along the two sides: CxR.")],
    square_mm: Annotated[float, typer.Option(help="Side of a square, measured.")],
    out: Annotated[Path, typer.Option("--out", help="Native YAML to write.")],
    marker_mm: Annotated[float | None, typer.Option(help="ChArUco: side of a marker.")] = None,
    dictionary: Annotated[
        str, typer.Option(help="ChArUco: dictionary of cv2.aruco.")
    ] = "DICT_5X5_100",
    coefficients: Annotated[
        Literal["4", "5", "8"], typer.Option(help="Distortion coefficients.")
    ] = "5",
    picture: Annotated[Path | None, typer.Option(help="PNG of the coverage to write.")] = None,
    name: Annotated[str, typer.Option("--name", help="Free text for `camera`.")] = "",
) -> None:
    """Calibrate a camera from recorded pairs of a chessboard or ChArUco board.

    Example: `stereo-ore calibrate stereo recordings/board --board 9x6 --square-mm 25 --out
    calib/ours.yaml`
    """
    from dataclasses import replace

    from stereo_ore.calibrate.board import board_report, calibrate_stereo, draw_coverage
    from stereo_ore.io.calibration import save

    target = board_of(board, square_mm, marker_mm, dictionary)
    views, size = find_views(source, target)
    result = calibrate_stereo(views, target, size, int(coefficients))
    typer.echo(board_report(result))
    with writing(out):
        save(replace(result.calibration, camera=name or source.name), out)
    if picture is not None:
        with writing(picture):
            draw_coverage(result, picture)


def board_of(sides: str, square_mm: float, marker_mm: float | None, dictionary: str) -> Board:
    """The board that the options describe."""
    from stereo_ore.calibrate.detect import Board

    columns, rows = two_numbers(sides.lower(), "x", "--board")
    return Board(
        columns, rows, square_mm / 1000, None if marker_mm is None else marker_mm / 1000, dictionary
    )


def find_views(source: Path, board: Board) -> tuple[list[BoardView], tuple[int, int]]:
    """The board in each pair of a recording, and the size of its images."""
    from stereo_ore.calibrate.board import BoardView, find_view, one_layout
    from stereo_ore.io.recordings import open_source

    recording = open_source(source)
    views: list[BoardView] = []
    size: tuple[int, int] | None = None
    for index, name in enumerate(recording.names):
        _log.info("looking for the board in %s", name)
        try:
            pair = recording.read(index)
        except FrameError as fault:
            views.append(BoardView(name, reason=str(fault)))
            continue
        height, width = pair.left.shape[:2]
        if size not in (None, (width, height)):
            views.append(
                BoardView(name, reason=f"images of {width}×{height} px, the others have {size}")
            )
            continue
        size = width, height
        views.append(find_view(name, *_grey(pair), board))
    if size is None:
        raise CalibrationError("holds no pair that can be read", file=source)
    if not any(view.corners for view in views):
        _refuse_squares(recording, board)
    views = one_layout(views)
    if any(view.legacy for view in views):
        _log.info("the board has the ChArUco layout of OpenCV before 4.6")
    return views, size


def _refuse_squares(recording: Source, board: Board) -> None:
    """Say so where a board of one corner less or more each way is seen: squares were counted, or
    too few corners.

    Raises
    ------
    CalibrationError
        With the board that is seen.
    """
    from dataclasses import replace

    from stereo_ore.calibrate.board import find_view

    for step, remark in ((-1, ", one less than squares"), (1, "")):
        columns, rows = board.columns + step, board.rows + step
        if min(columns, rows) < 3 or (board.marker_m is None and columns == rows):
            continue
        other = replace(board, columns=columns, rows=rows)
        for index, name in enumerate(recording.names[:_TRIED]):
            if find_view(name, *_grey(recording.read(index)), other).corners is not None:
                raise CalibrationError(
                    f"no board of {board.columns}x{board.rows} inner corners is seen, but one of"
                    f" {columns}x{rows}",
                    key="--board",
                    remedy=f"Count inner corners{remark}: --board {columns}x{rows}",
                )


def _grey(pair: StereoPair) -> tuple[U8, U8]:
    import cv2
    import numpy as np

    left, right = (
        np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
        for image in (pair.left, pair.right)
    )
    return left, right
