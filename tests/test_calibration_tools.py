"""Calibrations of the tools and data sets that people have beside OpenCV, ROS and Kalibr: one rig,
written as each of them writes it, read to the last digits that it keeps."""

import json
import tarfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from rigs import SIZE, example_rig, rectified_rig, same, write_opencv
from scipy.spatial.transform import Rotation

from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration import load
from stereo_ore.stages.rectify import rectification
from stereo_ore.transforms import inverse
from stereo_ore.types import CameraModel, StereoCalibration

RIG = example_rig()
EYES = (RIG.left, RIG.right)
T_RIGHT_LEFT = np.eye(4)
T_RIGHT_LEFT[:3, :3], T_RIGHT_LEFT[:3, 3] = RIG.R_right_left, RIG.t_right_left
T_BODY_LEFT = np.eye(4)
T_BODY_LEFT[:3, :3] = Rotation.from_rotvec([0.1, 0.2, 1.5]).as_matrix()
T_BODY_LEFT[:3, 3] = (-0.02, -0.06, 0.01)
T_BODY = (T_BODY_LEFT, T_BODY_LEFT @ inverse(T_RIGHT_LEFT))
"""Pose of each camera on a body that is turned against both."""


def with_lens(count: int, projection: Any = "pinhole") -> StereoCalibration:
    """The rig with fewer coefficients."""
    left, right = (replace(e, distortion=e.distortion[:count], projection=projection) for e in EYES)
    return replace(RIG, left=left, right=right)


def matrix_of(eye: CameraModel) -> list[list[float]]:
    return [[float(value) for value in row] for row in eye.K]


def named(names: str, values: Sequence[float]) -> dict[str, float]:
    """The first values by their names."""
    return dict(zip(names.split(), values, strict=False))


def row(values: Any) -> str:
    return " ".join(f"{value:.15e}" for value in np.ravel(values))


def listed(values: Any) -> list[float]:
    return [float(value) for value in np.ravel(values)]


def refused(path: Path, **wishes: Any) -> str:
    with pytest.raises(CalibrationError) as fault:
        load(path, **wishes)
    return str(fault.value)


def write_json(path: Path, data: Any) -> Path:
    path.write_text(json.dumps(data))
    return path


def rectified_cameras() -> tuple[Sequence[np.ndarray], Sequence[np.ndarray]]:
    """R1, R2 and P1, P2 as ``cv2.stereoRectify`` makes them of the rig."""
    R1, R2, P1, P2 = cv2.stereoRectify(
        RIG.left.K, np.array(RIG.left.distortion), RIG.right.K, np.array(RIG.right.distortion),
        SIZE, RIG.R_right_left, RIG.t_right_left.reshape(3, 1),
        flags=cv2.CALIB_ZERO_DISPARITY, alpha=0,
    )[:4]  # fmt: skip
    return (R1, R2), (P1, P2)


# --- EuRoC and TUM-VI


def write_euroc(folder: Path, name: str, model: str = "radial-tangential") -> Path:
    for number, (eye, T) in enumerate(zip(EYES, T_BODY, strict=True)):
        path = folder / name.format(number)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(
            f"# General sensor definitions.\nsensor_type: camera\ncomment: VI-Sensor cam{number}\n"
            f"T_BS:\n  cols: 4\n  rows: 4\n  data: {listed(T)}\nrate_hz: 20\n"
            f"resolution: {list(SIZE)}\ncamera_model: pinhole\n"
            f"intrinsics: {[*eye.focal_px, *eye.principal_point_px]} #fu, fv, cu, cv\n"
            f"distortion_model: {model}\ndistortion_coefficients: {list(eye.distortion[:4])}\n"
        )
    return folder / name.format(0)


@pytest.mark.parametrize("name", ["mav0/cam{}/sensor.yaml", "cam{}_sensor.yaml"])
def test_euroc(name: str, tmp_path: Path) -> None:
    left = write_euroc(tmp_path, name)
    assert same(with_lens(4), load(left), 1e-11)
    assert same(with_lens(4), load(tmp_path / name.format(1)), 1e-11)


def test_tum_vi(tmp_path: Path) -> None:
    path = write_euroc(tmp_path, "mav0/cam{}/sensor.yaml", "equidistant")
    assert same(with_lens(4, "equidistant"), load(path), 1e-11)
    (tmp_path / "mav0/cam1/sensor.yaml").unlink()
    assert "cam1/sensor.yaml: no such file" in refused(path)


# --- Basalt


