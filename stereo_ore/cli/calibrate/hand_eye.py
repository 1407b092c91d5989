"""``calibrate hand-eye``: where the camera is in the arm's frame."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from stereo_ore.cli.calibrate.make import board_of, find_views
from stereo_ore.cli.calibrate.options import Size, load_any, writing
from stereo_ore.errors import CalibrationError

if TYPE_CHECKING:
    from stereo_ore.calibrate.detect import Board
    from stereo_ore.calibrate.hand_eye import ArmView, Mount
    from stereo_ore.calibrate.touched import HandEyeResult
    from stereo_ore.io.calibration.readings import PoseTable, Reading
    from stereo_ore.types import StereoCalibration

_log = logging.getLogger(__name__)


def hand_eye(
    calib: Annotated[
        Path, typer.Option("--calib", help="Calibration of the camera, in any known format.")
    ],
    out: Annotated[Path, typer.Option("--out", help="Site YAML to write.")],
    source: Annotated[
        Path | None, typer.Argument(help="With --poses: recorded pairs of the board.")
    ] = None,
    points: Annotated[Path | None, typer.Option(help="CSV of touched points.")] = None,
    poses: Annotated[Path | None, typer.Option(help="CSV of the arm's pose for each pair.")] = None,
    table: Annotated[
        str | None,
        typer.Option(help="What --poses holds, as the error names it: zyx-deg,mm and the like."),
    ] = None,
    board: Annotated[
        str | None, typer.Option(help="Inner corners along the two sides: CxR.")
    ] = None,
    square_mm: Annotated[float | None, typer.Option(help="Side of a square, measured.")] = None,
    marker_mm: Annotated[float | None, typer.Option(help="ChArUco: side of a marker.")] = None,
    dictionary: Annotated[
        str, typer.Option(help="ChArUco: dictionary of cv2.aruco.")
    ] = "DICT_5X5_100",
    mount: Annotated[Literal["fixed", "tool"], typer.Option(help="Where the camera is.")] = "fixed",
    size: Size = None,
    site: Annotated[Path | None, typer.Option(help="Site file to take the rest from.")] = None,
    limit_mm: Annotated[
        float | None,
        typer.Option(
            help=(
                "No site file and exit code 3 when the residual (RMS) is greater; else from the"
                " images."
            )
        ),
    ] = None,
) -> None:
    """Find where the camera is in the arm's frame, from touched points or from poses with a board.

    Example: `stereo-ore calibrate hand-eye --points touched.csv --calib ours.yaml --site site.yaml
    --out new.yaml`
    """
    from stereo_ore.calibrate.tables import read_pose_table, read_touched
    from stereo_ore.calibrate.touched import fit_touched
    from stereo_ore.cli import EXIT_QUALITY

    calibration = load_any(calib, None, size, None, None)
    why = ""
    if points is not None:
        if mount == "tool":
            raise typer.BadParameter("--mount tool needs --poses: touched points stand still")
        result: HandEyeResult | None = fit_touched(read_touched(points), calibration)
    elif poses is not None and source is not None and board is not None and square_mm is not None:
        target = board_of(board, square_mm, marker_mm, dictionary)
        result, why = _from_board(
            source, target, read_pose_table(poses), table, calibration, mount, limit_mm
        )
    else:
        raise typer.BadParameter("give --points, or SOURCE with --poses, --board and --square-mm")
    if result is not None:
        _show(result)
    if result is None or not _fits(result, limit_mm):
        _log.error("%s", why or _no_fit(result, limit_mm))
        raise typer.Exit(EXIT_QUALITY)
    _write_site(result, out, site, mount)


def _from_board(
    source: Path,
    board: Board,
    table: PoseTable,
    code: str | None,
    calibration: StereoCalibration,
    mount: Mount,
    limit_mm: float | None,
) -> tuple[HandEyeResult | None, str]:
    """The fit, if there is one; and, where it does not explain the poses, what the table seems to
    hold.
    """
    import numpy as np

    from stereo_ore.calibrate.hand_eye import board_poses, fit_hand_eye
    from stereo_ore.calibrate.touched import limit_from
    from stereo_ore.io.calibration.readings import Reading, parse_reading

    views = _arm_views(source, board, table)
    used = [index for index, _ in views]
    rows = type(table)(
        tuple(table.names[i] for i in used), table.places[used], table.rotations[used]
    )
    default = "xyzw" if rows.rotations.shape[1] == 4 else "rotvec-rad"
    reading = parse_reading(code) if code else Reading(default)
    result, fault = None, None
    degrees = (
        reading.rotation.endswith("-rad") and np.abs(rows.rotations).max(initial=0) > 2 * np.pi
    )
    if not degrees:
        try:
            result = fit_hand_eye(_posed(views, rows, reading), board, calibration, mount)
        except CalibrationError as refusal:
            fault = refusal
    if result is not None and _fits(result, limit_mm):
        return result, ""
    boards, own_mm = board_poses(_posed(views, rows, reading), board, calibration)
    why = _explain(rows, boards, limit_mm or limit_from(own_mm), mount, reading)
    if not why and degrees:
        why = (
            "numbers beyond 2π in columns of radians: are they degrees? No reading of the table"
            " fits the board"
        )
    if fault is not None and not why:
        raise fault
    return result, why


def _explain(table: PoseTable, boards: list, limit_mm: float, mount: Mount, tried: Reading) -> str:  # type: ignore[type-arg]
    """What the table holds when read the way that fits the board best; empty where none fits."""
    from stereo_ore.io.calibration.readings import fitting_readings

    if len(boards) < 3:
        return ""
    readings = [fit for fit in fitting_readings(table, boards, mount == "fixed") if fit[0] != tried]
    best = min(readings, key=lambda fit: fit[1] * (2 if fit[0].mirror else 1), default=None)
    if best is None or 1000 * best[1] > limit_mm:
        return ""
    reading, left = best
    remedy = "mend the arm's axes first" if reading.mirror else f"say --table {reading.code}"
    return (
        f"the table holds no {tried.words}; it fits to {1000 * left:.1f} mm as {reading.words}:"
        f" {remedy}"
    )


def _arm_views(source: Path, board: Board, table: PoseTable) -> list[tuple[int, ArmView]]:
    """Rows of the table with the pairs of a recording in which both eyes see the board; poses are
    put in later.
    """
    import numpy as np

    from stereo_ore.calibrate.hand_eye import ArmView
    from stereo_ore.io.calibration.pose_names import match_names

    if not board.has_one_reading:
        problem = (
            "a chessboard whose columns and rows add to an even number looks the same turned by"
            " 180°"
        )
        raise CalibrationError(
            problem, key="--board", remedy="Use one with an odd sum (9x6), or ChArUco"
        )
    views, _ = find_views(source, board)
    rows = match_names(table.names, [view.name for view in views])
    if any(table.names[row] != name for name, row in rows.items()):
        _log.info(
            "names put together by their numbers: %s",
            ", ".join(f"{n} = {table.names[r]}" for n, r in rows.items()),
        )
    for view in views:
        if view.name not in rows:
            _log.warning("%s: no pose in the table", view.name)
        elif view.corners is None:
            _log.warning("%s: %s", view.name, view.reason)
    return [
        (rows[view.name], ArmView(view.name, np.eye(4), *view.corners))
        for view in views
        if view.corners is not None and view.name in rows
    ]


def _posed(views: list[tuple[int, ArmView]], table: PoseTable, reading: Reading) -> list[ArmView]:
    from dataclasses import replace

    from stereo_ore.io.calibration.readings import poses

    return [
        replace(view, T_arm_tool=T)
        for (_, view), T in zip(views, poses(table, reading), strict=True)
    ]


def _fits(result: HandEyeResult, limit_mm: float | None) -> bool:
    return result.explains and result.rms_mm <= (result.limit_mm if limit_mm is None else limit_mm)


def _no_fit(result: HandEyeResult | None, limit_mm: float | None) -> str:
    if result is None:
        return "no pose of the camera fits"
    limit = result.limit_mm if limit_mm is None else limit_mm
    if not result.explains:
        return (
            f"no site file: {len(result.dropped)} of {len(result.names)} do not agree with the"
            " others"
        )
    return (
        f"no site file: RMS {result.rms_mm:.1f} mm, more than the {limit:.1f} mm that the images"
        " allow; check names, units and axes of the table, or say --limit-mm for an arm that is"
        " less certain"
    )


def _show(result: HandEyeResult) -> None:
    for name, residual, used in zip(result.names, result.residual_mm, result.used, strict=True):
        typer.echo(
            f"{name:<20} {residual:8.1f}"
            f" mm{'' if used else '  dropped: does not agree with the others'}"
        )
    used_count = int(result.used.sum())
    typer.echo(
        f"\n{used_count} of {len(result.names)} used, RMS {result.rms_mm:.1f} mm, greatest"
        f" {result.max_mm:.1f} mm"
    )


def _write_site(result: HandEyeResult, out: Path, base: Path | None, mount: Mount) -> None:
    from stereo_ore.io.site import save_arm
    from stereo_ore.io.site_sections import HandEyeRecord

    record = HandEyeRecord(
        method=result.method,
        used=int(result.used.sum()),
        dropped=result.dropped,
        rms_mm=round(result.rms_mm, 3),
        max_mm=round(result.max_mm, 3),
    )
    with writing(out):
        save_arm(result.T_arm_camera, record, out, base, mount)
