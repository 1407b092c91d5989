"""The camera in the arm's frame: touched points and poses with a board, by simulation with
noise."""

import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest
from rigs import SIZE, example_rig, rectified_to_raw, rendered_pair, small_rig

from stereo_ore.calibrate.detect import Board, Corners
from stereo_ore.calibrate.hand_eye import ArmView, Mount, fit_hand_eye
from stereo_ore.calibrate.pose import fit_rigid
from stereo_ore.calibrate.tables import POINT_COLUMNS, read_poses, read_touched
from stereo_ore.calibrate.touched import HandEyeResult, Touched, fit_touched
from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration import save
from stereo_ore.io.calibration.geometry import from_vector, to_vector
from stereo_ore.io.site import load_site
from stereo_ore.transforms import inverse, nearest_rotation, transform_points
from stereo_ore.types import F64

RIG = example_rig()
BOARD = Board(9, 6, 0.05)
T_ARM_CAMERA = from_vector(np.array([2.8, 0.2, -0.3, 0.4, -0.65, 2.6]))
T_TOOL_CAMERA = from_vector(np.array([0.1, -0.2, 1.5, 0.05, -0.08, 0.02]))
PLACES = np.array(
    [
        [-0.5, -0.3, 2.2],
        [0.6, -0.3, 2.4],
        [0.0, 0.35, 2.0],
        [-0.4, 0.3, 2.3],
        [0.5, 0.25, 1.9],
        [0.1, -0.1, 2.1],
    ]
)


def touched(places: F64 = PLACES, noise_px: float = 0.0, seed: int = 0) -> list[Touched]:
    rng = np.random.default_rng(seed)
    left, right = (px + rng.normal(0, noise_px, px.shape) for px in rectified_to_raw(RIG, places))
    arm = transform_points(T_ARM_CAMERA, places)
    return [
        Touched(f"p{i}", tuple(arm[i].tolist()), tuple(left[i].tolist()), tuple(right[i].tolist()))
        for i in range(len(places))
    ]


def error_mm(result: HandEyeResult, truth: F64 = T_ARM_CAMERA, distance: float = 2.1) -> float:
    """How far the middle of the scene is off in the arm's frame."""
    middle = np.array([0, 0, distance])
    return 1000 * float(
        np.linalg.norm(
            transform_points(result.T_arm_camera, middle) - transform_points(truth, middle)
        )
    )


@pytest.mark.parametrize("count", [3, 4, 6])
def test_exact_points_give_the_exact_transform(count: int) -> None:
    result = fit_touched(touched(PLACES[:count]), RIG)
    assert np.abs(result.T_arm_camera - T_ARM_CAMERA).max() < 1e-6
    assert result.rms_mm < 1e-3
    assert result.dropped == ()


def test_the_accuracy_is_that_of_the_pixels() -> None:
    errors = [error_mm(fit_touched(touched(noise_px=0.3, seed=seed), RIG)) for seed in range(20)]
    # One pixel is 3 mm across and 52 mm in depth at 2.1 m; six points with 0.3 px each.
    assert np.median(errors) < 5
    assert max(errors) < 15


@pytest.mark.parametrize("bad", [0, 3])
def test_an_outlier_is_named(bad: int) -> None:
    points = touched(noise_px=0.2)
    wrong = points[bad]
    points[bad] = Touched(
        wrong.name, (wrong.arm_m[0] + 0.1, *wrong.arm_m[1:]), wrong.left_px, wrong.right_px
    )
    result = fit_touched(points, RIG)
    assert result.dropped == (wrong.name,)
    assert result.residual_mm[bad] > 50
    assert error_mm(result) < 10


@pytest.mark.parametrize(
    ("places", "word"),
    [
        (PLACES[:1], "1 arm"),
        (PLACES[:2], "2 arm"),
        (np.linspace([-0.5, 0, 2.0], [0.5, 0.1, 2.2], 5), "one line"),
        (np.repeat(PLACES[:1], 4, axis=0), "one line"),
    ],
)
def test_too_few_and_collinear_points_are_refused(places: F64, word: str) -> None:
    with pytest.raises(CalibrationError, match=word):
        fit_touched(touched(places), RIG)


def test_no_points_at_all_are_refused() -> None:
    with pytest.raises(CalibrationError, match="0 arm"):
        fit_touched([], RIG)


def test_pixels_that_meet_behind_the_camera_are_refused_by_name() -> None:
    points = touched()
    points[2] = Touched("p2", points[2].arm_m, points[2].right_px, points[2].left_px)
    with pytest.raises(CalibrationError, match=r"p2.*behind"):
        fit_touched(points, RIG)


