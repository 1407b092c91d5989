"""Eyes that are swapped, covered, turned or of different moments never give a target."""

import subprocess
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereo_ore.chain import Chain
from stereo_ore.config import Config
from stereo_ore.io import recordings
from stereo_ore.io.calibration import load
from stereo_ore.io.parameters import load_config
from stereo_ore.io.site import load_site
from stereo_ore.lab.bench import stereo_sets
from stereo_ore.stages import matching, rectify
from stereo_ore.stages.health import eye_doubts
from stereo_ore.types import U8, RectifiedPair, Rig, StereoPair

DATA = Path(__file__).parents[1] / "data"
SCENE = DATA / "large_02"


def eye(scene: Path, name: str) -> U8:
    return np.asarray(cv2.imread(str(scene / f"{name}.png")), np.uint8)


@pytest.fixture(scope="module")
def chain() -> Chain:
    return Chain(
        load(SCENE / "calibration.yaml"), load_site(SCENE / "site.yaml"), load_config(None, [])
    )


@pytest.fixture(scope="module")
def left() -> U8:
    return eye(SCENE, "left")


@pytest.fixture(scope="module")
def right() -> U8:
    return eye(SCENE, "right")


def test_the_pair_as_recorded_gives_targets(chain: Chain, left: U8, right: U8) -> None:
    result = chain(StereoPair(left, right, name="0", index=0))
    assert result.status == "ok"
    assert result.targets


@pytest.mark.parametrize(
    "fault", ["swapped", "upside down", "mirrored", "other moment", "rows apart", "same eye"]
)
def test_eyes_that_disagree_are_degraded(fault: str, chain: Chain, left: U8, right: U8) -> None:
    eyes = {
        "swapped": (right, left),
        "upside down": (left[::-1, ::-1], right[::-1, ::-1]),
        "mirrored": (left, right[:, ::-1]),
        "other moment": (left, eye(DATA / "paper_03", "right")),
        "rows apart": (left, np.roll(right, 8, axis=0)),
        "same eye": (left, left),
    }
    result = chain(StereoPair(*map(np.ascontiguousarray, eyes[fault]), name="0", index=0))
    assert result.status == "degraded"
    # Rows apart are matched along structures that run across them, and are told by what they are.
    told = "ROWS_DISAGREE" if fault == "rows apart" else "EYES_DISAGREE"
    assert told in [reason.code for reason in result.reasons]
    assert result.targets == ()
    assert result.counts["targets"] == 0


@pytest.mark.parametrize("covered", ["left", "right"])
def test_a_covered_eye_fails(covered: str, chain: Chain, left: U8, right: U8) -> None:
    eyes = {"left": left, "right": right, covered: np.zeros_like(left)}
    result = chain(StereoPair(eyes["left"], eyes["right"], name="0", index=0))
    assert result.status == "failed"
    assert result.targets == ()
    codes = [reason.code for reason in result.reasons]
    assert codes[-1] == "NO_POINTS"
    assert "TOO_DARK" in codes


def turned(image: U8, focal_px: float, angles: tuple[float, float, float]) -> U8:
    """What an eye would see if it were turned by small angles [rad] about its axes."""
    height, width = image.shape[:2]
    K = np.array([[focal_px, 0, width / 2], [0, focal_px, height / 2], [0, 0, 1]])
    H = K @ np.asarray(cv2.Rodrigues(np.array(angles))[0]) @ np.linalg.inv(K)
    return np.asarray(
        cv2.warpPerspective(image, H, (width, height), flags=cv2.INTER_CUBIC, borderMode=1),
        np.uint8,
    )


@pytest.mark.parametrize("angles_mrad", [(0.5, 0, 0), (-0.5, 0, 0), (0, 0, 1.5), (0, 0, -1.5)])
def test_a_calibration_that_is_off_by_little_is_told(
    angles_mrad: tuple[float, float, float], chain: Chain, left: U8, right: U8
) -> None:
    """About a quarter of a pixel: the matcher follows it, and the screen stays where it is."""
    wrong = turned(right, chain.rig.fx, tuple(a / 1000 for a in angles_mrad))
    result = chain(StereoPair(left, wrong, name="0", index=0))
    assert "ROWS_DISAGREE" in [reason.code for reason in result.reasons]
    assert result.targets == ()


