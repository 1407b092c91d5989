"""`calibrate check`: right calibrations pass, every known misreading is caught."""

import re
import subprocess
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from rigs import example_rig, rectified_rig, rectified_to_raw, with_rotation

from stereo_ore.calibrate.check import (
    CheckResult,
    KnownPoint,
    Matches,
    Measured,
    check_matches,
    check_pair,
    offset_findings,
    patch_disparity,
)
from stereo_ore.calibrate.check_report import check_report, draw_check
from stereo_ore.calibrate.points import rectify_points, triangulate
from stereo_ore.calibrate.residual import (
    RowResidual,
    match_features,
    residual_of_matches,
    vertical_residual,
)
from stereo_ore.errors import CalibrationError
from stereo_ore.io.calibration import save
from stereo_ore.io.calibration.geometry import make_calibration, rotation_vector
from stereo_ore.stages.rectify import make_rectifier, rectify
from stereo_ore.types import CameraModel, StereoCalibration, StereoPair

TRUTH = example_rig()
TURN = rotation_vector(TRUTH.R_right_left)
UNTURNED = np.zeros(3)

MISREADINGS: dict[str, StereoCalibration] = {
    "rotation ignored": with_rotation(TRUTH, UNTURNED),
    "rotation transposed": with_rotation(TRUTH, -TURN),
    "CV = 0": with_rotation(TRUTH, TURN * (1, 0, 1)),
    "RX = 0": with_rotation(TRUTH, TURN * (0, 1, 1)),
    "RZ = 0": with_rotation(TRUTH, TURN * (1, 1, 0)),
    "CV and RX exchanged": with_rotation(TRUTH, TURN[[1, 0, 2]] * (1, 0.5, 1)),
    "cameras exchanged": replace(TRUTH, left=TRUTH.right, right=TRUTH.left),
}


def points(count: int = 600) -> np.ndarray:
    """Points that fill the left image, 1.5 to 5 m away."""
    rng, rig = np.random.default_rng(3), make_rectifier(TRUTH).rig
    return rig.back_project(
        *rng.uniform((20, 20), (1260, 700), (count, 2)).T, rng.uniform(1.5, 5.0, count)
    )