def basalt(kind: str, names: str, **more: float) -> dict[str, Any]:
    cameras, poses = [], []
    for eye, T in zip(EYES, T_BODY, strict=True):
        centre = named("fx fy cx cy", (*eye.focal_px, *eye.principal_point_px))
        lens = named(names, eye.distortion)
        cameras.append({"camera_type": kind, "intrinsics": centre | lens | more})
        q = Rotation.from_matrix(T[:3, :3]).as_quat()
        poses.append(named("px py pz qx qy qz qw", listed([*T[:3, 3], *q])))
    inner = {"T_imu_cam": poses, "intrinsics": cameras, "resolution": [list(SIZE)] * 2}
    return {"value0": inner | {"calib_accel_bias": [0.01] * 9, "vignette": []}}


def test_basalt(tmp_path: Path) -> None:
    path = tmp_path / "calibration.json"
    write_json(path, basalt("kb4", "k1 k2 k3 k4"))
    assert same(with_lens(4, "equidistant"), load(path), 1e-11)
    write_json(path, basalt("pinhole-radtan8", "k1 k2 p1 p2 k3", k4=0.0, k5=0.0, k6=0.0, rpmax=2.7))
    assert same(RIG, load(path), 1e-11)
    write_json(path, basalt("ds", "", xi=-0.2, alpha=0.6))
    assert "'ds' is none of pinhole, kb4, pinhole-radtan8" in refused(path)


# --- KITTI and DrivingStereo


def kitti_raw(
    numbers: tuple[str, str] = ("00", "01"), rectified: tuple[int, int] = (1242, 375)
) -> str:
    rotations, projections = rectified_cameras()
    poses = (np.eye(4), T_RIGHT_LEFT)
    text = "calib_time: 09-Jan-2012 13:57:47\ncorner_dist: 9.950000e-02\n"
    for n, eye, T, R, P in zip(numbers, EYES, poses, rotations, projections, strict=True):
        text += (
            f"S_{n}: {row(SIZE)}\nK_{n}: {row(matrix_of(eye))}\nD_{n}: {row(eye.distortion)}\n"
            f"R_{n}: {row(T[:3, :3])}\nT_{n}: {row(T[:3, 3])}\n"
            f"S_rect_{n}: {row(rectified)}\nR_rect_{n}: {row(R)}\nP_rect_{n}: {row(P)}\n"
        )
    return text


@pytest.mark.parametrize("numbers", [("00", "01"), ("02", "03"), ("101", "103")])
def test_kitti_of_raw_images(numbers: tuple[str, str], tmp_path: Path) -> None:
    """What the images are is said, or told by their size, which differs in KITTI."""
    path = tmp_path / "calib_cam_to_cam.txt"
    path.write_text(kitti_raw(numbers))
    assert same(RIG, load(path, images="raw"), 1e-11)
    assert same(RIG, load(path, recorded_size=SIZE), 1e-11)


def test_kitti_of_rectified_images(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path, size = tmp_path / "calib_cam_to_cam.txt", (1242, 720)
    path.write_text(kitti_raw(rectified=size))
    (_, _), (P1, P2) = rectified_cameras()
    for wishes in ({}, {"recorded_size": size}, {"images": "rectified"}):
        rig = load(path, **wishes)
        assert (rig.images, rig.image_size) == ("rectified", size)
        assert rig.left.focal_px == pytest.approx((P1[0, 0], P1[1, 1]), abs=1e-9)
        assert rig.t_right_left == pytest.approx([P2[0, 3] / P2[0, 0], 0, 0], abs=1e-12)
    assert "taken for rectified images" in caplog.text
    edited = kitti_raw(rectified=size).replace(
        f"P_rect_01: {row(P2)}", f"P_rect_01: {row(P2 * [1, 1, 1, 2])}"
    )
    path.write_text(edited)
    assert "the rectified cameras are 0.24 m apart, the raw ones 0.12 m" in refused(path)


def test_kitti_of_sequences(tmp_path: Path) -> None:
    """Four cameras, each as far from the first as its P says; the file gives no size."""
    P = np.array([[530.0, 0, 640, 0], [0, 530, 360, 0], [0, 0, 1, 0]])
    path = tmp_path / "calib.txt"
    shifts = (0.0, -0.54, 0.06, -0.47)
    lines = [f"P{n}: {row(P + 530 * along * np.eye(3, 4, 3))}" for n, along in enumerate(shifts)]
    path.write_text("\n".join([*lines, f"Tr: {row(np.eye(3, 4))}"]))
    assert "--eyes 0,1 (grey) or --eyes 2,3 (colour)" in refused(path, image_size=SIZE)
    assert "does not say the image size" in refused(path, eyes=(2, 3), recorded_size=SIZE)
    rig = load(path, image_size=SIZE, eyes=(2, 3))
    assert same(replace(rectified_rig(), t_right_left=np.array([-0.53, 0, 0])), rig, 1e-11)


# --- MATLAB


def matlab(old: bool, **changes: Any) -> dict[str, Any]:
    cameras = []
    for eye in EYES:
        k1, k2, p1, p2, k3 = eye.distortion
        matrix = eye.K + np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0]])
        camera = {
            "Version": {}, "RadialDistortion": [k1, k2, k3], "TangentialDistortion": [p1, p2],
            "ImageSize": [SIZE[1], SIZE[0]], "WorldUnits": "millimeters", "EstimateSkew": 0,
            "NumRadialDistortionCoefficients": 3, "EstimateTangentialDistortion": 1,
        }  # fmt: skip
        matrices = {"IntrinsicMatrix": matrix.T.tolist()} if old else {"K": matrix.tolist()}
        cameras.append(camera | matrices | changes)
    shift = listed(1000 * RIG.t_right_left)
    pose = (
        {"RotationOfCamera2": RIG.R_right_left.T.tolist(), "TranslationOfCamera2": shift}
        if old
        else {"PoseCamera2": {"R": RIG.R_right_left.tolist(), "Translation": shift}}
    )
    return {"CameraParameters1": cameras[0], "CameraParameters2": cameras[1], **pose}