def arm_views(
    count: int, mount: Mount, px: float = 0.0, mm: float = 0.0, seed: int = 0
) -> list[ArmView]:
    """Poses that show the board, with noise of the pixels and of the arm (and a tenth of a degree a
    millimetre)."""
    rng = np.random.default_rng(seed)
    T_tool_board = from_vector(np.array([0.1, -0.2, 0.3, -0.25, -0.15, 0.1]))
    T_arm_board = from_vector(np.array([0.05, 0.1, 1.0, 1.5, 0.3, -0.2]))
    views: list[ArmView] = []
    while len(views) < count:
        T_camera_board = from_vector(
            np.concatenate([rng.normal(0, 0.4, 3), rng.uniform((-0.6, -0.4, 1), (0.3, 0.2, 2))])
        )
        eyes = rectified_to_raw(RIG, transform_points(T_camera_board, BOARD.points))
        if not all(((seen > 0) & (seen < SIZE)).all() for seen in eyes):
            continue
        if mount == "fixed":
            T_arm_tool = T_ARM_CAMERA @ T_camera_board @ inverse(T_tool_board)
        else:
            T_arm_tool = T_arm_board @ inverse(T_camera_board) @ inverse(T_TOOL_CAMERA)
        shaken = np.concatenate(
            [rng.normal(0, np.radians(0.1 * mm), 3), rng.normal(0, mm / 1000, 3)]
        )
        ids = np.arange(len(BOARD.points), dtype=np.int32)
        left, right = (Corners(ids, seen + rng.normal(0, px, seen.shape)) for seen in eyes)
        views.append(ArmView(f"pose {len(views)}", T_arm_tool @ from_vector(shaken), left, right))
    return views


@pytest.mark.parametrize(("mount", "truth"), [("fixed", T_ARM_CAMERA), ("tool", T_TOOL_CAMERA)])
def test_exact_poses_give_the_exact_transform(mount: Mount, truth: F64) -> None:
    result = fit_hand_eye(arm_views(5, mount), BOARD, RIG, mount)
    assert np.abs(result.T_arm_camera - truth).max() < 1e-6
    assert result.max_mm < 1e-3


@pytest.mark.parametrize(("px", "mm", "limit"), [(0.2, 0.0, 2.0), (0.2, 1.0, 5.0)])
def test_the_accuracy_is_that_of_pixels_and_arm(px: float, mm: float, limit: float) -> None:
    errors = [
        error_mm(fit_hand_eye(arm_views(12, "fixed", px, mm, seed), BOARD, RIG))
        for seed in range(4)
    ]
    assert np.median(errors) < limit


def test_a_wrong_pose_is_named() -> None:
    views = arm_views(10, "fixed", 0.1)
    moved = views[6].T_arm_tool @ from_vector(np.array([0, 0.05, 0, 0.04, 0, 0]))
    views[6] = ArmView("pose 6", moved, views[6].left, views[6].right)
    result = fit_hand_eye(views, BOARD, RIG)
    assert result.dropped == ("pose 6",)
    assert error_mm(result) < 3


def test_few_poses_and_turns_about_one_axis_are_refused() -> None:
    with pytest.raises(CalibrationError, match="2 poses"):
        fit_hand_eye(arm_views(2, "fixed"), BOARD, RIG)
    one = arm_views(1, "fixed")[0]
    spun = []
    for k in range(4):
        T_camera_board = from_vector(np.array([0, 0, 0.2 * k, -0.2, -0.1, 1.2]))
        eyes = [
            Corners(one.left.ids, px)
            for px in rectified_to_raw(RIG, transform_points(T_camera_board, BOARD.points))
        ]
        spun.append(ArmView(str(k), T_ARM_CAMERA @ T_camera_board, *eyes))
    with pytest.raises(CalibrationError, match="one axis"):
        fit_hand_eye(spun, BOARD, RIG)


def test_opencv_agrees_where_it_has_the_methods() -> None:
    if not hasattr(cv2, "calibrateHandEye"):
        pytest.skip("the Python of this OpenCV has no calibrateHandEye")
    from stereo_ore.calibrate import hand_eye

    seen = [
        hand_eye._Seen(inverse(v.T_arm_tool), T) for v, T in zip(*views_and_boards(), strict=True)
    ]
    for method in hand_eye.HAND_EYE_METHODS:
        assert np.abs(hand_eye._opencv(seen, method) - T_ARM_CAMERA).max() < 1e-5


def views_and_boards() -> tuple[list[ArmView], list[F64]]:
    views = arm_views(6, "fixed")
    T_tool_board = from_vector(np.array([0.1, -0.2, 0.3, -0.25, -0.15, 0.1]))
    return views, [inverse(T_ARM_CAMERA) @ view.T_arm_tool @ T_tool_board for view in views]


def test_rigid_fit_and_rotation_vectors_are_inverse_to_each_other() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        vector = rng.normal(0, 0.8, 6)
        points = rng.normal(0, 1, (5, 3))
        assert to_vector(
            fit_rigid(transform_points(from_vector(vector), points), points)
        ) == pytest.approx(vector, abs=1e-9)
    assert np.linalg.det(nearest_rotation(np.diag([1.0, 1.0, -1.0]))) == pytest.approx(1)


def table(folder: Path, header: str, *rows: str) -> Path:
    path = folder / "table.csv"
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


POINT_HEADER = "name, " + ", ".join(POINT_COLUMNS)


def point_row(point: Touched) -> str:
    return ", ".join(map(str, (point.name, *point.arm_m, *point.left_px, *point.right_px)))


