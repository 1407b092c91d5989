"""Native calibrations, what every calibration must fulfil, conversion, `calibrate import` and
`show`."""

import shlex
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from rigs import SIZE, example_rig, raw_rigs, rectified_rig, same

from stereo_ore.calibrate.convert import convert_zed
from stereo_ore.calibrate.show import describe_calibration, draw_calibration, field_of_view
from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration import check_image_size, dump, load, save
from stereo_ore.io.calibration.geometry import rotation_matrix, rotation_vector
from stereo_ore.stages.rectify import make_rectifier

CALIB = Path(__file__).parents[1] / "calib"
EXAMPLES = {
    "zed": "zed/SN00000000.conf",
    "opencv": "opencv/intrinsics.yml",
    "opencv, from its other half": "opencv/extrinsics.yml",
    "ros": "ros/left.yaml",
    "ros, from the right eye": "ros/right.yaml",
}
DOCUMENT = yaml.safe_load(dump(example_rig()))


def write(folder: Path, **changes: object) -> Path:
    """A native file; a dotted key goes into a section, None removes a key."""
    document = yaml.safe_load(yaml.safe_dump(DOCUMENT))
    for key, value in changes.items():
        *sections, leaf = key.split("__")
        part = document
        for section in sections:
            part = part[section]
        part[leaf] = value
        if value is None:
            del part[leaf]
    path = folder / "camera.yaml"
    path.write_text(yaml.safe_dump(document))
    return path


def refused(path: Path, **wishes: object) -> str:
    with pytest.raises(CalibrationError) as fault:
        load(path, **wishes)
    assert str(path) in str(fault.value) or path.parent.name in str(fault.value)
    return str(fault.value)


