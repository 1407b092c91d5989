"""Hand-eye tables that people really have: what they hold is named, and what explains nothing makes
no site."""

import subprocess
from pathlib import Path

import numpy as np
import pytest
from rigs import example_rig
from scipy.spatial.transform import Rotation
from test_hand_eye import BOARD, RIG, arm_views, touched

from stereo_ore.calibrate.hand_eye import board_poses
from stereo_ore.calibrate.tables import read_pose_table, read_touched
from stereo_ore.calibrate.touched import Touched, fit_touched
from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration import save
from stereo_ore.io.calibration.pose_names import match_names
from stereo_ore.io.calibration.readings import (
    PoseTable,
    Reading,
    fitting_readings,
    parse_reading,
    poses,
)
from stereo_ore.io.site import load_site

TRUTH = np.array([[1, 0, 0, 0.10], [0, -0.8, 0.6, -0.45], [0, -0.6, -0.8, 1.10], [0, 0, 0, 1]])


def hand_eye(*words: object) -> subprocess.CompletedProcess[str]:
    line = ["stereo-ore", "-q", "calibrate", "hand-eye", *map(str, words)]
    return subprocess.run(line, capture_output=True, text=True, check=False)


def from_board(
    folder: Path, table: Path, out: Path, *more: object
) -> subprocess.CompletedProcess[str]:
    board = ("--board", "9x6") if "--board" not in more else ()
    calib = folder / "calib.yaml"
    return hand_eye(
        folder / "board",
        "--poses",
        table,
        *board,
        "--square-mm",
        40,
        "--calib",
        calib,
        "--out",
        out,
        *more,
    )


def test_01_handeye_angles(shared_data: Path, tmp_path: Path) -> None:
    folder = shared_data / "reports2/01-handeye-angles"
    good = from_board(folder, folder / "good.csv", tmp_path / "good.yaml")
    assert good.returncode == 0, good.stderr
    assert np.abs(load_site(tmp_path / "good.yaml").T_arm_camera - TRUTH).max() < 3e-4
    euler = from_board(folder, folder / "euler_rad.csv", tmp_path / "euler.yaml")
    assert euler.returncode == 3
    assert not (tmp_path / "euler.yaml").exists()
    assert "Euler angles in radians, Rz·Ry·Rx" in euler.stderr.splitlines()[0]
    taken = from_board(
        folder, folder / "euler_rad.csv", tmp_path / "euler.yaml", "--table", "zyx-rad"
    )
    assert taken.returncode == 0, taken.stderr
    assert np.abs(load_site(tmp_path / "euler.yaml").T_arm_camera - TRUTH).max() < 3e-4
    squares = from_board(folder, folder / "good.csv", tmp_path / "x.yaml", "--board", "10x7")
    assert squares.returncode == 1
    assert "--board 9x6" in squares.stderr


def test_01_handeye_degrees(shared_data: Path, tmp_path: Path) -> None:
    folder = shared_data / "reports2/01-handeye-angles"
    lines = (folder / "good.csv").read_text().splitlines()
    rows = [line.split(",") for line in lines[1:]]
    degrees = [
        ",".join([*row[:4], *(f"{np.degrees(float(cell)):.4f}" for cell in row[4:])])
        for row in rows
    ]
    (tmp_path / "deg.csv").write_text("\n".join([lines[0], *degrees]))
    done = from_board(folder, tmp_path / "deg.csv", tmp_path / "s.yaml")
    assert done.returncode == 3
    assert not (tmp_path / "s.yaml").exists()
    assert "degrees" in done.stderr.splitlines()[0]
    assert "--table rotvec-deg" in done.stderr


def test_03_handeye_names(shared_data: Path, tmp_path: Path) -> None:
    folder = shared_data / "reports2"
    done = from_board(
        folder / "01-handeye-angles", folder / "03-handeye-names/excel.csv", tmp_path / "s.yaml"
    )
    assert done.returncode == 0, done.stderr
    assert np.abs(load_site(tmp_path / "s.yaml").T_arm_camera - TRUTH).max() < 3e-4