def matches(noise_px: float = 0.3, wrong: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    """Recorded pixels of both eyes, some of them matched wrongly."""
    rng = np.random.default_rng(4)
    left, right = (
        px + rng.normal(0, noise_px, px.shape) for px in rectified_to_raw(TRUTH, points())
    )
    bad = rng.random(len(left)) < wrong
    right[bad] = rng.uniform((0, 0), (1280, 720), (int(bad.sum()), 2))
    return left, right


def judged(calibration: StereoCalibration) -> RowResidual:
    return residual_of_matches(
        *rectify_points(calibration, *matches()), make_rectifier(calibration).rig
    )


def test_the_right_calibration_leaves_no_row_difference() -> None:
    residual = judged(TRUTH)
    assert residual.aligned
    assert residual.systematic_px < 0.1
    assert residual.noise_px == pytest.approx(0.3 * np.sqrt(2), rel=0.25)
    assert residual.used > 0.8 * residual.matched
    assert (np.abs(residual.rotation_rad) < 5 * residual.rotation_sigma_rad + 1e-5).all()


@pytest.mark.parametrize("name", MISREADINGS)
def test_a_misreading_shows_in_simulated_features(name: str) -> None:
    residual = judged(MISREADINGS[name])
    turned = abs(residual.rotation_rad[1]) > 10 * residual.rotation_sigma_rad[1]
    assert not residual.aligned or turned


def test_the_implied_turn_is_the_turn_that_was_left_out() -> None:
    residual = judged(MISREADINGS["CV = 0"])
    assert residual.rotation_rad[1] == pytest.approx(
        TURN[1], abs=5 * residual.rotation_sigma_rad[1]
    )
    assert residual.rotation_sigma_rad[1] < 3e-4


def test_triangulation_inverts_projection() -> None:
    left, right = rectified_to_raw(TRUTH, points())
    assert np.abs(triangulate(TRUTH, left, right) - points()).max() < 1e-6


@pytest.mark.parametrize("count", [0, 1, 20])
def test_few_matches_give_no_verdict(count: int) -> None:
    left, right = (px[:count] for px in matches())
    residual = residual_of_matches(left, right, make_rectifier(rectified_rig()).rig)
    assert (residual.enough, residual.aligned) == (False, False)


def test_equal_rows_and_one_place_are_no_crash() -> None:
    same = np.tile([[600.0, 300.0]], (100, 1))
    residual = residual_of_matches(same, same - (20, 0), make_rectifier(rectified_rig()).rig)
    assert residual.systematic_px == pytest.approx(0, abs=1e-6)


@pytest.fixture(scope="module")
def raw_scene(shared_data: Path) -> tuple[StereoPair, StereoCalibration]:
    """A path-traced pair of distorted, misaligned eyes and its true calibration."""
    folder = shared_data / "scenes_dev/raw_01_large"
    truth = yaml.safe_load((folder / "calib.json").read_text())

    def eye(side: str) -> CameraModel:
        K = truth[side]["K"]
        return CameraModel((K[0][0], K[1][1]), (K[0][2], K[1][2]), tuple(truth[side]["dist"]))

    calibration = make_calibration(
        folder,
        image_size=(truth["width"], truth["height"]),
        left=eye("left"),
        right=eye("right"),
        rotation=np.array(truth["R_right_left"]),
        translation_m=np.array(truth["t_right_left_mm"]) / 1000,
        images="raw",
    )
    left, right = (cv2.imread(str(folder / f"{side}.png")) for side in ("left", "right"))
    return StereoPair(left, right, name="raw", index=0), calibration


@pytest.fixture(scope="module")
def raw_matches(raw_scene: tuple[StereoPair, StereoCalibration]) -> Matches:
    return matches_of(raw_scene[0])


def matches_of(pair: StereoPair) -> Matches:
    left, right = (cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in (pair.left, pair.right))
    return match_features(left, right)


def codes_of(result: CheckResult) -> set[str]:
    return {finding.code for finding in result.findings}


PLANTED = {
    "nothing": ((1, 1, 1), set()),
    "rotation ignored": ((0, 0, 0), {"ROWS", "CONVERGENCE"}),
    "rotation transposed": ((-1, -1, -1), {"ROWS", "CONVERGENCE", "INVERTED_ROTATION"}),
    "CV = 0": ((1, 0, 1), {"ROWS", "CONVERGENCE"}),
    "CV half": ((1, 0.5, 1), {"CONVERGENCE"}),
}


@pytest.mark.parametrize("name", PLANTED)
def test_a_misreading_shows_in_real_size_images(name: str, raw_matches: Matches, raw_scene) -> None:
    factor, codes = PLANTED[name]
    truth = raw_scene[1]
    result = check_matches(
        raw_matches, with_rotation(truth, rotation_vector(truth.R_right_left) * factor)
    )
    assert codes <= codes_of(result)
    assert result.verdict == ("wrong" if codes else "good")


def test_swapped_raw_eyes_are_named(raw_matches: Matches, raw_scene) -> None:
    result = check_matches(raw_matches[::-1], raw_scene[1])
    assert {"ROWS", "SWAPPED_EYES"} <= codes_of(result)


def test_missing_rectification_is_named(raw_matches: Matches, raw_scene) -> None:
    truth = raw_scene[1]
    eye, shift = replace(truth.left, distortion=()), np.array([truth.t_right_left[0], 0, 0])
    claimed = replace(
        truth, left=eye, right=eye, R_right_left=np.eye(3), t_right_left=shift, images="rectified"
    )
    result = check_matches(raw_matches, claimed)
    assert {"ROWS", "MISSING_RECTIFICATION"} <= codes_of(result)
    assert result.verdict == "wrong"


def test_double_rectification_is_named(raw_scene) -> None:
    pair, truth = raw_scene
    rectified = rectify(pair, make_rectifier(truth))
    result = check_pair(replace(pair, left=rectified.left, right=rectified.right), truth)
    assert {"ROWS", "DOUBLE_RECTIFICATION"} <= codes_of(result)


def test_swapped_rectified_eyes_lie_behind_the_camera(flat_plane_pair) -> None:
    pair = flat_plane_pair.pair
    eye = CameraModel((pair.rig.fx, pair.rig.fy), (pair.rig.cx, pair.rig.cy))
    size, shift = (pair.rig.width, pair.rig.height), (-pair.rig.baseline_m, 0, 0)
    rig = make_calibration(
        "x", image_size=size, left=eye, right=eye, translation_m=shift, images="rectified"
    )
    assert check_pair(StereoPair(pair.left, pair.right, name="x", index=0), rig).verdict == "good"
    swapped = check_pair(StereoPair(pair.right, pair.left, name="x", index=0), rig)
    assert [finding.code for finding in swapped.findings if finding.code == "SWAPPED_EYES"]
    with pytest.raises(CalibrationError, match="320"):
        check_pair(StereoPair(pair.left[:-1], pair.right[:-1], name="x", index=0), rig)


@pytest.fixture
def plane_rig(flat_plane_pair) -> tuple[StereoPair, StereoCalibration, list[KnownPoint]]:
    """The plane's pair, its calibration and three points with their true straight distances."""
    pair = flat_plane_pair.pair
    eye = CameraModel((pair.rig.fx, pair.rig.fy), (pair.rig.cx, pair.rig.cy))
    size, shift = (pair.rig.width, pair.rig.height), (-pair.rig.baseline_m, 0, 0)
    rig = make_calibration(
        "x", image_size=size, left=eye, right=eye, translation_m=shift, images="rectified"
    )
    known = []
    for u, v in ((60, 30), (240, 160), (440, 290)):
        at = pair.rig.back_project(u, v, flat_plane_pair.depth[v, u])
        known.append(KnownPoint(u, v, float(np.linalg.norm(at))))
    return StereoPair(pair.left, pair.right, name="x", index=0), rig, known


def test_known_distances_confirm_a_right_calibration(plane_rig) -> None:
    pair, rig, known = plane_rig
    result = check_pair(pair, rig, known)
    assert result.verdict == "good"
    assert [point.distance_m for point in result.measured] == pytest.approx(
        [k.distance_m for k in known], rel=0.01
    )


@pytest.mark.parametrize("shift", [-3, 2, 16])
@pytest.mark.parametrize("count", [1, 3])
def test_a_constant_offset_is_found_and_mended(plane_rig, shift: int, count: int) -> None:
    pair, rig, known = plane_rig
    moved = replace(pair, right=np.roll(pair.right, -shift, axis=1))
    result = check_pair(moved, rig, known[:count])
    assert result.verdict == "wrong"
    assert [finding.code for finding in result.findings if finding.severity == "wrong"] == [
        "DISPARITY_OFFSET"
    ]
    assert result.measured[0].offset_px == pytest.approx(-shift, abs=0.3)
    mended = replace(rig, disparity_offset_px=-float(shift))
    assert check_pair(moved, mended, known[:count]).verdict != "wrong"


def test_an_offset_that_turns_all_disparities_negative_is_no_swap_of_the_eyes(plane_rig) -> None:
    pair, rig, known = plane_rig
    right = np.full_like(pair.right, 128)
    right[:, 80:] = pair.right[:, :-80]
    moved = replace(pair, right=right)
    result = check_pair(moved, replace(rig, disparity_offset_px=80.0), known[:1])
    plain = check_pair(pair, rig, known)
    assert (result.verdict, result.findings) == ("good", ())
    assert result.residual.disparity_px == pytest.approx(plain.residual.disparity_px, abs=2)


def test_one_picture_for_both_eyes_is_no_good_calibration(plane_rig) -> None:
    pair, rig, _ = plane_rig
    result = check_pair(replace(pair, right=pair.left), rig)
    assert [(finding.code, finding.severity) for finding in result.findings] == [
        ("NO_DEPTH", "wrong")
    ]


@pytest.mark.parametrize("eyes", ["flat", "noise", "one picture", "one corner", "swapped"])
def test_what_is_not_known_is_not_printed_as_nan(eyes: str, plane_rig) -> None:
    pair, rig, known = plane_rig
    flat, rng = np.full_like(pair.left, 128), np.random.default_rng(0)
    corner = [
        np.where(np.indices(flat.shape)[0] < 40, eye, flat) for eye in (pair.left, pair.right)
    ]
    left, right = {
        "flat": (flat, flat),
        "noise": [rng.integers(0, 255, flat.shape, np.uint8) for _ in range(2)],
        "one picture": (pair.left, pair.left),
        "one corner": corner,
        "swapped": (pair.right, pair.left),
    }[eyes]
    measured = known if eyes == "one picture" else ()
    text = check_report(check_pair(replace(pair, left=left, right=right), rig, measured))
    assert not re.search(r"\b(nan|inf)\b", text), text


@pytest.mark.parametrize(
    ("scale", "constant", "code"),
    [
        (1.0, 0.1, None),
        (1.0, 3.0, "DISPARITY_OFFSET"),
        (0.83, 0.0, "DISPARITY_SCALE"),
        (1.1, -9.0, "DISPARITY_SCALE"),
    ],
)
def test_a_wrong_baseline_is_told_from_an_offset(
    scale: float, constant: float, code: str | None
) -> None:
    measured = [
        Measured(
            KnownPoint(0, 0, 64 / expected), scale * expected + constant, expected, float("nan")
        )
        for expected in (16.0, 32.0, 64.0)
    ]
    assert [finding.code for finding in offset_findings(measured)] == ([code] if code else [])


def test_a_point_without_texture_or_on_a_pattern_is_refused() -> None:
    grey = np.full((200, 300), 128, np.uint8)
    assert patch_disparity(grey, grey, np.array([150.0, 100.0])) is None
    bars = np.tile((np.arange(300) // 10 % 2 * 200).astype(np.uint8), (200, 1))
    assert patch_disparity(bars, bars, np.array([150.0, 100.0])) is None
    assert patch_disparity(bars, bars, np.array([3.0, 3.0])) is None


def test_an_image_without_features_is_unclear() -> None:
    grey = np.full((720, 1280, 3), 90, np.uint8)
    result = check_pair(StereoPair(grey, grey, name="dark", index=0), rectified_rig())
    assert (result.verdict, [finding.code for finding in result.findings]) == (
        "unclear",
        ["FEW_MATCHES"],
    )
    assert "verdict: unclear" in check_report(result)


def test_report_and_picture(plane_rig, tmp_path: Path) -> None:
    pair, rig, known = plane_rig
    result = check_pair(pair, rig, known)
    assert "verdict: good" in check_report(result)
    assert f"known {known[0].distance_m:.3f} m" in check_report(result)
    draw_check(result, pair.left, tmp_path / "check.png")
    assert cv2.imread(str(tmp_path / "check.png")).shape == pair.left.shape


def test_single_pixels_go_where_the_images_go(raw_scene) -> None:
    truth = raw_scene[1]
    maps = make_rectifier(truth).left
    at = np.array([[200, 100], [640, 360], [1100, 650]])
    recorded = np.stack([map_[at[:, 1], at[:, 0]] for map_ in maps], 1)
    assert np.abs(rectify_points(truth, recorded, recorded)[0] - at).max() < 1e-3


def test_single_pixels_of_a_fisheye_go_where_the_images_go() -> None:
    eyes = [
        replace(eye, distortion=(0.02, -0.01, 0.003, -0.001), projection="equidistant")
        for eye in (TRUTH.left, TRUTH.right)
    ]
    fisheye = replace(TRUTH, left=eyes[0], right=eyes[1])
    maps, at = make_rectifier(fisheye).right, np.array([[300, 200], [640, 360], [900, 500]])
    recorded = np.stack([map_[at[:, 1], at[:, 0]] for map_ in maps], 1)
    assert np.abs(rectify_points(fisheye, recorded, recorded)[1] - at).max() < 1e-2


def test_the_residual_is_the_same_for_any_number_of_threads(flat_plane_pair) -> None:
    pair = flat_plane_pair.pair
    grey = [cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in (pair.left, pair.right)]
    before = cv2.getNumThreads()
    found = []
    for threads in (1, 2):
        cv2.setNumThreads(threads)
        found.append(vertical_residual(*grey, pair.rig))
    cv2.setNumThreads(before)
    assert found[0].systematic_px == found[1].systematic_px
    assert np.array_equal(found[0].map_px, found[1].map_px, equal_nan=True)


def test_the_command_ends_with_3_on_a_bad_verdict(plane_rig, tmp_path: Path) -> None:
    pair, rig, known = plane_rig
    save(rig, tmp_path / "camera.yaml")
    scene = tmp_path / "scene"
    scene.mkdir()
    for name, image in (("left", pair.left), ("right", pair.right)):
        cv2.imwrite(str(scene / f"{name}.png"), image)
    line = [
        "stereo-ore",
        "calibrate",
        "check",
        scene,
        "--calib",
        tmp_path / "camera.yaml",
        "--known",
    ]
    ends = {}
    for metres in (known[0].distance_m, known[0].distance_m / 2, -1):
        done = subprocess.run(
            [*line, f"60,30,{metres}"], capture_output=True, text=True, check=False
        )
        ends[done.returncode] = done.stdout + done.stderr
    assert "verdict: good" in ends[0]
    assert "DISPARITY_OFFSET" in ends[3]
    assert "positive" in ends[1]
