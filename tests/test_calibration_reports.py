"""Calibration files of real tools and real people: each kind, with its right value, from
../shared/data."""

import gzip
import logging
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from rigs import SIZE, example_rig, same, write_opencv, write_ros

from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration import CALIBRATION_FORMATS, load, save
from stereo_ore.io.calibration.formats import tell_unread
from stereo_ore.io.calibration.geometry import rotation_vector
from stereo_ore.stages.rectify import make_rectifier
from stereo_ore.types import StereoCalibration

TRUTH = {
    "focal": ((700.0, 702.0), (701.0, 703.0)),
    "centre": ((640.3, 361.2), (638.7, 359.6)),
    "turn": (0.002, 0.008, 0.003),
    "shift": (-0.11999562002810492, -0.00036095537385780354, 0.0009596276823574256),
}
LEFT = (-0.17, 0.026, 0.0004, -0.0003, 0.0011)
RIGHT = (-0.168, 0.024, -0.0002, 0.0005, 0.0013)
RATIONAL = (0.01, 0.002, 0.0003)
PRISM = (*RATIONAL, 0.001, -0.0002, 0.0005, 0.0001)
FISHEYE = (0.02, -0.003, 0.001, -0.0002)


def check_truth(
    rig: StereoCalibration, left: tuple, right: tuple, tolerance: float = 1e-15
) -> None:
    """The one rig behind all files of `surprises/calibrations-*`, to the last digit that its format
    keeps."""
    assert rig.image_size == SIZE
    for eye, lens, focal, centre in zip(
        (rig.left, rig.right), (left, right), TRUTH["focal"], TRUTH["centre"], strict=True
    ):
        np.testing.assert_allclose(eye.focal_px, focal, rtol=tolerance)
        np.testing.assert_allclose(eye.principal_point_px, centre, rtol=tolerance)
        np.testing.assert_allclose(eye.distortion, lens, rtol=10 * tolerance, atol=tolerance)
    np.testing.assert_allclose(
        rotation_vector(rig.R_right_left), TRUTH["turn"], atol=max(tolerance, 1e-12)
    )
    np.testing.assert_allclose(rig.t_right_left, TRUTH["shift"], rtol=tolerance, atol=tolerance)


PEERS = "calibrations-06-peers"
FILES = {
    "calibrations-01-distortion-dropped/left_distortion_coefficients.yml": (LEFT, RIGHT, 1e-15),
    "calibrations-01-distortion-dropped/distortion_coefficients1.yml": (LEFT, RIGHT, 1e-15),
    "calibrations-03-opencv-fisheye/fisheye_model.yml": (FISHEYE, FISHEYE, 1e-15),
    "calibrations-04-opencv-base64-gz/v_b64.yml": (LEFT, RIGHT, 1e-15),
    "calibrations-04-opencv-base64-gz/v_b64.json": (LEFT, RIGHT, 1e-15),
    "calibrations-04-opencv-base64-gz/v_b64.xml": (LEFT, RIGHT, 1e-15),
    "calibrations-04-opencv-base64-gz/calib.yml.gz": (LEFT, RIGHT, 1e-15),
    "calibrations-05-opencv-12-14/v_d12.yml": (LEFT + PRISM, RIGHT + PRISM, 1e-15),
    "calibrations-05-opencv-12-14/v_d14.yml": (
        LEFT + PRISM + (0.001, 0.002),
        RIGHT + PRISM + (0.001, 0.002),
        1e-15,
    ),
    f"{PEERS}/simplestereo.json": (LEFT, RIGHT, 1e-15),
    f"{PEERS}/calibrating.yaml": (LEFT, RIGHT, 1e-15),
    f"{PEERS}/aniposelib.toml": (LEFT, RIGHT, 1e-15),
    f"{PEERS}/camera_array.toml": (LEFT, RIGHT, 1e-15),
    f"{PEERS}/stereo_TransformationMatrix.json": (LEFT, RIGHT, 1e-15),
    f"{PEERS}/camera_1_parameters.json": (LEFT, RIGHT, 1e-15),
    f"{PEERS}/camera_2_parameters.json": (LEFT, RIGHT, 1e-15),
    f"{PEERS}/stereo.h5": (LEFT, RIGHT, 1e-15),
    f"{PEERS}/mrcal_left_opencv8.cameramodel": (LEFT + RATIONAL, RIGHT + RATIONAL, 1e-9),
    f"{PEERS}/mrcal_right_opencv8.cameramodel": (LEFT + RATIONAL, RIGHT + RATIONAL, 1e-9),
    f"{PEERS}/colmap/cameras.txt": (LEFT[:4], RIGHT[:4], 1e-14),
    f"{PEERS}/colmap/rigs.txt": (LEFT[:4], RIGHT[:4], 1e-14),
    f"{PEERS}/depthai_calib.json": (LEFT, RIGHT, 1e-7),
}