@settings(
    deadline=None, max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(rig=raw_rigs())
def test_written_and_read_again_is_the_same_to_the_last_bit(rig, tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    save(rig, path)
    again = load(path)
    assert same(rig, again)
    assert again.camera == rig.camera
    assert dump(again) == dump(rig)


def test_a_rotation_vector_survives_near_zero() -> None:
    for vector in ([0, 0, 0], [1e-9, 0, 0], [1e-6, -2e-7, 3e-8], [0.3, -0.2, 0.1]):
        assert np.array_equal(rotation_vector(rotation_matrix(np.array(vector, float))), vector)


@pytest.mark.parametrize("name", ["hd2k", "hd1080", "hd720", "vga"])
def test_the_shipped_zed2_modes_load(name: str) -> None:
    calibration = load(CALIB / f"zed2_{name}.yaml")
    assert calibration.images == "rectified"
    assert make_rectifier(calibration).rig.baseline_m == pytest.approx(0.12)


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_shipped_examples_are_one_rig_in_many_formats(name: str) -> None:
    native = load(CALIB / "formats/zed/SN00000000.conf", image_size=SIZE)
    assert same(native, load(CALIB / "formats" / EXAMPLES[name], image_size=SIZE), 1e-9)


def test_the_shipped_kalibr_and_middlebury_examples_are_that_rig_too() -> None:
    native = load(CALIB / "formats/zed/SN00000000.conf", image_size=SIZE)
    four = [replace(eye, distortion=eye.distortion[:4]) for eye in (native.left, native.right)]
    kalibr = load(CALIB / "formats/kalibr/camchain.yaml")
    assert same(replace(native, left=four[0], right=four[1]), kalibr, 1e-9)
    rectified, rig = load(CALIB / "formats/middlebury/calib.txt"), make_rectifier(native).rig
    assert rectified.left.focal_px[0] == pytest.approx(rig.fx, abs=1e-3)
    assert -rectified.t_right_left[0] == pytest.approx(rig.baseline_m, abs=1e-6)


def test_the_ros_projection_is_the_rectified_rig() -> None:
    rig = make_rectifier(load(CALIB / "formats/zed/SN00000000.conf", image_size=SIZE)).rig
    rectified = make_rectifier(load(CALIB / "formats/ros/left.yaml", images="rectified")).rig
    assert (rectified.fx, rectified.cx, rectified.cy) == pytest.approx((rig.fx, rig.cx, rig.cy))
    assert rectified.baseline_m == pytest.approx(rig.baseline_m)


def test_another_image_size_names_both() -> None:
    check_image_size(example_rig(), 1280, 720)
    with pytest.raises(CalibrationError, match=r"1280×720.*1920×1080"):
        check_image_size(example_rig(), 1920, 1080)


BROKEN = {
    "unknown key": ({"focal": 3}, "focal"),
    "nearest key": ({"left__focal_pxx": [1, 1]}, "did you mean focal_px"),
    "missing key": ({"image_size": None}, "image_size"),
    "zero focal length": ({"left__focal_px": [0, 500.0]}, "focal_px"),
    "negative focal length": ({"right__focal_px": [500.0, -500.0]}, "right.focal_px"),
    "text for a number": ({"left__focal_px": ["wide", 500.0]}, "wide"),
    "true for a number": ({"left__focal_px": [True, 500.0]}, "true or false"),
    "not a number": ({"left__principal_point_px": [float("nan"), 300.0]}, "finite"),
    "infinite shift": ({"right_from_left__translation_m": [float("inf"), 0, 0]}, "finite"),
    "three coefficients": ({"left__distortion": [0.1, 0.1, 0.1]}, "not 3"),
    "six coefficients": ({"left__distortion": [0.1] * 6}, "not 6"),
    "wrong sign of the baseline": ({"right_from_left__translation_m": [0.12, 0, 0]}, "swapped"),
    "no baseline": ({"right_from_left__translation_m": [0, 0, 0]}, "zero"),
    "millimetres": ({"right_from_left__translation_m": [-120.0, 0, 0]}, "millimetres"),
    "one eye above the other": ({"right_from_left__translation_m": [0, -0.12, 0]}, "side by side"),
    "degrees": ({"right_from_left__rotation_vector_rad": [0, 2.5, 0]}, "degrees"),
    "principal point of another size": ({"image_size": [640, 360]}, "outside"),
    "raw called rectified": ({"images": "rectified"}, "images: raw"),
    "unknown kind of images": ({"images": "warped"}, "rectified"),
    "size of zero": ({"image_size": [0, 720]}, "image_size"),
    "fraction of a pixel": ({"image_size": [1280.5, 720]}, "image_size"),
    "another version": ({"version": 2}, "version"),
}


@pytest.mark.parametrize("fault", BROKEN)
def test_a_broken_native_file_is_refused_by_name(tmp_path: Path, fault: str) -> None:
    changes, word = BROKEN[fault]
    assert word in refused(write(tmp_path, **changes))


def test_all_faults_are_listed_at_once(tmp_path: Path) -> None:
    path = write(tmp_path, left__focal_px=[-1.0, 500.0], right__distortion=["a"], colour="red")
    message = refused(path)
    assert all(
        word in message for word in ("3 faults", "left.focal_px", "right.distortion", "colour")
    )
    geometry = refused(
        write(tmp_path, image_size=[640, 360], right_from_left__translation_m=[0.12, 0, 0])
    )
    assert all(
        word in geometry for word in ("3 faults", "left.principal", "right.principal", "swapped")
    )


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("", "no known"),
        ("hello", "no known"),
        ("format: stereo_ore/stereo-calibration\n  x: [", "not valid YAML"),
    ],
)
def test_text_that_is_no_calibration_is_refused(tmp_path: Path, text: str, word: str) -> None:
    path = tmp_path / "x.yaml"
    path.write_text(text)
    assert word in refused(path)


def test_a_missing_file_a_folder_and_bytes_are_refused(tmp_path: Path) -> None:
    assert "no such file" in refused(tmp_path / "none.yaml")
    assert "can't be read" in refused(tmp_path)
    (tmp_path / "image.yaml").write_bytes(bytes(range(256)))
    assert "text" in refused(tmp_path / "image.yaml")