@pytest.mark.parametrize(
    ("rows", "frames", "wanted"),
    [
        (["1", "2"], ["0001", "0002"], {"0001": 0, "0002": 1}),
        (["left_0002.png", "left_0001.png"], ["0001", "0002"], {"0001": 1, "0002": 0}),
        (["a", "b"], ["a", "b", "c"], {"a": 0, "b": 1}),
        (["Pose 3.0", "Pose 4.0"], ["3", "4"], {"3": 0, "4": 1}),
    ],
)
def test_names_are_put_together_when_that_is_the_only_way(
    rows: list, frames: list, wanted: dict
) -> None:
    assert match_names(rows, frames) == wanted


@pytest.mark.parametrize(
    ("rows", "frames"),
    [(["1", "01"], ["0001", "2"]), (["x", "y"], ["0001", "0002"]), (["1_1", "1_2"], ["1", "2"])],
)
def test_names_that_match_in_no_single_way_are_shown(rows: list, frames: list) -> None:
    with pytest.raises(CalibrationError, match=f"{rows[0]}.*{frames[0]}"):
        match_names(rows, frames)


def test_02_handeye_mirrored(shared_data: Path, tmp_path: Path) -> None:
    folder = shared_data / "reports2/02-handeye-mirrored"
    calib = Path(__file__).parents[1] / "data" / "paper_03" / "calibration.yaml"
    good = hand_eye(
        "--points", folder / "good.csv", "--calib", calib, "--out", tmp_path / "good.yaml"
    )
    assert good.returncode == 0, good.stderr
    camera = load_site(tmp_path / "good.yaml").T_arm_camera[:3, 3]
    assert np.abs(camera - [0.141, -0.421, 0.810]).max() < 0.03
    for name, words in (("y_to_the_right", "left-handed"), ("centimetres", "centimetres")):
        done = hand_eye(
            "--points", folder / f"{name}.csv", "--calib", calib, "--out", tmp_path / "bad.yaml"
        )
        assert done.returncode != 0
        assert words in done.stderr
        assert not (tmp_path / "bad.yaml").exists()


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (1000, "millimetres"),
        (100, "centimetres"),
        (10, "decimetres"),
        (39.37, "inches"),
        (3.281, "feet"),
        (5.7, "neither"),
    ],
)
def test_touched_points_in_another_unit_are_named(factor: float, words: str) -> None:
    points = [
        Touched(p.name, tuple(factor * c for c in p.arm_m), p.left_px, p.right_px)
        for p in touched(noise_px=0.2)
    ]
    with pytest.raises(CalibrationError, match=words):
        fit_touched(points, RIG)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_left_handed_arm_is_named_whichever_axis_is_turned(axis: int) -> None:
    sign = [-1.0 if i == axis else 1.0 for i in range(3)]
    points = [
        Touched(
            p.name, tuple(s * c for s, c in zip(sign, p.arm_m, strict=True)), p.left_px, p.right_px
        )
        for p in touched(noise_px=0.2)
    ]
    with pytest.raises(CalibrationError, match="left-handed"):
        fit_touched(points, example_rig())


def as_table(T: list, rotations: np.ndarray, unit: float = 1.0) -> PoseTable:
    return PoseTable(
        tuple(map(str, range(len(T)))), np.array([t[:3, 3] for t in T]) / unit, rotations
    )


TABLES = {
    "zyx-rad": lambda R: R.as_euler("ZYX")[:, ::-1],
    "xyz-deg": lambda R: R.as_euler("XYZ", degrees=True),
    "zxy-deg": lambda R: R.as_euler("ZXY", degrees=True)[:, [1, 2, 0]],
    "zyxr-deg": lambda R: R.as_euler("ZYX", degrees=True),
    "zyz-deg": lambda R: R.as_euler("ZYZ", degrees=True),
    "rotvec-deg": lambda R: np.degrees(R.as_rotvec()),
    "wxyz": lambda R: R.as_quat()[:, [3, 0, 1, 2]],
}


