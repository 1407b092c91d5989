"""Matching under unequal light, noise and rows, and what the confidence says."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from test_matching import CONFIG, RIG, pair_of, texture, whole

from stereo_ore.config import MatchingConfig
from stereo_ore.errors import ConfigError
from stereo_ore.lab.bench import stereo_sets
from stereo_ore.lab.metrics import area_under_roc, reliability
from stereo_ore.network import Network
from stereo_ore.stages import matching
from stereo_ore.stages.matching import confidence, light, sgbm
from stereo_ore.stages.matching.match import grey
from stereo_ore.types import RectifiedPair

SMALL = replace(RIG, width=300, height=160)
RAMP = np.tile(np.linspace(15, 35, 300), (160, 1))


def dimmed(pair: RectifiedPair, gain: np.ndarray | float) -> RectifiedPair:
    """The pair with the right eye's brightness multiplied by a gain (w,)."""
    bright = pair.right * np.asarray(gain, float)[..., None]
    return replace(pair, right=np.clip(np.rint(bright), 0, 255).astype(np.uint8))


def error_of(pair: RectifiedPair, truth: np.ndarray, config: MatchingConfig = CONFIG) -> np.ndarray:
    return matching.match(pair, whole(pair.rig), config).values - truth


def test_vignetting_is_not_taken_for_depth() -> None:
    pair = dimmed(pair_of(RAMP, SMALL, noise=1.0), np.linspace(1, 0.7, 300))
    assert np.nanmedian(np.abs(error_of(pair, RAMP))) < 0.06


@pytest.mark.parametrize("rows", [-0.4, 0.4])
def test_a_residue_of_rectification_is_not_taken_for_depth(rows: float) -> None:
    pair = pair_of(RAMP, SMALL, noise=1.0)
    shift = np.array([[1, 0, 0], [0, 1, rows]], float)
    moved = cv2.warpAffine(
        pair.right, shift, (300, 160), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
    )
    assert (
        np.nanmedian(np.abs(error_of(replace(pair, right=np.asarray(moved, np.uint8)), RAMP)))
        < 0.08
    )


def test_light_is_evened_where_it_differs_and_only_there() -> None:
    pair = pair_of(RAMP, SMALL, noise=1.0)
    dark = replace(pair, right=(255 * (pair.right / 255.0) ** 2).astype(np.uint8))
    uneven = dimmed(pair, np.linspace(1.6, 0.3, 300))
    for both, like, even in ((pair, None, False), (dark, True, False), (uneven, None, True)):
        images = sgbm.crop(grey(both.left), grey(both.right), whole(SMALL))
        alike, compared = light.evened(images, CONFIG)
        assert like is None or (alike.gain != 1) is like
        assert (compared.left is not alike.left) is even
    with_it, without = (
        error_of(dark, RAMP, MatchingConfig(even_light=even)) for even in (True, False)
    )
    assert np.isfinite(with_it).mean() > np.isfinite(without).mean() + 0.02


def test_noise_is_measured_and_decides_the_window() -> None:
    smooth = cv2.GaussianBlur(texture(160, 320), (0, 0), 3)
    for sigma, block in ((0.4, 3), (4.0, 5)):
        noisy = np.clip(smooth + np.random.default_rng(0).normal(0, sigma, smooth.shape), 0, 255)
        image = np.rint(noisy).astype(np.uint8)
        assert sgbm.noise(image) == pytest.approx(np.hypot(sigma, 12**-0.5), rel=0.25)
        images = sgbm.crop(image, image, whole(replace(RIG, width=320, height=160), 0, 16))
        assert sgbm.with_block(CONFIG, images).block_size == block
        assert sgbm.with_block(MatchingConfig(block_size=7), images).block_size == 7
    assert sgbm.noise(np.zeros((8, 8), np.uint8)) == 0


def test_opencvs_own_check_is_off_where_it_is_meant_to_be() -> None:
    """-1, which OpenCV's documentation says switches it off, acts as one pixel."""
    pair = pair_of(RAMP, SMALL, noise=12.0)
    images = sgbm.crop(grey(pair.left), grey(pair.right), whole(SMALL))
    found = []
    for own in (-1, 1, sgbm.OWN_CHECK_OFF):
        matcher = sgbm._matcher(CONFIG, 0, 64)
        matcher.setDisp12MaxDiff(own)
        found.append(matcher.compute(images.left, images.right))
    assert found[0].tobytes() == found[1].tobytes()
    assert (found[2] >= 0).sum() > (found[0] >= 0).sum()
    assert sgbm._matcher(CONFIG, 0, 64).getDisp12MaxDiff() == sgbm.OWN_CHECK_OFF