@pytest.mark.parametrize("old", [True, False])
def test_matlab(old: bool, tmp_path: Path) -> None:
    """Pixels from 1, (rows, columns), transposed matrices, millimetres."""
    assert same(RIG, load(write_json(tmp_path / "stereo.json", matlab(old))), 1e-11)
    metres = write_json(tmp_path / "m.json", matlab(old, WorldUnits="meters"))
    assert "a baseline of 120" in refused(metres)
    assert same(RIG, load(metres, unit_m=0.001), 1e-11)
    skewed = write_json(tmp_path / "skewed.json", matlab(old, Skew=0.4))
    assert "pixels are skewed" in refused(skewed)
    unit = write_json(tmp_path / "unit.json", matlab(old, WorldUnits="parsec"))
    assert "WorldUnits: 'parsec' is no unit" in refused(unit)


def test_a_mat_file_says_how_to_export(tmp_path: Path) -> None:
    (tmp_path / "stereoParams.mat").write_bytes(b"MATLAB 5.0 MAT-file, Platform: GLNXA64\xff\x00")
    assert "jsonencode(toStruct(stereoParams))" in refused(tmp_path / "stereoParams.mat")


# --- VINS-Fusion, stella_vslam, ORB-SLAM


def storage_matrix(name: str, T: np.ndarray) -> str:
    return f"{name}: !!opencv-matrix\n   rows: 4\n   cols: 4\n   dt: d\n   data: {listed(T)}\n"


def write_vins(folder: Path, fisheye: bool = False) -> Path:
    for number, eye in enumerate(EYES):
        values = {"camera_name": "camera", "image_width": SIZE[0], "image_height": SIZE[1]}
        if fisheye:
            names = "mu mv u0 v0 k2 k3 k4 k5"
            numbers = (*eye.focal_px, *eye.principal_point_px, *eye.distortion[:4])
            parts = {"projection_parameters": named(names, numbers)}
        else:
            parts = {
                "distortion_parameters": named("k1 k2 p1 p2", eye.distortion),
                "projection_parameters": named(
                    "fx fy cx cy", (*eye.focal_px, *eye.principal_point_px)
                ),
            }
        kind = {"model_type": "KANNALA_BRANDT" if fisheye else "PINHOLE"}
        text = yaml.safe_dump(kind | values | parts, sort_keys=False)
        (folder / f"cam{number}_pinhole.yaml").write_text(f"%YAML:1.0\n---\n{text}")
    (folder / "vins.yaml").write_text(
        '%YAML:1.0\n\nimu: 1\nnum_of_cam: 2\nimu_topic: "/imu0"\ncam0_calib: "cam0_pinhole.yaml"\n'
        'cam1_calib: "cam1_pinhole.yaml"\nimage_width: 1280\nimage_height: 720\nmin_dist: 30\n'
        + "".join(storage_matrix(f"body_T_cam{n}", T) for n, T in enumerate(T_BODY))
    )
    return folder / "vins.yaml"


