"""``calibrate stereo`` and ``hand-eye``: calibrations from recordings."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from stereo_ore.cli.calibrate.options import Size, load_any, two_numbers, writing
from stereo_ore.errors import CalibrationError, FrameError

if TYPE_CHECKING:
    from stereo_ore.calibration.board import BoardView
    from stereo_ore.calibration.detect import Board
    from stereo_ore.calibration.hand_eye import ArmView
    from stereo_ore.calibration.touched import HandEyeResult
    from stereo_ore.sources.base import Source
    from stereo_ore.types import F64, U8, StereoPair

log = logging.getLogger(__name__)

_TRIED = 3
"""Pairs in which a board of another size is looked for, when the one that was said is in none."""


def stereo(
    source: Annotated[Path, typer.Argument(help="Recorded pairs of a board, in any known layout.")],
    board: Annotated[str, typer.Option(help="Inner corners along the two sides: CxR.")],
    square_mm: Annotated[float, typer.Option(help="Side of a square, measured.")],
    out: Annotated[Path, typer.Option("--out", help="Native YAML to write.")],
    marker_mm: Annotated[float | None, typer.Option(help="ChArUco: side of a marker.")] = None,
    dictionary: Annotated[str, typer.Option(help="ChArUco: dictionary of cv2.aruco.")] = "DICT_5X5_100",
    coefficients: Annotated[Literal["4", "5", "8"], typer.Option(help="Distortion coefficients.")] = "5",
    picture: Annotated[Path | None, typer.Option(help="PNG of the coverage to write.")] = None,
    name: Annotated[str, typer.Option("--name", help="Free text for `camera`.")] = "",
) -> None:
    """Calibrate a camera from recorded pairs of a chessboard or ChArUco board.

    Example: `stereo-ore calibrate stereo recordings/board --board 9x6 --square-mm 25 --out calib/ours.yaml`
    """
    from dataclasses import replace

    from stereo_ore.calibration import save
    from stereo_ore.calibration.board import calibrate_stereo, draw_coverage, report

    target = _board(board, square_mm, marker_mm, dictionary)
    views, size = _views(source, target)
    result = calibrate_stereo(views, target, size, int(coefficients))
    typer.echo(report(result))
    with writing(out):
        save(replace(result.calibration, camera=name or source.name), out)
    if picture is not None:
        with writing(picture):
            draw_coverage(result, picture)


def hand_eye(
    calib: Annotated[Path, typer.Option("--calib", help="Calibration of the camera, in any known format.")],
    out: Annotated[Path, typer.Option("--out", help="Site YAML to write.")],
    source: Annotated[Path | None, typer.Argument(help="With --poses: recorded pairs of the board.")] = None,
    points: Annotated[Path | None, typer.Option(help="CSV of touched points.")] = None,
    poses: Annotated[Path | None, typer.Option(help="CSV of the arm's pose for each pair.")] = None,
    board: Annotated[str | None, typer.Option(help="Inner corners along the two sides: CxR.")] = None,
    square_mm: Annotated[float | None, typer.Option(help="Side of a square, measured.")] = None,
    marker_mm: Annotated[float | None, typer.Option(help="ChArUco: side of a marker.")] = None,
    dictionary: Annotated[str, typer.Option(help="ChArUco: dictionary of cv2.aruco.")] = "DICT_5X5_100",
    mount: Annotated[Literal["fixed", "tool"], typer.Option(help="Where the camera is.")] = "fixed",
    size: Size = None,
    site: Annotated[Path | None, typer.Option(help="Site file to take the rest from.")] = None,
    limit_mm: Annotated[float, typer.Option(help="Exit code 3 when the residual (RMS) is greater.")] = 50.0,
) -> None:
    """Find where the camera is in the arm's frame, from touched points or from poses with a board.

    Example: `stereo-ore calibrate hand-eye --points touched.csv --calib ours.yaml --site site.yaml --out new.yaml`
    """
    from stereo_ore.calibration.hand_eye import fit_hand_eye
    from stereo_ore.calibration.tables import read_poses, read_touched
    from stereo_ore.calibration.touched import fit_touched
    from stereo_ore.cli import EXIT_QUALITY

    calibration = load_any(calib, None, size, None, None)
    if points is not None:
        result = fit_touched(read_touched(points), calibration)
    elif poses is not None and source is not None and board is not None and square_mm is not None:
        target = _board(board, square_mm, marker_mm, dictionary)
        result = fit_hand_eye(_arm_views(source, target, read_poses(poses)), target, calibration, mount)
    else:
        raise typer.BadParameter("give --points, or SOURCE with --poses, --board and --square-mm")
    _write_site(result, out, site)
    if result.rms_mm > limit_mm:
        raise typer.Exit(EXIT_QUALITY)


def _board(sides: str, square_mm: float, marker_mm: float | None, dictionary: str) -> Board:
    from stereo_ore.calibration.detect import Board

    columns, rows = two_numbers(sides.lower(), "x", "--board")
    return Board(columns, rows, square_mm / 1000, None if marker_mm is None else marker_mm / 1000, dictionary)


def _views(source: Path, board: Board) -> tuple[list[BoardView], tuple[int, int]]:
    """The board in each pair of a recording, and the size of its images."""
    from stereo_ore.calibration.board import BoardView, find_view, one_layout
    from stereo_ore.sources import open_source

    recording = open_source(source)
    views: list[BoardView] = []
    size: tuple[int, int] | None = None
    for index, name in enumerate(recording.names):
        log.info("looking for the board in %s", name)
        try:
            pair = recording.read(index)
        except FrameError as fault:
            views.append(BoardView(name, reason=str(fault)))
            continue
        height, width = pair.left.shape[:2]
        if size not in (None, (width, height)):
            views.append(BoardView(name, reason=f"images of {width}×{height} px, the others have {size}"))
            continue
        size = width, height
        views.append(find_view(name, *_grey(pair), board))
    if size is None:
        raise CalibrationError("holds no pair that can be read", file=source)
    if not any(view.corners for view in views):
        _refuse_squares(recording, board)
    views = one_layout(views)
    if any(view.legacy for view in views):
        log.info("the board has the ChArUco layout of OpenCV before 4.6")
    return views, size


def _refuse_squares(recording: Source, board: Board) -> None:
    """Say so where a board of one corner less or more each way is seen: squares were counted, or too few corners.

    Raises
    ------
    CalibrationError
        With the board that is seen.
    """
    from dataclasses import replace

    from stereo_ore.calibration.board import find_view

    for step, remark in ((-1, ", one less than squares"), (1, "")):
        columns, rows = board.columns + step, board.rows + step
        if min(columns, rows) < 3 or (board.marker_m is None and columns == rows):
            continue
        other = replace(board, columns=columns, rows=rows)
        for index, name in enumerate(recording.names[:_TRIED]):
            if find_view(name, *_grey(recording.read(index)), other).corners is not None:
                raise CalibrationError(
                    f"no board of {board.columns}x{board.rows} inner corners is seen, but one of {columns}x{rows}",
                    key="--board",
                    remedy=f"Count inner corners{remark}: --board {columns}x{rows}",
                )


def _grey(pair: StereoPair) -> tuple[U8, U8]:
    import cv2
    import numpy as np

    left, right = (np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8) for image in (pair.left, pair.right))
    return left, right


def _arm_views(source: Path, board: Board, poses: dict[str, F64]) -> list[ArmView]:
    """The pairs of a recording in which both eyes see the board and whose pose is known."""
    from stereo_ore.calibration.hand_eye import ArmView

    if not board.has_one_reading:
        problem = "a chessboard whose columns and rows add to an even number looks the same turned by 180°"
        raise CalibrationError(problem, key="--board", remedy="Use one with an odd sum (9x6), or ChArUco")
    views, _ = _views(source, board)
    for view in views:
        if view.name not in poses:
            log.warning("%s: no pose in the table", view.name)
        elif view.corners is None:
            log.warning("%s: %s", view.name, view.reason)
    return [
        ArmView(view.name, poses[view.name], *view.corners)
        for view in views
        if view.corners is not None and view.name in poses
    ]


def _write_site(result: HandEyeResult, out: Path, base: Path | None) -> None:
    """Print the residuals and write the site."""
    from stereo_ore.site import HandEyeRecord, save_arm

    for name, residual, used in zip(result.names, result.residual_mm, result.used, strict=True):
        typer.echo(f"{name:<20} {residual:8.1f} mm{'' if used else '  dropped: does not agree with the others'}")
    used_count = int(result.used.sum())
    typer.echo(
        f"\n{used_count} of {len(result.names)} used, RMS {result.rms_mm:.1f} mm, greatest {result.max_mm:.1f} mm"
    )
    record = HandEyeRecord(
        method=result.method,
        used=used_count,
        dropped=result.dropped,
        rms_mm=round(result.rms_mm, 3),
        max_mm=round(result.max_mm, 3),
    )
    with writing(out):
        save_arm(result.T_arm_camera, record, out, base)