@pytest.mark.parametrize("file", FILES)
def test_a_known_rig_comes_out_of_each_tool_s_file(
    file: str, shared_data: Path, tmp_path: Path
) -> None:
    left, right, tolerance = FILES[file]
    rig = load(shared_data / "surprises" / file)
    check_truth(rig, left, right, tolerance)
    assert rig.left.projection == ("equidistant" if "03" in file else "pinhole")
    save(rig, tmp_path / "native.yaml")
    assert same(rig, load(tmp_path / "native.yaml"))
    assert make_rectifier(rig).rig.baseline_m == pytest.approx(0.12, rel=1e-6)


@pytest.mark.parametrize(
    "file", ["camchain-183deg.yaml", "camchain-175deg.yaml", "camchain-848x800.yaml"]
)
def test_calibrations_02_fisheye_no_view(file: str, shared_data: Path) -> None:
    calibration = load(shared_data / "surprises/calibrations-02-fisheye-no-view" / file)
    rig = make_rectifier(calibration).rig
    assert abs(rig.cx - rig.width / 2) < 1
    assert abs(rig.cy - rig.height / 2) < 1
    assert rig.fx > calibration.left.focal_px[0] / 2
    assert rig.baseline_m == pytest.approx(0.12, rel=1e-6)


def test_a_fisheye_plane_shows_what_the_lens_sees(shared_data: Path) -> None:
    calibration = load(
        shared_data / "surprises/calibrations-02-fisheye-no-view/camchain-183deg.yaml"
    )
    rectifier = make_rectifier(calibration)
    assert rectifier.left is not None
    x, y = (plane[rectifier.rig.height // 2, rectifier.rig.width // 2] for plane in rectifier.left)
    assert np.hypot(x - 640, y - 360) < 5, "the middle of the plane is the middle of the lens"
    edge = rectifier.left[0][rectifier.rig.height // 2, 0]
    assert edge == pytest.approx(640 - 400 * np.radians(60), abs=8), "60° to the left: r = f·θ"


KINDS = {
    "01-zed-fisheye-yml/zed_calibration_10000001.yml": (
        {"unit_m": 0.001}, "equidistant", (-0.021, 0.004, -0.0031, 0.0006),
        (-0.1201, 0.00012, -0.00031),
    ),
    "01-zed-fisheye-yml/zed_calibration_10000002.yml": (
        {"unit_m": 0.001}, "pinhole", (-0.172, 0.027, 0.0004, -0.0002, 0.001),
        (-0.1201, 0.00012, -0.00031),
    ),
    "01-zed-fisheye-yml/names.yml": (
        {"image_size": SIZE}, "pinhole", (-0.172, 0.027, 0.0004, -0.0002, 0.001),
        (-0.1201, 0.00012, -0.00031),
    ),
    "01-zed-fisheye-yml/one_eye.yml": (
        {"image_size": SIZE}, "pinhole", (-0.172, 0.027, 0.0004, -0.0002, 0.001),
        (-0.1201, 0.00012, -0.00031),
    ),
    "01-zed-fisheye-yml/raw_fish_right_names.yml": (
        {"unit_m": 0.001, "projection": "equidistant"}, "equidistant",
        (-0.02, 0.004, -0.003, 0.0006), (-0.12, 0, 0),
    ),
    "02-zed-conf-fisheye/SN30000001.conf": (
        {"image_size": (1920, 1200)}, "equidistant", (0.0412, -0.0117, 0.0031, -0.0008),
        (-0.11983, 0.00011, -0.00022),
    ),
    "02-zed-conf-fisheye/SN30000003.conf": (
        {"image_size": (1920, 1200)}, "pinhole",
        (-0.172, 0.027, 0.0004, -0.0002, 0.001, 0.11, 0.02, 0.001, 0.0021, -0.0004, 0.0013, 0.0001),
        (-0.11983, 0.00011, -0.00022),
    ),
    "03-camera-info-echo/nodash/left.yaml": ({}, "pinhole", (), (-0.12, 0, 0)),
    "03-camera-info-echo/ros2once/left.yaml": ({}, "pinhole", (), (-0.12, 0, 0)),
    "03-camera-info-echo/ros2two/left.yaml": ({}, "pinhole", (), (-0.12, 0, 0)),
    "04-camera-info-d-lengths/brown/left.yaml": ({}, "pinhole", (), (-60 / 799.1, 0, 0)),
    "04-camera-info-d-lengths/empty/left.yaml": ({}, "pinhole", (), (-60 / 799.1, 0, 0)),
    "04-camera-info-d-lengths/pinhole/left.yaml": ({}, "pinhole", (), (-60 / 799.1, 0, 0)),
    "04-camera-info-d-lengths/fisheye/left.yaml": (
        {}, "equidistant", (0.02, -0.01, 0.003, 0.0004), (-60 / 799.1, 0, 0),
    ),
    "04-camera-info-d-lengths/plumb4/left.yaml": ({}, "pinhole", (-0.17, 0.03, 0.0001, 0.0002),
        (-60 / 799.1, 0, 0)),
    "04-camera-info-d-lengths/plumb8/left.yaml": (
        {}, "pinhole", (-0.0306, 0.0352, -0.00014, -0.00015, -0.012), (-60 / 799.1, 0, 0),
    ),
    "04-camera-info-d-lengths/rational5/left.yaml": ({}, "pinhole", (-0.17, 0.03, 0.0001, 0.0002),
        (-60 / 799.1, 0, 0)),
    "04-camera-info-d-lengths/rational12/left.yaml": (
        {}, "pinhole", (-4.12, 13.9, 0.0006, -0.0003, -12.1, -4.2, 14.2, -12.6, 0.001, -0.0002,
            0.0003),
        (-60 / 799.1, 0, 0),
    ),
    "04-camera-info-d-lengths/rational14zeros/left.yaml": (
        {}, "pinhole", (-4.12, 13.9, 0.0006, -0.0003, -12.1, -4.2, 14.2, -12.6),
        (-60 / 799.1, 0, 0),
    ),
    "04-camera-info-d-lengths/thinprism/left.yaml": ({"images": "rectified"}, "pinhole", (),
        (-60 / 799.1, 0, 0)),
    "05-kitti-left-p/grey/left.yaml": ({}, "pinhole", (), (-387.5744 / 721.5377, 0, 0)),
    "05-kitti-left-p/colour/left.yaml": ({}, "pinhole", (),
        (-(339.5242 + 44.85728) / 721.5377, 0, 0)),
}  # fmt: skip


@pytest.mark.parametrize("file", KINDS)
def test_files_of_public_reports(file: str, shared_data: Path) -> None:
    wishes, projection, lens, shift = KINDS[file]
    rig = load(shared_data / "reports" / file, **wishes)
    assert rig.left.projection == projection
    found = np.array([*rig.left.distortion, *[0.0] * 14])[:14]
    np.testing.assert_allclose(found, np.array([*lens, *[0.0] * 14])[:14], atol=1e-15)
    np.testing.assert_allclose(rig.t_right_left, shift, atol=2e-7)


@pytest.mark.parametrize(
    "file", ["real/kalibr_imucam_chain.yaml", "nohead.yaml", "kalibr.yaml", "anchors.yaml",
    "cam_imu_only.yaml",
             "EuRoC.yaml", "orb3.yaml"]
)  # fmt: skip
def test_06_openvins_chain(file: str, shared_data: Path) -> None:
    rig = load(shared_data / "reports/06-openvins-chain" / file)
    np.testing.assert_allclose(rig.t_right_left, (-0.110074, 0.000399, -0.000854), atol=1e-6)
    np.testing.assert_allclose(
        rotation_vector(rig.R_right_left), (-0.014091, 0.000360, -0.002315), atol=1e-6
    )
    assert rig.left.distortion[0] == -0.28340811


REFUSED = {
    "reports/04-camera-info-d-lengths/thinprism/left.yaml": ({}, "thin_prism_fisheye"),
    "reports/19-tiny-baseline/SN1.conf": ({}, "a baseline of 0.00012 m"),
    "reports/19-tiny-baseline/calib.txt": ({}, "a baseline of 0.00012 m"),
    "reports/19-tiny-baseline/raw/left.yaml": ({}, "a baseline of 0.000120001 m"),
    "reports/19-tiny-baseline/sample/left.yaml": ({}, "a baseline of 0.00012 m"),
    "reports/19-tiny-baseline/zed/left.yaml": ({}, "never calibrated"),
    "reports/01-zed-fisheye-yml/raw_rt_right_names.yml": ({}, "--unit mm (0.12 m)"),
    "reports2/09-calib-other-size/made_at_1920x1080.yml": ({}, "calibrate import --size"),
    "reports2/09-calib-other-size/squares_of_25mm.yml": ({}, "--unit 25mm"),
    "surprises/calibrations-07-mrcal-yaml/left.yaml": ({}, "no pose"),
}


@pytest.mark.parametrize("file", REFUSED)
def test_what_can_t_be_is_refused_in_words_that_help(file: str, shared_data: Path) -> None:
    wishes, words = REFUSED[file]
    with pytest.raises(CalibrationError) as fault:
        load(shared_data / file, **wishes)
    assert words in str(fault.value)
    assert Path(file).name in str(fault.value)


def test_09_calib_other_size(shared_data: Path) -> None:
    folder = shared_data / "reports2/09-calib-other-size"
    with pytest.raises(CalibrationError, match="does not say the image size"):
        load(folder / "made_at_1920x1080.yml", recorded_size=(1280, 720))
    for wrong in ((1280, 720), (640, 360), (2560, 1440)):
        with pytest.raises(CalibrationError, match=r"1920×1080|outside"):
            load(folder / "made_at_1920x1080.yml", image_size=wrong)
    assert (
        load(folder / "made_at_1920x1080.yml", image_size=(1920, 1080)).left.principal_point_px[1]
        == 542.55
    )
    assert load(folder / "squares_of_25mm.yml", unit_m=0.025).t_right_left[0] == pytest.approx(
        -0.12
    )


@pytest.mark.parametrize(
    "name", ["xi", "D_LEFT_EXTRA", "lens_k4", "fisheye_coeffs", "radial1", "k7", "distortion_b"]
)
def test_a_lens_entry_that_is_not_understood_is_never_dropped(name: str, tmp_path: Path) -> None:
    path = write_opencv(
        example_rig(), tmp_path / "camera.yml", changes={name: np.array([[0.1, 0.2, 0.3]])}
    )
    with pytest.raises(CalibrationError, match=name):
        load(path)


CORPUS = Path(__file__).parent / "fuzz" / "corpus"
LENS_KEYS = (
    "lens_k4",
    "distortion_extra",
    "D_LEFT_FE2",
    "radial_coefficients",
    "kannala",
    "s5",
    "xi",
)
LINES = {
    "native": ("raw.yaml", "left:\n", "left:\n  {key}: {value}\n"),
    "zed": ("SN1.conf", "[LEFT_CAM_HD]\n", "[LEFT_CAM_HD]\n{key}=0.25\n"),
    "opencv": ("camera.json", "{", '{"{key}": {value},'),
    "ros": ("left.yaml", "distortion_model:", "{key}: {value}\ndistortion_model:"),
    "kalibr": ("camchain.yaml", "cam0:\n", "cam0:\n  {key}: {value}\n"),
    "middlebury": ("calib.txt", "cam0=", "{key}={value}\ncam0="),
    "orbslam": ("EuRoC.yaml", "LEFT.height", "LEFT.{key}: {value}\nLEFT.height"),
    "simplestereo": ("simplestereo.json", "{", '{"{key}": {value},'),
    "depthai": ("depthai_calib.json", '"cameraType"', '"{key}": {value}, "cameraType"'),
    "calibrating": ("calibrating.yaml", "cam1:\n", "cam1:\n  {key}: {value}\n"),
    "camera_array": ("camera_array.toml", "[cameras.1]\n", "[cameras.1]\n{key} = {value}\n"),
    "mrcal": ("left.cameramodel", "{", "{ '{key}': {value},"),
    "pycamcalib": ("camera_1_parameters.json", "{", '{"{key}": {value},'),
    "euroc": ("cam0_sensor.yaml", "camera_model:", "{key}: {value}\ncamera_model:"),
    "basalt": ("basalt.json", '"fx"', '"{key}": {value}, "fx"'),
    "kitti": ("calib_cam_to_cam.txt", "K_00:", "{key}: {value}\nK_00:"),
    "matlab": ("stereoParams.json", '"WorldUnits"', '"{key}": {value}, "WorldUnits"'),
    "stella": ("stella.yaml", "  K_left:", "  {key}: {value}\n  K_left:"),
    "named": ("stereo.json", '"fx"', '"{key}": {value}, "fx"'),
}
"""Of each reader a file, and where an entry is put in."""


@pytest.mark.parametrize("reader", LINES)
@pytest.mark.parametrize("key", LENS_KEYS)
def test_no_reader_drops_one_unknown_lens_entry(
    reader: str, key: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A file with one more entry that looks like distortion: an error or a line that names it, or
    another rig."""
    name, old, new = LINES[reader]
    for file in (CORPUS.parent / "beside").iterdir():
        shutil.copyfile(file, tmp_path / file.name)
    shutil.copyfile(CORPUS.parent / "right.yaml", tmp_path / "right.yaml")
    text = (CORPUS / reader / name).read_text()
    assert old in text
    (tmp_path / name).write_text(text)
    plain = load(tmp_path / name)
    (tmp_path / name).write_text(
        text.replace(old, new.replace("{key}", key).replace("{value}", "[0.1, -0.2, 0.3, 0.4]"), 1)
    )
    caplog.clear()
    try:
        with caplog.at_level(logging.WARNING, "stereo_ore"):
            read = load(tmp_path / name)
    except CalibrationError as refusal:
        told = str(refusal)
    else:
        told = caplog.text if same(plain, read) else key
    assert key.lower() in told.lower()


def test_every_reader_is_asked() -> None:
    """COLMAP's entries have no names; VINS-Fusion's lenses are in files of their own."""
    assert LINES.keys() | {"colmap", "vins"} == CALIBRATION_FORMATS.keys()


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("0.0005", "0.0005 0.1", r"cameras\.txt: camera 2: .*8 numbers"),
        ("2 OPENCV", "2 THIN_PRISM_FISHEYE", r"THIN_PRISM_FISHEYE' is none of"),
    ],
)
def test_a_camera_of_colmap_has_the_numbers_of_its_model_and_no_more(
    old: str, new: str, words: str, tmp_path: Path
) -> None:
    for folder in (CORPUS.parent / "beside", CORPUS / "colmap"):
        for file in folder.glob("*.txt"):
            shutil.copyfile(file, tmp_path / file.name)
    cameras = tmp_path / "cameras.txt"
    cameras.write_text(cameras.read_text().replace(old, new))
    with pytest.raises(CalibrationError, match=words):
        load(tmp_path / "rigs.txt")


def test_two_sets_of_coefficients_that_differ_are_refused(tmp_path: Path) -> None:
    path = write_opencv(
        example_rig(),
        tmp_path / "camera.yml",
        changes={"distCoeffs1": np.array([[0.1, 0, 0, 0, 0]])},
    )
    with pytest.raises(CalibrationError, match="two D1 that differ"):
        load(path)


def test_damaged_gzip_and_base64_are_refused(tmp_path: Path, shared_data: Path) -> None:
    packed = gzip.compress(write_opencv(example_rig(), tmp_path / "camera.yml").read_bytes())
    (tmp_path / "camera.yml.gz").write_bytes(packed)
    assert same(example_rig(), load(tmp_path / "camera.yml.gz"), 1e-11)
    (tmp_path / "cut.yml.gz").write_bytes(packed[:-20])
    with pytest.raises(CalibrationError, match="gzip"):
        load(tmp_path / "cut.yml.gz")
    (tmp_path / "bomb.yml.gz").write_bytes(gzip.compress(b" " * 50_000_000))
    with pytest.raises(CalibrationError, match="no more are read"):
        load(tmp_path / "bomb.yml.gz")
    text = (shared_data / "surprises/calibrations-04-opencv-base64-gz/v_b64.json").read_text()
    (tmp_path / "bad.json").write_text(text.replace("$base64$MWQg", "$base64$MXog", 1))
    with pytest.raises(CalibrationError, match="base64"):
        load(tmp_path / "bad.json")


def test_an_hdf5_or_zip_file_is_called_by_its_name(tmp_path: Path) -> None:
    (tmp_path / "camera.zip").write_bytes(b"PK\x03\x04" + bytes(100))
    (tmp_path / "camera.h5").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    for name, kind in (("camera.zip", "zip archive"), ("camera.h5", "HDF5")):
        with pytest.raises(CalibrationError, match=kind):
            load(tmp_path / name)


def test_a_baseline_of_a_metre_and_more_needs_the_unit(tmp_path: Path) -> None:
    rig = example_rig()
    path = write_opencv(
        rig, tmp_path / "camera.yml", changes={"T": 10 * rig.t_right_left.reshape(3, 1)}
    )
    with pytest.raises(CalibrationError, match=r"--unit dm \(0.12 m\)"):
        load(path)
    assert load(path, unit_m=1.0).t_right_left[0] == pytest.approx(-1.2)
    assert same(rig, load(path, unit_m=0.1), 1e-11)


def test_21_bag_topics_b_roi(shared_data: Path) -> None:
    """The image is a window of the sensor: what is left of cx, cy is read off the message
    itself."""
    pytest.importorskip("rosbags")
    from stereo_ore.io.recordings import open_source

    source = open_source(shared_data / "reports/21-bag-topics/b_roi")
    assert source.calibration is not None
    height, width = source.read(0).left.shape[:2]
    assert source.calibration.image_size == (width, height) == (640, 480)
    assert source.calibration.left.principal_point_px == pytest.approx((642.3 - 320, 361.7 - 120))
    assert source.calibration.t_right_left[0] == pytest.approx(-0.12)


def window(tmp_path: Path, **changes: object) -> Path:
    """The example as camera_info files with a window and binning."""
    path = write_ros(example_rig(), tmp_path)
    for side in ("left", "right"):
        document = yaml.safe_load((tmp_path / f"{side}.yaml").read_text())
        (tmp_path / f"{side}.yaml").write_text(yaml.safe_dump(document | changes))
    return path


def test_a_window_and_binning_move_the_principal_point(tmp_path: Path) -> None:
    whole = load(window(tmp_path))
    roi = {"x_offset": 100, "y_offset": 60, "width": 1000, "height": 560}
    part = load(window(tmp_path, roi=roi))
    assert part.image_size == (1000, 560)
    assert part.left.principal_point_px == pytest.approx(
        np.subtract(whole.left.principal_point_px, (100, 60))
    )
    assert part.left.focal_px == whole.left.focal_px
    binned = load(window(tmp_path, roi=roi, binning_x=2, binning_y=2))
    assert binned.image_size == (500, 280)
    assert binned.left.principal_point_px == pytest.approx(
        np.divide(part.left.principal_point_px, 2)
    )
    assert binned.left.focal_px == pytest.approx(np.divide(whole.left.focal_px, 2))
    np.testing.assert_allclose(binned.t_right_left, whole.t_right_left, atol=1e-12)
    ambiguous = {"x_offset": 100, "y_offset": 60, "width": 1280, "height": 720}
    with pytest.raises(CalibrationError, match=r"either .* or K is that of the window"):
        load(window(tmp_path, roi=ambiguous))


def test_a_file_of_blank_lines_takes_no_longer_than_it_is_long(tmp_path: Path) -> None:
    (tmp_path / "blank.yml").write_text("%YAML:1.0\nopencv: 1\n" + "\n" * 500_000)
    start = time.process_time()
    with pytest.raises(CalibrationError):
        load(tmp_path / "blank.yml")
    assert time.process_time() - start < 20


def test_an_entry_whose_name_is_a_number_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    tell_unread(tmp_path / "camchain.yaml", {0: 3, "note": 0})
    assert "entries not understood: 0" in caplog.text
