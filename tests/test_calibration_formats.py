"""Foreign calibration formats: round trips, real files, every kind of broken file."""

import contextlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rigs import SIZE, example_rig, raw_rigs, same, write_kalibr, write_opencv, write_ros, write_zed

from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration import CALIBRATION_FORMATS, load, save
from stereo_ore.stages.rectify import make_rectifier

MANY = settings(
    deadline=None, max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def refused(path: Path, **wishes: object) -> str:
    with pytest.raises(CalibrationError) as fault:
        load(path, **wishes)
    return str(fault.value)


def edit(path: Path, old: str, new: str) -> Path:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    return path


def assert_round_trip(rig, path: Path, tolerance: float, **wishes: object) -> None:
    """Foreign → ours is the rig; ours → native → ours is the same to the last bit."""
    read = load(path, **wishes)
    assert same(replace(rig, disparity_offset_px=0.0), read, tolerance)
    save(read, path.parent / "native.yaml")
    assert same(read, load(path.parent / "native.yaml"))


@MANY
@given(rig=raw_rigs())
def test_zed_round_trip(rig, tmp_path: Path) -> None:
    assert_round_trip(rig, write_zed(rig, tmp_path / "SN1.conf"), 1e-11, image_size=SIZE)


@MANY
@given(rig=raw_rigs())
def test_opencv_round_trip(rig, tmp_path: Path) -> None:
    for suffix in ("yml", "xml", "json"):
        assert_round_trip(rig, write_opencv(rig, tmp_path / f"camera.{suffix}"), 1e-11)


@MANY
@given(rig=raw_rigs())
def test_ros_round_trip(rig, tmp_path: Path) -> None:
    # cv2.stereoRectify, by which the files are made, loses turns below 1e-5 rad.
    assert_round_trip(rig, write_ros(rig, tmp_path), 1e-5)


@MANY
@given(rig=raw_rigs(coefficients=4))
def test_kalibr_round_trip(rig, tmp_path: Path) -> None:
    assert_round_trip(rig, write_kalibr(rig, tmp_path / "camchain.yaml"), 1e-11)


def test_kalibr_equidistant_keeps_its_projection(tmp_path: Path) -> None:
    eyes = [
        replace(eye, distortion=eye.distortion[:4])
        for eye in (example_rig().left, example_rig().right)
    ]
    rig = replace(example_rig(), left=eyes[0], right=eyes[1])
    path = write_kalibr(rig, tmp_path / "camchain.yaml", "equidistant")
    fisheye = [replace(eye, projection="equidistant") for eye in eyes]
    assert_round_trip(replace(rig, left=fisheye[0], right=fisheye[1]), path, 1e-11)


@pytest.mark.parametrize(
    "left_out", [("p1",), ("p2", "k3"), ("p1", "p2", "k3"), ("TY_HD", "TZ_HD")]
)
def test_a_zed_file_may_lack_small_terms(tmp_path: Path, left_out: tuple[str, ...]) -> None:
    read = load(write_zed(example_rig(), tmp_path / "SN1.conf", left_out=left_out), image_size=SIZE)
    for key, value in zip(("k1", "k2", "p1", "p2", "k3"), read.left.distortion, strict=True):
        assert value == (
            0.0
            if key in left_out
            else example_rig().left.distortion[("k1", "k2", "p1", "p2", "k3").index(key)]
        )
    assert read.t_right_left[1] == pytest.approx(
        0 if "TY_HD" in left_out else example_rig().t_right_left[1]
    )


@pytest.mark.parametrize("suffix", [True, False])
@pytest.mark.parametrize("upper", [True, False])
def test_zed_spellings(tmp_path: Path, suffix: bool, upper: bool) -> None:
    path = write_zed(example_rig(), tmp_path / "SN1.conf", suffix=suffix)
    path.write_text(path.read_text() if upper else path.read_text().lower())
    assert same(example_rig(), load(path, image_size=SIZE), 1e-11)
    assert same(example_rig(), load(path), 1e-11), "the only resolution needs no size"


def test_zed_eight_coefficients_of_newer_files(tmp_path: Path) -> None:
    path = write_zed(example_rig(), tmp_path / "SN1.conf", left_out=("k1", "k2", "k3", "p1", "p2"))
    wide = "\n".join(
        f"{key}={index / 1000}"
        for index, key in enumerate(("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"))
    )
    path.write_text(
        path.read_text() + f"[LEFT_DISTO]\n{wide}\n[RIGHT_DISTO]\n{wide}\n[MISC]\nSensor_ID=abc\n"
    )
    assert load(path).left.distortion == tuple(index / 1000 for index in range(8))


def test_the_real_zed_file(shared_data: Path) -> None:
    path = shared_data / "calib/SN1010.conf"
    hd = load(path, image_size=(1280, 720))
    assert hd.left.focal_px == (700.895, 700.895)
    assert hd.right.principal_point_px == (639.74, 374.974)
    assert hd.t_right_left.tolist() == [-0.12, 0, 0]
    assert (hd.R_right_left[2, 1] - hd.R_right_left[1, 2]) / 2 == pytest.approx(
        0.00612931, rel=1e-4
    )
    assert load(path, image_size=(2208, 1242)).left.principal_point_px == (1158.08, 646.31)
    message = refused(path)
    assert all(word in message for word in ("2K (2208×1242)", "VGA (672×376)", "--size"))
    assert "1024×768" in refused(path, image_size=(1024, 768))
    assert "raw images" in refused(path, image_size=(1280, 720), images="rectified")


ZED_FAULTS = {
    "missing focal length": ("fx=", "gx=", "did you mean"),
    "not a number": ("Baseline=120.0", "Baseline=wide", "'wide' is not a number"),
    "negative baseline": ("Baseline=120.0", "Baseline=-120.0", "swapped"),
    "metres for millimetres of millimetres": ("Baseline=120.0", "Baseline=120000", "millimetres"),
    "missing section": ("[RIGHT_CAM_HD]", "[RIGHT_CAM_XX]", "RIGHT_CAM_HD"),
    "no baseline": ("Baseline", "Base", "baseline"),
    "no rotation": ("CV_HD", "CX_HD", "cv_hd"),
    "nan": ("Baseline=120.0", "Baseline=nan", "finite"),
    "no INI": ("[STEREO]", "[STEREO", "INI"),
}


@pytest.mark.parametrize("fault", ZED_FAULTS)
def test_a_broken_zed_file_is_refused_by_name(tmp_path: Path, fault: str) -> None:
    old, new, word = ZED_FAULTS[fault]
    path = edit(write_zed(example_rig(), tmp_path / "SN1.conf"), old, new)
    assert word in refused(path, image_size=SIZE)


@pytest.mark.parametrize(
    "names",
    [
        {"M1": "cameraMatrix1", "M2": "cameraMatrix2", "D1": "distCoeffs1", "D2": "distCoeffs2"},
        {"M1": "K1", "M2": "K2", "R": "rotation_matrix", "T": "translation_vector"},
        {"M1": "left_K", "M2": "right_K", "D1": "left_D", "D2": "right_D"},
    ],
)
def test_opencv_spellings(tmp_path: Path, names: dict[str, str]) -> None:
    assert same(
        example_rig(), load(write_opencv(example_rig(), tmp_path / "camera.yml", names)), 1e-11
    )


def test_opencv_units_are_said_not_guessed(tmp_path: Path) -> None:
    rig = example_rig()
    path = write_opencv(replace(rig, t_right_left=1000 * rig.t_right_left), tmp_path / "camera.yml")
    assert "millimetres" in refused(path)
    assert same(rig, load(path, unit_m=0.001), 1e-11)


def test_opencv_without_a_size_asks_for_it(tmp_path: Path) -> None:
    path = write_opencv(example_rig(), tmp_path / "camera.yml")
    path.write_text(
        "\n".join(line for line in path.read_text().splitlines() if "image_" not in line) + "\n"
    )
    assert "--size" in refused(path)
    assert same(example_rig(), load(path, image_size=SIZE), 1e-11)


OPENCV_FAULTS = {
    "reflection": ("R", np.diag([1.0, 1.0, -1.0]), "reflection"),
    "no rotation": ("R", 2 * np.eye(3), "orthonormal"),
    "rotation of two rows": ("R", np.eye(2), "3 or 9"),
    "short translation": ("T", np.zeros(2), "3 numbers"),
    "short matrix": ("M1", np.eye(2), "9 numbers"),
    "nan": ("T", np.array([-0.12, np.nan, 0.0]), "numbers"),
    "swapped": ("T", np.array([0.12, 0.0, 0.0]), "swapped"),
}


@pytest.mark.parametrize("fault", OPENCV_FAULTS)
def test_a_broken_opencv_file_is_refused_by_name(tmp_path: Path, fault: str) -> None:
    key, value, word = OPENCV_FAULTS[fault]
    assert word in refused(
        write_opencv(example_rig(), tmp_path / "camera.yml", changes={key: value})
    )


def test_a_cut_opencv_file_and_one_eye_alone_are_refused(tmp_path: Path, shared_data: Path) -> None:
    path = write_opencv(example_rig(), tmp_path / "camera.xml")
    path.write_text(path.read_text()[:400])
    assert "FileStorage" in refused(path)
    assert "has no K1" in refused(shared_data / "boards/opencv/left_intrinsics.yml")


ROS_FAULTS = {
    "uncalibrated": ({"camera_matrix": [0.0] * 9}, "never calibrated"),
    "eyes exchanged": (
        {"projection_matrix": [500.0, 0, 640, -160, 0, 500, 360, 0, 0, 0, 1, 0]},
        "swapped",
    ),
    "another model": ({"distortion_model": "weird"}, "weird"),
    "no rotation": ({"rectification_matrix": [2.0, 0, 0, 0, 2, 0, 0, 0, 2]}, "orthonormal"),
    "short": ({"camera_matrix": [1.0, 2.0]}, "9 numbers"),
    "text": ({"image_width": "wide"}, "wide"),
    "another size": ({"image_width": 1000}, "1000"),
}


@pytest.mark.parametrize("fault", ROS_FAULTS)
def test_a_broken_ros_file_is_refused_by_name(tmp_path: Path, fault: str) -> None:
    changes, word = ROS_FAULTS[fault]
    path = write_ros(example_rig(), tmp_path)
    document = yaml.safe_load(path.read_text())
    for key, value in changes.items():
        document[key] = {"data": value} if isinstance(value, list) else value
    path.write_text(yaml.safe_dump(document))
    assert word in refused(path)


def test_ros_baseline_off_by_a_thousand_and_missing_partner(tmp_path: Path) -> None:
    path = write_ros(example_rig(), tmp_path)
    right = tmp_path / "right.yaml"
    document = yaml.safe_load(right.read_text())
    document["projection_matrix"]["data"][3] *= 1000
    right.write_text(yaml.safe_dump(document))
    assert "millimetres" in refused(path)
    assert same(example_rig(), load(path, unit_m=0.001), 1e-8)
    right.rename(tmp_path / "other.yaml")
    assert "right.yaml" in refused(path)
    assert "left or right" in refused(tmp_path / "other.yaml")


def test_ros_message_spelling(tmp_path: Path) -> None:
    path = write_ros(example_rig(), tmp_path)
    short = {
        "camera_matrix": "K",
        "distortion_coefficients": "D",
        "rectification_matrix": "R",
        "projection_matrix": "P",
    }
    for side in ("left", "right"):
        document = yaml.safe_load((tmp_path / f"{side}.yaml").read_text())
        message = {short.get(key, key.removeprefix("image_")): document[key] for key in document}
        message |= {key: message[key]["data"] for key in short.values()}
        (tmp_path / f"{side}.yaml").write_text("# echoed\n" + yaml.safe_dump(message))
    assert same(example_rig(), load(path), 1e-8)


@pytest.mark.parametrize(
    ("file", "eyes", "baseline_mm"),
    [
        ("camchain-kalibr.yaml", (0, 1), 119.2),
        ("camchain-kalibr.yaml", (3, 4), 119.9),
        ("camchain-kalibr.yaml", (5, 6), 497.7),
        ("camchain-bb2_bb3_pancam.yaml", (0, 1), 119.3),
    ],
)
def test_real_kalibr_chains(
    shared_data: Path, file: str, eyes: tuple[int, int], baseline_mm: float
) -> None:
    rig = load(shared_data / "calib" / file, eyes=eyes)
    assert 1000 * np.linalg.norm(rig.t_right_left) == pytest.approx(baseline_mm, abs=0.06)
    assert make_rectifier(rig).rig.baseline_m == pytest.approx(np.linalg.norm(rig.t_right_left))


def test_a_long_kalibr_chain_asks_which_eyes(shared_data: Path) -> None:
    path = shared_data / "calib/camchain-kalibr.yaml"
    assert "--eyes" in refused(path)
    assert "cam9" in refused(path, eyes=(0, 9))
    assert "swapped" in refused(path, eyes=(1, 0))
    assert "images of" in refused(path, eyes=(0, 4))


KALIBR_FAULTS = {
    "missing intrinsics": ("intrinsics", "intrinsic", "did you mean intrinsic"),
    "another model": ("radtan", "fov", "fov"),
    "another camera": ("pinhole", "omni", "omni"),
    "no transform": ("T_cn_cnm1", "T_cam_imu", "T_cn_cnm1"),
    "no number": ("1280", "wide", "wide"),
}


@pytest.mark.parametrize("fault", KALIBR_FAULTS)
def test_a_broken_kalibr_file_is_refused_by_name(tmp_path: Path, fault: str) -> None:
    old, new, word = KALIBR_FAULTS[fault]
    eyes = [
        replace(eye, distortion=eye.distortion[:4])
        for eye in (example_rig().left, example_rig().right)
    ]
    path = write_kalibr(
        replace(example_rig(), left=eyes[0], right=eyes[1]), tmp_path / "camchain.yaml"
    )
    assert word in refused(edit(path, old, new))


def test_real_middlebury_files_with_stray_spaces(shared_data: Path) -> None:
    rig = make_rectifier(
        load(shared_data / "stereo_gt/middlebury_v3_quarter/Adirondack/calib.txt")
    ).rig
    assert (rig.fx, rig.cx, rig.doffs_px) == pytest.approx((1038.018, 322.037, 53.271))
    assert rig.baseline_m == pytest.approx(0.176252)
    assert rig.depth(20.0) == pytest.approx(1038.018 * 0.176252 / 73.271)


def test_all_real_middlebury_and_eth3d_files_load(shared_data: Path) -> None:
    files = sorted(shared_data.glob("calib/*/*/calib.txt")) + sorted(
        shared_data.glob("stereo_gt/*/*/calib.txt")
    )
    assert len(files) >= 11
    assert all(load(file).images == "rectified" for file in files)


MIDDLEBURY = (
    "cam0=[999.4 0 294.2; 0 999.4 252.9; 0 0 1]\ncam1=[999.4 0 327.0; 0 999.4 252.9; 0 0 1]\n"
)
MIDDLEBURY += "doffs=32.8\nbaseline=193.001\nwidth=741\nheight=497\nndisp=70\n"
MIDDLEBURY_FAULTS = {
    "doffs ignored": ("doffs=32.8", "doffs=0", "doffs"),
    "no baseline": ("baseline", "base", "baseline"),
    "no number": ("193.001", "wide", "wide"),
    "negative baseline": ("193.001", "-193.001", "swapped"),
    "short matrix": ("252.9; 0 0 1", "252.9", "9 numbers"),
    "rows differ": ("0 999.4 252.9; 0 0 1]\ndoffs", "0 999.4 255.9; 0 0 1]\ndoffs", "rows"),
    "zero width": ("width=741", "width=0", "image size"),
}


@pytest.mark.parametrize("fault", MIDDLEBURY_FAULTS)
def test_a_broken_middlebury_file_is_refused_by_name(tmp_path: Path, fault: str) -> None:
    old, new, word = MIDDLEBURY_FAULTS[fault]
    path = tmp_path / "calib.txt"
    path.write_text(MIDDLEBURY)
    assert load(path).left.focal_px == (999.4, 999.4)
    assert word in refused(edit(path, old, new))


def test_formats_are_told_apart_by_content_alone(tmp_path: Path) -> None:
    write_zed(example_rig(), tmp_path / "zed")
    write_opencv(example_rig(), tmp_path / "a.xml").rename(tmp_path / "opencv")
    write_ros(example_rig(), tmp_path).rename(tmp_path / "ros")
    write_kalibr(example_rig(), tmp_path / "kalibr")
    (tmp_path / "middlebury").write_text(MIDDLEBURY)
    save(example_rig(), tmp_path / "native")
    for name in ("zed", "opencv", "ros", "kalibr", "middlebury", "native"):
        text = (tmp_path / name).read_text()
        assert [
            other for other, module in CALIBRATION_FORMATS.items() if module.recognises(text)
        ] == [name]


WRITERS = {
    "SN1.conf": lambda path: write_zed(example_rig(), path),
    "camera.xml": lambda path: write_opencv(example_rig(), path),
    "camera.yml": lambda path: write_opencv(example_rig(), path),
    "camera.json": lambda path: write_opencv(example_rig(), path),
    "left.yaml": lambda path: write_ros(example_rig(), path.parent),
    "camchain.yaml": lambda path: write_kalibr(example_rig(), path),
    "calib.txt": lambda path: path.write_text(MIDDLEBURY),
    "native.yaml": lambda path: save(example_rig(), path),
}


@pytest.mark.parametrize("name", WRITERS)
@MANY
@given(data=st.data())
def test_a_damaged_file_is_an_error_or_a_calibration_never_a_crash(
    name: str, data: st.DataObject, tmp_path: Path
) -> None:
    path = tmp_path / name
    WRITERS[name](path)
    text = path.read_text()
    start = data.draw(st.integers(0, len(text) - 1))
    piece = data.draw(
        st.sampled_from(["", "nan", "1e400", "-", "[", "}", "<", ":", "\n", "*a", "null", "x" * 50])
    )
    path.write_text(text[:start] + piece + text[start + data.draw(st.integers(0, 40)) :])
    with contextlib.suppress(CalibrationError):
        read = load(path, image_size=SIZE)
        assert np.isfinite(read.left.K).all()
        assert read.t_right_left[0] < 0
