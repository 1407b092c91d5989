"""Eyes that are swapped, covered, turned or of different moments never give a target."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from stereo_ore import pipeline
from stereo_ore.calibration import load
from stereo_ore.config import load_config
from stereo_ore.site import load_site
from stereo_ore.types import U8, StereoPair

DATA = Path(__file__).parents[1] / "data"
SCENE = DATA / "large_02"


def eye(scene: Path, name: str) -> U8:
    return np.asarray(cv2.imread(str(scene / f"{name}.png")), np.uint8)


@pytest.fixture(scope="module")
def context() -> pipeline.Context:
    return pipeline.make_context(
        load(SCENE / "calibration.yaml"), load_site(SCENE / "site.yaml"), load_config(None, [])
    )


@pytest.fixture(scope="module")
def left() -> U8:
    return eye(SCENE, "left")


@pytest.fixture(scope="module")
def right() -> U8:
    return eye(SCENE, "right")


def test_the_pair_as_recorded_gives_targets(context: pipeline.Context, left: U8, right: U8) -> None:
    result = pipeline.process(StereoPair("0", 0, left, right), context)
    assert result.status == "ok"
    assert result.targets


@pytest.mark.parametrize("fault", ["swapped", "upside down", "mirrored", "other moment", "rows apart", "same eye"])
def test_eyes_that_disagree_are_degraded(fault: str, context: pipeline.Context, left: U8, right: U8) -> None:
    eyes = {
        "swapped": (right, left),
        "upside down": (left[::-1, ::-1], right[::-1, ::-1]),
        "mirrored": (left, right[:, ::-1]),
        "other moment": (left, eye(DATA / "paper_03", "right")),
        "rows apart": (left, np.roll(right, 8, axis=0)),
        "same eye": (left, left),
    }
    result = pipeline.process(StereoPair("0", 0, *map(np.ascontiguousarray, eyes[fault])), context)
    assert result.status == "degraded"
    assert "EYES_DISAGREE" in [reason.code for reason in result.reasons]
    assert result.targets == ()
    assert result.counts["targets"] == 0


@pytest.mark.parametrize("covered", ["left", "right"])
def test_a_covered_eye_fails(covered: str, context: pipeline.Context, left: U8, right: U8) -> None:
    eyes = {"left": left, "right": right, covered: np.zeros_like(left)}
    result = pipeline.process(StereoPair("0", 0, eyes["left"], eyes["right"]), context)
    assert result.status == "failed"
    assert result.targets == ()
