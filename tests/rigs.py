"""Stereo rigs with known truth: at random, written in foreign formats, and seeing points."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import yaml
from hypothesis import reject
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stereo_ore.calibrate.detect import Board
from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration.geometry import make_calibration
from stereo_ore.io.calibration.zed import ZED_SIZES
from stereo_ore.stages.rectify import make_rectifier, rectification
from stereo_ore.transforms import transform_points
from stereo_ore.types import F64, U8, CameraModel, StereoCalibration

SIZE = (1280, 720)
SMALL = (640, 480)
K_SMALL = np.array([[520.0, 0, 320], [0, 520, 240], [0, 0, 1]])


def number(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False, allow_infinity=False)


def cameras(coefficients: int = 5) -> st.SearchStrategy[CameraModel]:
    return st.builds(
        CameraModel,
        st.tuples(number(300, 1500), number(300, 1500)),
        st.tuples(number(560, 720), number(300, 420)),
        st.tuples(*[number(-0.05, 0.05)] * coefficients),
    )


@st.composite
def raw_rigs(draw: st.DrawFn, coefficients: int = 5) -> StereoCalibration:
    """Rigs of raw images that can be rectified: of odd lenses a rectified camera would see
    nothing."""
    rig = make_calibration(
        "drawn",
        image_size=SIZE,
        left=draw(cameras(coefficients)),
        right=draw(cameras(coefficients)),
        rotation=draw(st.tuples(*[number(-0.05, 0.05)] * 3)),
        translation_m=(
            draw(number(-0.5, -0.05)),
            draw(number(-0.02, 0.02)),
            draw(number(-0.02, 0.02)),
        ),
        images="raw",
        disparity_offset_px=draw(number(-20, 20)),
        camera=draw(st.text(st.characters(categories=("L", "N", "P", "Zs")), max_size=20)),
    )
    try:
        make_rectifier(rig)
    except CalibrationError:
        reject()
    return rig


def example_rig() -> StereoCalibration:
    """Turned, distorted eyes such as a factory file describes."""
    return make_calibration(
        "example",
        image_size=SIZE,
        left=CameraModel((700.9, 700.4), (665.5, 371.2), (-0.1760, 0.0266, 0.0002, -0.0003, 0.0)),
        right=CameraModel((699.1, 699.3), (639.7, 375.0), (-0.1752, 0.0267, -0.0001, 0.0002, 0.0)),
        rotation=(0.00613, 0.0068, -0.00194),
        translation_m=(-0.12, 0.0004, -0.0003),
        images="raw",
        camera="example",
    )


def rectified_rig() -> StereoCalibration:
    eye = CameraModel((530.0, 530.0), (640.0, 360.0))
    return make_calibration(
        "example",
        image_size=SIZE,
        left=eye,
        right=eye,
        translation_m=(-0.12, 0, 0),
        images="rectified",
    )


def with_rotation(calibration: StereoCalibration, vector: F64) -> StereoCalibration:
    return replace(calibration, R_right_left=cv2.Rodrigues(np.asarray(vector, float))[0])


def rectified_to_raw(calibration: StereoCalibration, xyz: F64) -> tuple[F64, F64]:
    """Recorded pixels (N, 2) of both eyes of points (N, 3) in the rectified left frame."""
    if calibration.images == "raw":
        xyz = xyz @ rectification(calibration)[0]
    other = xyz @ calibration.R_right_left.T + calibration.t_right_left
    return project(calibration.left, xyz), project(calibration.right, other)


def project(eye: CameraModel, xyz: F64) -> F64:
    distortion = np.array(eye.distortion or (0.0,) * 4)
    return cv2.projectPoints(xyz[:, None], np.zeros(3), np.zeros(3), eye.K, distortion)[0].reshape(
        -1, 2
    )


def write_zed(
    rig: StereoCalibration,
    path: Path,
    mode: str = "HD",
    suffix: bool = True,
    left_out: tuple[str, ...] = (),
) -> Path:
    assert rig.image_size == ZED_SIZES[mode]
    lines = []
    for name, eye in (("LEFT", rig.left), ("RIGHT", rig.right)):
        values = dict(zip(("k1", "k2", "p1", "p2", "k3"), eye.distortion, strict=True))
        values |= dict(
            zip(("fx", "fy", "cx", "cy"), (*eye.focal_px, *eye.principal_point_px), strict=True)
        )
        lines += [f"[{name}_CAM_{mode}]"] + [
            f"{key}={value!r}" for key, value in values.items() if key not in left_out
        ]
    # Not cv2.Rodrigues: from a matrix it is wrong in the tenth digit for turns of 1e-5 rad.
    turn = Rotation.from_matrix(rig.R_right_left).as_rotvec()
    x, y, z = 1000 * rig.t_right_left
    end = f"_{mode}" if suffix else ""
    lines += [
        "[STEREO]",
        f"Baseline={float(-x)!r}",
        f"TY{end}={float(y)!r}",
        f"TZ{end}={float(z)!r}",
    ]
    lines += [
        f"{key}_{mode}={float(angle)!r}"
        for key, angle in zip(("RX", "CV", "RZ"), turn, strict=True)
    ]
    path.write_text(
        "\n".join(line for line in lines if line.partition("=")[0] not in left_out) + "\n"
    )
    return path


def write_opencv(
    rig: StereoCalibration,
    path: Path,
    names: dict[str, str] | None = None,
    changes: dict[str, F64] | None = None,
) -> Path:
    entries = {
        "M1": rig.left.K,
        "D1": np.array([rig.left.distortion]),
        "M2": rig.right.K,
        "D2": np.array([rig.right.distortion]),
        "R": rig.R_right_left,
        "T": rig.t_right_left.reshape(3, 1),
    } | (changes or {})
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", rig.image_size[0])
    storage.write("image_height", rig.image_size[1])
    for key, value in entries.items():
        storage.write((names or {}).get(key, key), value)
    storage.release()
    return path


def write_ros(rig: StereoCalibration, folder: Path) -> Path:
    R1, R2, P1, P2 = rectification(rig)
    for side, eye, R, P in (("left", rig.left, R1, P1), ("right", rig.right, R2, P2)):
        arrays = {"camera_matrix": eye.K, "rectification_matrix": R, "projection_matrix": P}
        document = {
            "image_width": rig.image_size[0],
            "image_height": rig.image_size[1],
            "distortion_model": "plumb_bob",
            "distortion_coefficients": {"rows": 1, "cols": 5, "data": list(eye.distortion)},
        }
        document |= {
            key: {"rows": 3, "cols": a.shape[1], "data": [float(x) for x in a.ravel()]}
            for key, a in arrays.items()
        }
        (folder / f"{side}.yaml").write_text(yaml.safe_dump(document))
    return folder / "left.yaml"


def write_kalibr(rig: StereoCalibration, path: Path, model: str = "radtan") -> Path:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rig.R_right_left, rig.t_right_left
    document = {}
    for index, eye in enumerate((rig.left, rig.right)):
        document[f"cam{index}"] = {
            "camera_model": "pinhole",
            "intrinsics": [*eye.focal_px, *eye.principal_point_px],
            "distortion_model": model,
            "distortion_coeffs": list(eye.distortion),
            "resolution": list(rig.image_size),
        } | ({"T_cn_cnm1": T.tolist()} if index else {})
    path.write_text(yaml.safe_dump(document))
    return path


def same(one: StereoCalibration, other: StereoCalibration, tolerance: float = 0.0) -> bool:
    """Whether two calibrations are the same rig, whatever they are called."""
    numbers = [
        np.concatenate(
            [
                np.ravel(rig.image_size),
                np.concatenate(
                    [
                        [*e.focal_px, *e.principal_point_px, *e.distortion]
                        for e in (rig.left, rig.right)
                    ]
                ),
                rig.R_right_left.ravel(),
                rig.t_right_left,
                [rig.disparity_offset_px],
            ]
        )
        for rig in (one, other)
    ]
    kinds = [(rig.images, rig.left.projection, rig.right.projection) for rig in (one, other)]
    return (
        kinds[0] == kinds[1]
        and len(numbers[0]) == len(numbers[1])
        and np.abs(numbers[0] - numbers[1]).max() <= tolerance
    )


def small_rig() -> StereoCalibration:
    """The rectified rig of `rendered_pair`."""
    eye = CameraModel((520.0, 520.0), (320.0, 240.0))
    return make_calibration(
        "small",
        image_size=SMALL,
        left=eye,
        right=eye,
        translation_m=(-0.12, 0, 0),
        images="rectified",
    )


def rendered_pair(board: Board, T_camera_board: F64) -> tuple[U8, U8]:
    """What both eyes of `small_rig` see of a board."""
    T_right_board = T_camera_board.copy()
    T_right_board[0, 3] -= 0.12
    return rendered(board, T_camera_board)[0], rendered(board, T_right_board)[0]


def board_image(board: Board, square_px: int = 40) -> U8:
    """The printed board with a margin of one square."""
    columns, rows = board.columns + 1, board.rows + 1
    if board.marker_m is not None:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
        target = cv2.aruco.CharucoBoard((columns, rows), board.square_m, board.marker_m, dictionary)
        face = target.generateImage((columns * square_px, rows * square_px))
    else:
        face = (
            np.kron(np.indices((rows, columns)).sum(0) % 2, np.ones((square_px, square_px))) * 255
        )
    return np.pad(face.astype(np.uint8), square_px, constant_values=255)


def rendered(board: Board, T_camera_board: F64) -> tuple[U8, F64]:
    """A picture of a board without distortion, and where its corners are."""
    square_px = 40
    H_board_print = np.diag([board.square_m / square_px, board.square_m / square_px, 1.0])
    H_board_print[:2, 2] = -(2 * square_px - 0.5) * board.square_m / square_px
    H = K_SMALL @ T_camera_board[:3, [0, 1, 3]] @ H_board_print
    page = cv2.warpPerspective(
        board_image(board, square_px),
        H,
        SMALL,
        flags=cv2.INTER_AREA,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=150,
    )
    seen = transform_points(T_camera_board, board.points) @ K_SMALL.T
    return cv2.GaussianBlur(page, (0, 0), 0.7), seen[:, :2] / seen[:, 2:]