def test_point_tables_round_trip(tmp_path: Path) -> None:
    assert read_touched(table(tmp_path, POINT_HEADER, *map(point_row, touched()))) == touched()


def test_poses_as_rotation_vector_and_as_quaternion(tmp_path: Path) -> None:
    half = np.sqrt(0.5)
    by_vector = read_poses(
        table(tmp_path, "name,x_m,y_m,z_m,rx_rad,ry_rad,rz_rad", f"a,1,2,3,0,0,{np.pi / 2}")
    )["a"]
    by_quaternion = read_poses(
        table(tmp_path, "name,x_m,y_m,z_m,qx,qy,qz,qw", f"a,1,2,3,0,0,{half},{half}")
    )["a"]
    assert by_vector == pytest.approx(by_quaternion)
    assert transform_points(by_vector, [1, 0, 0]) == pytest.approx([1, 3, 3])


@pytest.mark.parametrize(
    ("header", "row", "word"),
    [
        (POINT_HEADER.replace("left_u", "left_x"), "p,1,2,3,4,5,6,7", "did you mean left_"),
        (POINT_HEADER, "p,1,2,3,4,wide,6,7", "line 2, left_v"),
        (POINT_HEADER, "p,1,2,3", "left_u"),
        (POINT_HEADER, "p,1,2,3,4,nan,6,7", "'nan' is not a number"),
        (POINT_HEADER, "p,1,2,3,4,5,6,7\np,1,2,3,4,5,6,7", "twice"),
        ("", "", "column is missing"),
    ],
)
def test_a_broken_table_names_line_and_column(
    tmp_path: Path, header: str, row: str, word: str
) -> None:
    with pytest.raises(CalibrationError, match=word):
        read_touched(table(tmp_path, header, row))


def test_a_quaternion_of_another_length_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="length"):
        read_poses(table(tmp_path, "name,x_m,y_m,z_m,qx,qy,qz,qw", "a,1,2,3,1,1,1,1"))


def test_the_command_writes_a_site_with_residuals(tmp_path: Path) -> None:
    save(RIG, tmp_path / "camera.yaml")
    points = table(tmp_path, POINT_HEADER, *map(point_row, touched(noise_px=0.2)))
    line = [
        "stereo-ore",
        "calibrate",
        "hand-eye",
        "--points",
        points,
        "--calib",
        tmp_path / "camera.yaml",
        "--out",
    ]
    done = subprocess.run(
        [*line, tmp_path / "site.yaml"], capture_output=True, text=True, check=True
    )
    assert "6 of 6 used" in done.stdout
    assert np.abs(load_site(tmp_path / "site.yaml").T_arm_camera - T_ARM_CAMERA).max() < 0.02
    strict = subprocess.run(
        [*line, tmp_path / "x.yaml", "--limit-mm", "0.001"], capture_output=True, check=False
    )
    assert strict.returncode == 3
    nothing = subprocess.run(
        line[:3] + line[5:] + [tmp_path / "x.yaml"], capture_output=True, text=True, check=False
    )
    assert (nothing.returncode, "--points" in nothing.stderr) == (2, True)


def test_the_command_finds_the_arm_from_pictures_of_a_board(tmp_path: Path) -> None:
    board = Board(7, 5, 0.05, 0.037)
    T_tool_board = from_vector(np.array([0.1, -0.2, 0.3, -0.25, -0.15, 0.1]))
    rows = ["name,x_m,y_m,z_m,rx_rad,ry_rad,rz_rad"]
    turns = ((0.5, 0, 0), (-0.4, 0.1, 0.3), (0, 0.5, -0.3), (0.1, -0.5, 0.2), (0.3, 0.4, 0.5))
    for index, turn in enumerate(turns):
        T_camera_board = from_vector(
            np.array([*turn, -0.1, -0.05 - 0.02 * index, 0.6 + 0.04 * index])
        )
        vector = to_vector(T_ARM_CAMERA @ T_camera_board @ inverse(T_tool_board))
        rows.append(",".join(map(str, [f"{index:02d}", *vector[3:], *vector[:3]])))
        for side, image in zip(
            ("left", "right"), rendered_pair(board, T_camera_board), strict=True
        ):
            cv2.imwrite(str(tmp_path / f"{side}{index:02d}.png"), image)
    save(small_rig(), tmp_path / "camera.yaml")
    line = [
        "stereo-ore",
        "calibrate",
        "hand-eye",
        tmp_path,
        "--poses",
        table(tmp_path, *rows),
        "--board",
        "7x5",
    ]
    line += [
        "--square-mm",
        "50",
        "--marker-mm",
        "37",
        "--calib",
        tmp_path / "camera.yaml",
        "--out",
        tmp_path / "s.yaml",
    ]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    assert "5 of 5 used" in done.stdout, done.stderr
    found = load_site(tmp_path / "s.yaml").T_arm_camera
    middle = np.array([0, 0, 0.7])
    assert (
        1000
        * np.linalg.norm(transform_points(found, middle) - transform_points(T_ARM_CAMERA, middle))
        < 3
    )