@pytest.mark.parametrize("code", TABLES)
@pytest.mark.parametrize(("inverted", "unit"), [(False, "m"), (False, "mm"), (True, "inch")])
def test_each_usual_table_is_known_by_the_board(code: str, inverted: bool, unit: str) -> None:
    views = arm_views(7, "fixed", px=0.05, seed=3)
    boards, limit_mm = board_poses(views, BOARD, RIG)
    T = [np.linalg.inv(view.T_arm_tool) if inverted else view.T_arm_tool for view in views]
    metres = {"m": 1.0, "mm": 0.001, "inch": 0.0254}[unit]
    table = as_table(T, TABLES[code](Rotation.from_matrix([t[:3, :3] for t in T])), metres)
    best, left = min(
        fitting_readings(table, boards, fixed=True),
        key=lambda fit: fit[1] * (2 if fit[0].mirror else 1),
    )
    assert 1000 * left < limit_mm
    assert (best.inverse, best.unit, best.mirror) == (inverted, unit, "")
    for found, wanted in zip(poses(table, best), views, strict=True):
        np.testing.assert_allclose(found, wanted.T_arm_tool, atol=1e-9)
    assert parse_reading(best.code) == best


def test_a_left_handed_table_of_poses_is_known() -> None:
    views = arm_views(7, "fixed", px=0.05, seed=3)
    boards, _ = board_poses(views, BOARD, RIG)
    mirror = np.diag([1.0, -1, 1, 1])
    T = [mirror @ view.T_arm_tool @ mirror for view in views]
    table = as_table(T, Rotation.from_matrix([t[:3, :3] for t in T]).as_rotvec())
    best, _ = min(fitting_readings(table, boards, fixed=True), key=lambda fit: fit[1])
    assert best.mirror
    assert "left-handed" in best.words


def test_a_wrong_value_of_table_is_refused() -> None:
    for code in ("euler", "zyx-deg,furlong", "xyzw,mm,mm"):
        with pytest.raises(CalibrationError, match="--table"):
            parse_reading(code)


@pytest.mark.parametrize(
    "name", ["bom", "comma", "german", "latin", "semicolon", "sep", "tab", "upper", "utf16"]
)
def test_22_hand_eye_excel(name: str, shared_data: Path) -> None:
    folder = shared_data / "reports/22-hand-eye-excel"
    points, plain = read_touched(folder / f"{name}.csv"), read_touched(folder / "comma.csv")
    assert [(p.arm_m, p.left_px, p.right_px) for p in points] == [
        (p.arm_m, p.left_px, p.right_px) for p in plain
    ]
    assert points[0].arm_m == (0.12199, 0.15649, -0.14023)


def test_a_camera_on_the_tool_is_not_used_as_a_fixed_one(shared_data: Path, tmp_path: Path) -> None:
    """The board stands still, the camera moves: the poses are those of the inverse problem."""
    folder = shared_data / "reports2/01-handeye-angles"
    table = read_pose_table(folder / "good.csv")
    T = [np.linalg.inv(pose) for pose in poses(table, Reading("rotvec-rad"))]
    vectors = Rotation.from_matrix([t[:3, :3] for t in T]).as_rotvec()
    rows = [
        ",".join([name, *(f"{v:.9f}" for v in (*t[:3, 3], *vector))])
        for name, t, vector in zip(table.names, T, vectors, strict=True)
    ]
    (tmp_path / "tool.csv").write_text("\n".join(["name,x_m,y_m,z_m,rx_rad,ry_rad,rz_rad", *rows]))
    done = from_board(folder, tmp_path / "tool.csv", tmp_path / "s.yaml", "--mount", "tool")
    assert done.returncode == 0, done.stderr
    assert load_site(tmp_path / "s.yaml").T_arm_camera is None
    assert "tool_from_camera" in (tmp_path / "s.yaml").read_text()


def test_touched_points_that_explain_nothing_make_no_site(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    save(RIG, tmp_path / "camera.yaml")
    rows = ["name,arm_x_m,arm_y_m,arm_z_m,left_u,left_v,right_u,right_v"]
    for point in touched():
        shaken = np.array(point.arm_m) + rng.normal(0, 0.12, 3)
        rows.append(",".join(map(str, (point.name, *shaken, *point.left_px, *point.right_px))))
    (tmp_path / "p.csv").write_text("\n".join(rows))
    done = hand_eye(
        "--points",
        tmp_path / "p.csv",
        "--calib",
        tmp_path / "camera.yaml",
        "--out",
        tmp_path / "s.yaml",
    )
    assert done.returncode in (1, 3)
    assert not (tmp_path / "s.yaml").exists()