@pytest.mark.parametrize("rows", [-9, -4, 2, 6])
def test_rows_far_apart_are_told(rows: int, chain: Chain, left: U8, right: U8) -> None:
    """Bars along the columns match under any shift of rows."""
    result = chain(StereoPair(left, np.roll(right, rows, axis=0), name="0", index=0))
    assert "ROWS_DISAGREE" in [reason.code for reason in result.reasons]
    assert result.targets == ()


def photograph(shared: Path, name: str) -> RectifiedPair:
    """A real rectified pair; its focal length as its makers say."""
    if name == "zed":
        files = [shared / "zed_pair" / f"{side}.png" for side in ("left", "right")]
    elif (shared / "oakd" / f"{name}_left.png").exists():
        files = [shared / "oakd" / f"{name}_{side}.png" for side in ("left", "right")]
    else:
        folder = shared / "stereo_gt" / "middlebury_v3_quarter" / name
        return stereo_sets.middlebury(folder).pair
    eyes = [np.asarray(cv2.imread(str(file)), np.uint8) for file in files]
    height, width = eyes[0].shape[:2]
    focal = 1068.0 if name == "zed" else 451.03
    return RectifiedPair(*eyes, Rig(width, height, focal, focal, width / 2, height / 2, 0.1))


def doubts(pair: RectifiedPair, acting: bool = False) -> list[str]:
    config = Config()
    region = matching.find_region(pair.rig, None, config.matching)
    region = matching.narrow(pair, region, None, config.matching)
    disparity = matching.match(pair, region, config.matching)
    return [r.code for r in eye_doubts(pair, disparity, config.health, acting=acting)]


OAKD = ("corridor", "cycles", "desk", "donkey_toy", "stairs", "toy")


@pytest.mark.parametrize("name", [*OAKD, "zed", "Adirondack", "Motorcycle", "Recycle", "Teddy"])
def test_photographs_raise_no_alarm_where_no_target_can_follow(
    name: str, shared_data: Path
) -> None:
    assert doubts(photograph(shared_data, name)) == []


def test_rows_that_differ_as_on_a_camera_sold_are_told_where_a_target_can_follow(
    shared_data: Path,
) -> None:
    assert doubts(photograph(shared_data, "cycles"), acting=True) == ["ROWS_DISAGREE"]


@pytest.mark.parametrize("name", ["cycles", "zed", "Teddy"])
@pytest.mark.parametrize("fault", ["rows", "moment"])
def test_faults_planted_in_photographs_are_told_all_the_same(
    name: str, fault: str, shared_data: Path
) -> None:
    pair = photograph(shared_data, name)
    right = np.roll(pair.right, 2, axis=0) if fault == "rows" else pair.right[:, ::-1]
    told = "ROWS_DISAGREE" if fault == "rows" else "EYES_DISAGREE"
    assert told in doubts(replace(pair, right=np.ascontiguousarray(right)))


def test_boards_are_no_rows_apart(shared_data: Path, tmp_path: Path) -> None:
    """A chessboard looks alike in many rows, and fills the view nearer than the range reaches."""
    boards, file = shared_data / "boards" / "opencv", tmp_path / "camera.yaml"
    words = ["stereo-ore", "calibrate", "stereo", boards, "--board", "9x6", "--square-mm", "25"]
    subprocess.run([*words, "--out", file], capture_output=True, check=True)
    source, rectifier = recordings.open_source(boards), rectify.make_rectifier(load(file))
    for index in range(13):
        told = doubts(rectify.rectify(source.read(index), rectifier))
        assert set(told) <= {"FEW_DISPARITIES"}, index