@pytest.mark.parametrize(
    ("size", "left"),
    [
        ((2208, 1242), (1401.79, 1158.08, 646.31)),
        ((1920, 1080), (1401.79, 1014.08, 565.31)),
        ((672, 376), (350.4475, 348.27, 193.0775)),
    ],
)
def test_a_zed_is_converted_as_the_factory_does(
    size: tuple[int, int], left: tuple[float, ...], shared_data: Path
) -> None:
    hd720 = load(shared_data / "calib/SN1010.conf", image_size=SIZE)
    there = convert_zed(hd720, size)
    assert (there.left.focal_px[0], *there.left.principal_point_px) == pytest.approx(left)
    assert same(there, load(shared_data / "calib/SN1010.conf", image_size=size), 1e-9)
    assert same(convert_zed(there, SIZE), hd720, 1e-9)


def test_conversion_is_refused_where_no_rule_exists() -> None:
    with pytest.raises(CalibrationError, match="1000×500"):
        convert_zed(example_rig(), (1000, 500))
    with pytest.raises(CalibrationError, match="rectified"):
        convert_zed(rectified_rig(), (2208, 1242))


def test_what_show_prints_follows_from_the_geometry() -> None:
    text = describe_calibration(rectified_rig())
    assert "120.000 mm" in text
    assert f"{530 * 0.12 / 4:.1f} px" in text
    assert f"{1000 * 16 / (530 * 0.12):.1f} mm" in text
    across, _ = field_of_view(make_rectifier(rectified_rig()).rig)
    assert across == pytest.approx(2 * np.arctan(640 / 530), rel=1e-3)


@pytest.mark.parametrize("rig", [example_rig(), rectified_rig()], ids=["raw", "rectified"])
def test_show_draws_a_picture(tmp_path: Path, rig) -> None:
    pytest.importorskip("matplotlib")
    draw_calibration(rig, tmp_path / "camera.png")
    assert (tmp_path / "camera.png").read_bytes().startswith(b"\x89PNG")


def command(*arguments: object) -> subprocess.CompletedProcess[str]:
    line = ["stereo-ore", "calibrate", *map(str, arguments)]
    return subprocess.run(line, capture_output=True, text=True, check=False)


def test_the_command_imports_converts_and_shows(tmp_path: Path) -> None:
    conf, out = CALIB / "formats/zed/SN00000000.conf", tmp_path / "out.yaml"
    done = command(
        "import", conf, "--size", "HD720", "--to", "HD2K", "--name", "ours", "--out", out
    )
    assert (done.returncode, done.stdout.strip(), done.stderr) == (0, str(out), "")
    assert same(load(out), load(conf, image_size=(2208, 1242)), 1e-9)
    assert "camera                 ours" in command("show", out).stdout


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("import", CALIB / "formats/zed/SN00000000.conf", "--out", "x.yaml"), "--size"),
        (
            ("import", CALIB / "formats/zed/SN00000000.conf", "--size", "big", "--out", "x.yaml"),
            "big",
        ),
        (
            ("import", CALIB / "zed2_hd720.yaml", "--out", CALIB / "README.md" / "x.yaml"),
            "can't be written",
        ),
        (("show", "nothing.yaml"), "no such file"),
        (
            ("show", CALIB / "zed2_hd720.yaml", "--picture", CALIB / "README.md" / "x.png"),
            "can't be written",
        ),
    ],
)
def test_a_fault_is_one_line_and_exit_code_1(arguments: tuple[object, ...], word: str) -> None:
    if "--picture" in arguments:
        pytest.importorskip("matplotlib")
    done = command(*arguments)
    assert done.returncode == 1
    assert word in done.stderr
    assert "Traceback" not in done.stderr


def test_the_first_commands_of_the_readme_run(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    shutil.copytree(CALIB, tmp_path / "calib")
    block = (CALIB / "README.md").read_text().partition("```sh\n")[2].partition("```")[0]
    lines = block.strip().splitlines()
    assert [line.split()[2] for line in lines] == ["import", "show"]
    for line in lines:
        subprocess.run(shlex.split(line), cwd=tmp_path, check=True, capture_output=True)
    assert load(tmp_path / "ours.yaml").images == "raw"
    assert (tmp_path / "ours.png").exists()
