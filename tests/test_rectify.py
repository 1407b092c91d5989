"""Rectification against OpenCV's own, the path-traced raw scene, and every contradiction."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereo_ore.errors import CalibrationError, FrameError
from stereo_ore.stages.rectify import make_rectifier, rectify
from stereo_ore.types import CameraModel, StereoCalibration, StereoPair

SIZE = (640, 480)
EYE = CameraModel((500.0, 499.0), (321.0, 239.0))


def rectified(**changes: object) -> StereoCalibration:
    plain = StereoCalibration(SIZE, EYE, EYE, np.eye(3), np.array([-0.12, 0.0, 0.0]))
    return replace(plain, **changes)  # type: ignore[arg-type]


def raw(**changes: object) -> StereoCalibration:
    left = CameraModel((500.0, 499.0), (321.0, 239.0), (-0.05, 0.01, 0.0003, -0.0002, 0.001))
    right = CameraModel((502.0, 501.5), (317.0, 243.0), (-0.04, 0.01, -0.0003, 0.0002, 0.002))
    R = cv2.Rodrigues(np.array([0.01, -0.008, 0.004]))[0]
    plain = StereoCalibration(SIZE, left, right, R, np.array([-0.12, 0.001, -0.0005]), "raw")
    return replace(plain, **changes)  # type: ignore[arg-type]


def project(camera: CameraModel, xyz: np.ndarray) -> np.ndarray:
    return cv2.projectPoints(xyz, np.zeros(3), np.zeros(3), camera.K, np.array(camera.distortion))[
        0
    ][:, 0]


def points() -> np.ndarray:
    return np.random.default_rng(3).uniform([-0.5, -0.4, 1.0], [0.5, 0.4, 2.0], (40, 3))


def test_rectified_images_pass_unchanged() -> None:
    image = np.random.default_rng(0).integers(0, 255, (480, 640, 3)).astype(np.uint8)
    pair = rectify(StereoPair(image, image, name="f", index=0), make_rectifier(rectified()))
    assert pair.left is image
    assert (pair.rig.fx, pair.rig.fy, pair.rig.cx, pair.rig.cy) == (500.0, 499.0, 321.0, 239.0)
    assert pair.rig.baseline_m == pytest.approx(0.12)


def test_different_principal_points_make_doffs() -> None:
    right = replace(EYE, principal_point_px=(351.5, 239.0))
    rig = make_rectifier(rectified(right=right, disparity_offset_px=1.5)).rig
    assert (rig.doffs_px, rig.disparity_offset_px) == (30.5, 1.5)
    assert rig.depth(10.0) == pytest.approx(500 * 0.12 / 40.5)


@pytest.mark.parametrize(
    "changes",
    [
        {"R_right_left": cv2.Rodrigues(np.array([0.0, 0.02, 0.0]))[0]},
        {"right": replace(EYE, principal_point_px=(321.0, 245.0))},
        {"right": replace(EYE, focal_px=(520.0, 499.0))},
        {"left": replace(EYE, distortion=(0.1, 0.0, 0.0, 0.0))},
        {"t_right_left": np.array([-0.12, 0.05, 0.0])},
    ],
    ids=["turned", "rows", "focal", "distorted", "shifted"],
)
def test_a_false_claim_of_rectified_images_is_refused(changes: dict[str, object]) -> None:
    with pytest.raises(CalibrationError, match="images: raw"):
        make_rectifier(rectified(**changes))


@pytest.mark.parametrize("calibration", [rectified, raw])
def test_swapped_eyes_are_refused(calibration) -> None:
    with pytest.raises(CalibrationError, match="translation_m"):
        make_rectifier(calibration(t_right_left=np.array([0.12, 0.0, 0.0])))


def test_eyes_above_each_other_are_refused() -> None:
    with pytest.raises(CalibrationError, match="above"):
        make_rectifier(raw(t_right_left=np.array([0.0, -0.12, 0.0])))


def test_an_image_of_another_size_is_named_with_both_sizes() -> None:
    small = np.zeros((240, 320, 3), np.uint8)
    with pytest.raises(FrameError, match=r"320×240.*640×480") as caught:
        rectify(StereoPair(small, small, name="f", index=0), make_rectifier(rectified()))
    assert caught.value.code == "SIZE_MISMATCH"


def test_raw_points_fall_on_one_row_at_their_disparity() -> None:
    calibration = raw()
    rectifier = make_rectifier(calibration)
    assert rectifier.left is not None
    assert rectifier.right is not None
    X_left = points()
    X_right = X_left @ calibration.R_right_left.T + calibration.t_right_left
    R1, _, _, P2, *_ = cv2.stereoRectify(
        calibration.left.K, np.array(calibration.left.distortion), calibration.right.K,
        np.array(calibration.right.distortion), SIZE, calibration.R_right_left,
        calibration.t_right_left.reshape(3, 1), flags=cv2.CALIB_ZERO_DISPARITY, alpha=0,
    )  # fmt: skip
    rig, in_rectified = rectifier.rig, X_left @ R1.T
    uv = rig.project(in_rectified)
    seen = in_rectified @ P2[:, :3].T + P2[:, 3]
    np.testing.assert_allclose(seen[:, 1] / seen[:, 2], uv[:, 1], atol=1e-3)
    np.testing.assert_allclose(
        uv[:, 0] - seen[:, 0] / seen[:, 2], rig.disparity(in_rectified[:, 2]), atol=1e-3
    )
    for maps, camera, xyz, target in (
        (rectifier.left, calibration.left, X_left, uv),
        (rectifier.right, calibration.right, X_right, seen[:, :2] / seen[:, 2:]),
    ):
        inside = ((target > 1) & (target < np.array(SIZE) - 2)).all(1)
        assert inside.sum() > 10
        x, y = (
            cv2.remap(m, *target[inside].T.astype(np.float32), cv2.INTER_LINEAR).ravel()
            for m in maps
        )
        np.testing.assert_allclose(np.stack([x, y], 1), project(camera, xyz)[inside], atol=0.02)


def test_equidistant_eyes_are_rectified_with_their_own_model() -> None:
    k = (0.02, -0.005, 0.001, 0.0)
    left, right = (CameraModel((300.0, 300.0), (320.0, 240.0), k, "equidistant") for _ in range(2))
    R = cv2.Rodrigues(np.array([0.0, 0.01, 0.003]))[0]
    calibration = StereoCalibration(SIZE, left, right, R, np.array([-0.1, 0.0, 0.0]), "raw")
    rectifier = make_rectifier(calibration)
    assert rectifier.left is not None
    assert rectifier.rig.baseline_m == pytest.approx(0.1, abs=1e-6)
    centre = rectifier.left[0][240, 320], rectifier.left[1][240, 320]
    ray = cv2.fisheye.undistortPoints(np.array([[centre]], float), left.K, np.array(k))[0, 0]
    R1 = cv2.fisheye.stereoRectify(
        left.K,
        np.array(k),
        right.K,
        np.array(k),
        SIZE,
        R,
        np.array([[-0.1], [0.0], [0.0]]),
        cv2.CALIB_ZERO_DISPARITY,
    )[0]
    straight = R1 @ [*ray, 1.0]
    expected = rectifier.rig.back_project(320, 240, 1.0)
    np.testing.assert_allclose(straight / straight[2], expected, atol=1e-4)


def test_mixed_projections_are_refused() -> None:
    with pytest.raises(CalibrationError, match="projections"):
        make_rectifier(raw(left=replace(EYE, projection="equidistant", distortion=(0.0,) * 4)))


def test_the_path_traced_raw_scene_gives_its_reference_geometry(shared_data: Path) -> None:
    document = json.loads((shared_data / "scenes_dev/raw_01_large/calib.json").read_text())
    eyes = [
        CameraModel((K[0][0], K[1][1]), (K[0][2], K[1][2]), tuple(document[side]["dist"]))
        for side in ("left", "right")
        for K in [document[side]["K"]]
    ]
    t = np.array(document["t_right_left_mm"]) / 1000
    size = (document["width"], document["height"])
    rig = make_rectifier(
        StereoCalibration(size, *eyes, np.array(document["R_right_left"]), t, "raw")
    ).rig
    P1, P2 = (np.array(document["reference_rectification"][key]) for key in ("P1", "P2"))
    np.testing.assert_allclose([rig.fx, rig.cx, rig.cy], [P1[0, 0], P1[0, 2], P1[1, 2]], atol=0.01)
    assert rig.fx * rig.baseline_m * 1000 == pytest.approx(-P2[0, 3], rel=1e-4)