def test_a_patch_of_exactly_the_speckle_size_is_dropped() -> None:
    fixed = np.full((20, 40), sgbm.NONE, np.int16)
    fixed[2:7, 2:10], fixed[10:15, 2:10], fixed[15, 2] = 160, 160, 160
    kept = sgbm.drop_speckles(fixed, 40, 1.0)
    assert not kept[:8].any()
    assert kept[10:15, 2:10].all()


@pytest.mark.parametrize(
    ("key", "value", "text"),
    [
        ("block_size", 4, "OpenCV would take 5"),
        ("p2", 8, r"more than p1 \(8\)"),
        ("pre_filter_cap", 14, "greater than or equal to 15"),
        ("pre_filter_cap", 30, "OpenCV would take 31"),
    ],
)
def test_settings_that_opencv_would_change_are_refused(key: str, value: int, text: str) -> None:
    from stereo_ore.io.parameters import load_config

    with pytest.raises(ConfigError, match=text):
        load_config(None, [f"matching.{key}={value}"])


def test_confidence_is_there_where_a_disparity_is_and_higher_where_it_is_right(
    flat_plane_pair,
) -> None:
    pair = flat_plane_pair.pair
    spoilt = pair.right.copy()
    spoilt[100:200, 150:300] = np.random.default_rng(2).integers(0, 255, (100, 150, 3))
    found = matching.match(
        replace(pair, right=spoilt), whole(pair.rig), MatchingConfig(min_confidence=0)
    )
    valid = np.isfinite(found.values)
    np.testing.assert_array_equal(np.isfinite(found.confidence), valid)
    assert 0 <= found.confidence[valid].min() <= found.confidence[valid].max() <= 1
    right = np.abs(found.values - flat_plane_pair.disparity)[valid] <= 1
    assert area_under_roc(found.confidence[valid], right) > 0.9
    strict = matching.match(
        replace(pair, right=spoilt), whole(pair.rig), MatchingConfig(min_confidence=0.8)
    )
    np.testing.assert_array_equal(np.isfinite(strict.values), found.confidence >= 0.8)
    np.testing.assert_array_equal(strict.unsifted().values, found.values)
    told = strict.cues["confidence"]
    np.testing.assert_array_equal(told, np.nan_to_num(found.confidence)[found.region.slices])


def test_a_network_gives_images_what_it_gives_rows() -> None:
    rng = np.random.default_rng(0)
    images = list(rng.normal(size=(3, 37, 41)).astype(np.float32))
    network = Network(
        [0.1, 0, -0.2],
        [1, 2, 0.5],
        rng.normal(size=(3, 4)).tolist(),
        [0.1, 0, 0, -1],
        [1, -1, 2, 0.5],
        0.3,
    )
    rows = network.probability(np.column_stack([image.ravel() for image in images]))
    np.testing.assert_allclose(network.map(images).ravel(), rows, atol=1e-6)


def test_area_under_roc_and_reliability_by_hand() -> None:
    score = np.array([0.9, 0.8, 0.8, 0.35, 0.31])
    right = np.array([True, True, False, True, False])
    assert area_under_roc(score, right) == pytest.approx((2 + 1.5 + 1) / 6)
    assert area_under_roc(score, np.ones(5, bool)) is None
    said, true = reliability(score, right)
    assert (said[3], true[3], true[8], true[9]) == (pytest.approx(0.33), 0.5, 0.5, 1.0)
    assert said[0] is None


def test_the_shipped_network_says_where_it_comes_from() -> None:
    import json
    from importlib.resources import files

    stored = json.loads(
        (files("stereo_ore.stages.matching") / "confidence.json").read_text(encoding="utf-8")
    )
    assert len(confidence.shipped().mean) == len(confidence.PIXEL_FEATURES)
    assert {"made_with", "sets", "faults", "seed", "auc_on_sets_left_out"} <= set(
        stored["provenance"]
    )


def test_exposure_planted_in_a_real_pair_costs_little(shared_data: Path) -> None:
    data = stereo_sets.middlebury(shared_data / "stereo_gt" / "middlebury_v3_quarter" / "Recycle")
    bad = []
    for gain in (1.0, 0.8):
        error = matching.match(dimmed(data.pair, gain), data.region, CONFIG).values - data.truth
        bad.append((~(np.abs(error) <= 2))[np.isfinite(data.truth)].mean())
    assert bad[1] < 1.1 * bad[0]