def test_vins_fusion(tmp_path: Path) -> None:
    assert same(with_lens(4), load(write_vins(tmp_path)), 1e-11)
    assert same(with_lens(4, "equidistant"), load(write_vins(tmp_path, fisheye=True)), 1e-11)
    eye = tmp_path / "cam0_pinhole.yaml"
    assert "describes one eye alone. Name the settings" in refused(eye)
    eye.write_text(eye.read_text().replace("KANNALA_BRANDT", "MEI"))
    assert "'MEI' is none of PINHOLE, KANNALA_BRANDT" in refused(tmp_path / "vins.yaml")


@pytest.mark.parametrize("key", ["k6", "xi", "lens_tilt"])
def test_an_unknown_entry_of_an_eye_of_vins_is_refused(key: str, tmp_path: Path) -> None:
    path = write_vins(tmp_path)
    eye = tmp_path / "cam1_pinhole.yaml"
    eye.write_text(eye.read_text().replace("  k1:", f"  {key}: 0.1\n  k1:"))
    assert key in refused(path)


def stella(rectifier: bool) -> dict[str, Any]:
    rotations, (P1, P2) = rectified_cameras()
    camera = {
        "name": "stereo", "setup": "stereo", "model": "perspective", "fx": P1[0, 0], "fy": P1[1, 1],
        "cx": P1[0, 2], "cy": P1[1, 2], "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0, "k3": 0.0,
        "fps": 20.0, "cols": SIZE[0], "rows": SIZE[1], "focal_x_baseline": -P2[0, 3],
        "depth_threshold": 40, "color_order": "Gray",
    }  # fmt: skip
    camera = {k: float(v) if isinstance(v, np.floating) else v for k, v in camera.items()}
    raw = {
        f"{letter}_{side}": listed(values)
        for side, eye, R in zip(("left", "right"), EYES, rotations, strict=True)
        for letter, values in (("K", eye.K), ("D", eye.distortion), ("R", R))
    }
    return {"Camera": camera} | ({"StereoRectifier": raw} if rectifier else {})


@pytest.mark.parametrize("dotted", [False, True])
def test_stella_vslam(dotted: bool, tmp_path: Path) -> None:
    def write(data: dict[str, Any]) -> Path:
        if dotted:  # as OpenVSLAM had them
            data = {f"{a}.{b}": value for a, group in data.items() for b, value in group.items()}
        (tmp_path / "stella.yaml").write_text(yaml.safe_dump(data, sort_keys=False))
        return tmp_path / "stella.yaml"

    assert same(RIG, load(write(stella(rectifier=True))), 1e-9)
    _, (P1, P2) = rectified_cameras()
    rig = load(write(stella(rectifier=False)))
    assert (rig.images, rig.left.distortion) == ("rectified", ())
    assert rig.left.focal_px == pytest.approx((P1[0, 0], P1[1, 1]))
    assert rig.t_right_left == pytest.approx([P2[0, 3] / P2[0, 0], 0, 0])


ORB = "%YAML:1.0\n{name}.fx: 530.0\n{name}.fy: 530.0\n{name}.cx: 640.0\n{name}.cy: 360.0\n" + (
    "{shift}\nCamera.width: 1280\nCamera.height: 720\nCamera.fps: 30\nORBextractor.nFeatures: 900\n"
)
ORB_3 = ORB.format(name="Camera1", shift='Camera.type: "Rectified"\nStereo.b: 0.12')
ORB_2 = ORB.format(name="Camera", shift="Camera.bf: 63.6\nCamera.k1: 0.0\nCamera.p1: 0.0")


@pytest.mark.parametrize("text", [ORB_3, ORB_2])
def test_orb_slam_of_rectified_images(text: str, tmp_path: Path) -> None:
    path = tmp_path / "settings.yaml"
    path.write_text(text)
    assert same(rectified_rig(), load(path), 1e-11)
    assert "rectified images, not raw ones" in refused(path, images="raw")
    lens = "Camera1.k2: 0.2" if "Camera1" in text else "Camera.k2: 0.2"
    path.write_text(text.replace("Camera.fps: 30", lens))
    assert "the lenses have distortion" in refused(path), "settings of a depth camera, not of eyes"


# --- what people write themselves


def plain(
    lists: Callable[[Any], Any] = lambda values: np.asarray(values).tolist(),
) -> dict[str, Any]:
    eyes = {
        f"{name}{mark}": lists(values)
        for mark, eye in zip("LR", EYES, strict=True)
        for name, values in (("cameraMatrix", eye.K), ("dist", [eye.distortion]))
    }
    return eyes | {
        "R": lists(RIG.R_right_left),
        "T": lists(RIG.t_right_left.reshape(3, 1)),
        "imageSize": lists(SIZE),
    }


