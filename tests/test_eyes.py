"""Eyes that are swapped, covered, turned or of different moments never give a target."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from stereo_ore.chain import Chain
from stereo_ore.io.calibration import load
from stereo_ore.io.parameters import load_config
from stereo_ore.io.site import load_site
from stereo_ore.types import U8, StereoPair

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
