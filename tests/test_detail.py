"""One eye that shows a lump less sharply than the other."""

import cv2
import numpy as np
import pytest

from stereo_ore.config import HealthConfig
from stereo_ore.stages.health import without_blurred
from stereo_ore.types import (
    Disparity,
    OreMap,
    RectifiedPair,
    Region,
    Rig,
    Strike,
    StrikePlan,
)

WIDTH, HEIGHT, SHIFT = 200, 100, 12
RIG = Rig(WIDTH, HEIGHT, 200.0, 200.0, 100.0, 50.0, 0.12)
STRIKE = Strike(np.zeros(3), np.array([0, 0, 1.0]), 0.0, 0.0, 1.0)
PLANS = [StrikePlan((STRIKE,))] * 2


def codes(left: np.ndarray, right: np.ndarray) -> list[list[str]]:
    labels = np.zeros((HEIGHT, WIDTH), np.int16)
    labels[20:80, 30:90], labels[20:80, 110:170] = 1, 2
    values = np.full((HEIGHT, WIDTH), SHIFT, np.float32)
    disparity = Disparity(values, Region(15, 10, 190, 90, 0, 32), np.ones_like(values))
    pair = RectifiedPair(left, right, RIG)
    plans = without_blurred(PLANS, OreMap(labels), disparity, pair, HealthConfig())
    return [[reason.code for reason in plan.reasons] for plan in plans]


@pytest.fixture
def rock() -> np.ndarray:
    grey = np.random.default_rng(0).normal(128, 60, (HEIGHT, WIDTH))
    grey = cv2.GaussianBlur(grey, (0, 0), 1.0) * 2 - 128
    return np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, 2)


@pytest.mark.parametrize("eye", [0, 1])
def test_a_lump_that_one_eye_blurs_is_no_target(rock: np.ndarray, eye: int) -> None:
    eyes = [rock, np.roll(rock, -SHIFT, 1)]
    assert codes(*eyes) == [[], []]
    smeared = eyes[eye].copy()
    part = smeared[:, 110 - SHIFT * eye : 170 - SHIFT * eye]
    part[:] = cv2.GaussianBlur(part, (0, 0), 3)
    eyes[eye] = smeared
    assert codes(*eyes) == [[], ["ONE_EYE_BLURRED"]]


def test_eyes_of_other_gain_and_noise_show_the_same(rock: np.ndarray) -> None:
    noise = np.random.default_rng(1).normal(0, 6, rock.shape)
    right = np.clip(0.9 * np.roll(rock, -SHIFT, 1) + noise, 0, 255).astype(np.uint8)
    assert codes(rock, right) == [[], []]