def grouped(eye_names: tuple[str, str], centre: bool = False) -> dict[str, Any]:
    def lens(eye: CameraModel) -> dict[str, Any]:
        if not centre:
            return {"camera_matrix": matrix_of(eye), "distortion": list(eye.distortion)}
        numbers = (*eye.focal_px, *eye.principal_point_px, *eye.distortion)
        return named("fx fy cx cy k1 k2 p1 p2 k3", numbers)

    eyes = {name: lens(eye) for name, eye in zip(eye_names, EYES, strict=True)}
    pose = {"R": RIG.R_right_left.tolist(), "T": listed(RIG.t_right_left)}
    return eyes | {"extrinsics": pose, "image_size": list(SIZE)}


OWN = {
    "flat": plain(),
    "left, right": grouped(("left", "right")),
    "camera_left": grouped(("camera_left", "camera_right")),
    "cam0": grouped(("cam0", "cam1")),
    "cam1": grouped(("cam1", "cam2")),
    "fx, k1": grouped(("left", "right"), centre=True),
}


@pytest.mark.parametrize("suffix", ["json", "yaml"])
@pytest.mark.parametrize("kind", OWN)
def test_names_of_opencv_in_files_of_ones_own(kind: str, suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"stereo.{suffix}"
    path.write_text(json.dumps(OWN[kind]) if suffix == "json" else yaml.safe_dump(OWN[kind]))
    assert same(RIG, load(path), 1e-11)


def test_an_npz_of_arrays(tmp_path: Path) -> None:
    np.savez(tmp_path / "stereo.npz", **plain(np.asarray), note=np.array("of May"))
    assert same(RIG, load(tmp_path / "stereo.npz"), 1e-11)
    np.savez_compressed(tmp_path / "bomb.npz", K1=np.zeros(9_000_000))
    assert "claims arrays of" in refused(tmp_path / "bomb.npz")
    np.savez(tmp_path / "objects.npz", T=np.array([{}], object), K1=np.eye(3))
    assert "Python objects, which are never loaded" in refused(tmp_path / "objects.npz")


def test_own_names_are_never_half_understood(tmp_path: Path) -> None:
    path = tmp_path / "stereo.json"
    one = {key: value for key, value in plain().items() if key != "distR"}
    assert "has no D2" in refused(write_json(path, one))
    swapped = plain() | {"T": [0.12, 0, 0]}
    assert "are left and right swapped?" in refused(write_json(path, swapped))
    poses = {
        eye: {"K": matrix_of(RIG.left), "R": np.eye(3).tolist(), "T": [0, 0, 0]}
        for eye in ("left", "right")
    }
    assert "has no R" in refused(write_json(path, poses))


def test_a_pose_that_only_the_rectification_holds(tmp_path: Path) -> None:
    """MultiSense's extrinsics.yml has R1, P1, R2, P2 and neither R nor T."""
    whole = write_opencv(RIG, tmp_path / "whole.yml")
    (R1, R2), (P1, P2) = rectified_cameras()
    storage = cv2.FileStorage(str(tmp_path / "extrinsics.yml"), cv2.FILE_STORAGE_WRITE)
    for name, values in (("R1", R1), ("P1", P1), ("R2", R2), ("P2", P2)):
        storage.write(name, values)
    storage.release()
    text = whole.read_text()
    (tmp_path / "intrinsics.yml").write_text(
        text[: text.index("R: !!")] + "imageWidth: 1280\nimageHeight: 720\n"
    )
    for name in ("extrinsics.yml", "intrinsics.yml"):
        assert same(RIG, load(tmp_path / name), 1e-9)
    np.testing.assert_allclose(rectification(load(tmp_path / "extrinsics.yml"))[0], R1, atol=1e-9)


def test_an_archive_says_to_unpack_it(tmp_path: Path) -> None:
    (tmp_path / "left.yaml").write_text("camera_name: left\n")
    with tarfile.open(tmp_path / "calibrationdata.tar.gz", "w:gz") as archive:
        archive.add(tmp_path / "left.yaml", "left.yaml")
    assert "Unpack it (tar xf)" in refused(tmp_path / "calibrationdata.tar.gz")


def test_camera_infos_as_json(tmp_path: Path) -> None:
    """As a bridge to the web gives them."""
    for side, eye, R, P in zip(("left", "right"), EYES, *rectified_cameras(), strict=True):
        info = {"height": SIZE[1], "width": SIZE[0], "distortion_model": "plumb_bob"}
        matrices = {"d": listed(eye.distortion), "k": listed(eye.K), "r": listed(R), "p": listed(P)}
        (tmp_path / f"{side}.json").write_text(json.dumps(info | matrices, indent=1))
    assert same(RIG, load(tmp_path / "left.json"), 1e-9)
