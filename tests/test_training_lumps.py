"""Training of the segmentation's models: what it is shown, that it learns, and the file it
writes."""

import dataclasses
import json

import numpy as np
import pytest

from stereo_ore.config import SegmentConfig
from stereo_ore.lab import synth
from stereo_ore.lab.training import lumps
from stereo_ore.stages.segment.pixels import PIXEL_FEATURES
from stereo_ore.stages.segment.weights import Logistic, Weights, load

CONFIG = SegmentConfig()


@pytest.fixture(scope="module")
def views() -> list[lumps.View]:
    """Of a crowded screen, so that lumps touch."""
    made = synth.scene(dataclasses.replace(synth.sample_spec(3, "paper", "VGA"), lumps=12))
    wanted = tuple(lump.id for lump in made.lumps if not lump.cut and lump.visible_pixels > 400)
    return list(lumps._views("one", made.pair, made.calibration, made.site, made.instance, wanted))


def test_a_scene_is_seen_at_each_threshold_and_without_its_screen(views: list[lumps.View]) -> None:
    assert len(views) == len(lumps.THRESHOLDS) + 2
    kept = [int(np.isfinite(view.surface.sigma_z).sum()) for view in views]
    assert kept[3] < kept[0] < kept[4]
    # Without a plane the bars are not registered, which moves a few points.
    assert kept[1] == kept[2] == pytest.approx(kept[0], rel=0.02)


def test_pairs_of_one_lump_are_told_from_pairs_of_two(views: list[lumps.View]) -> None:
    rng = np.random.default_rng(0)
    pairs = [lumps._pairs_of(lumps.Seen(view, 0, load().pixel), CONFIG, rng) for view in views]
    model = lumps._fit(pairs, load().pair.features)
    features, truth = (
        np.concatenate([getattr(p, name) for p in pairs]) for name in ("features", "truth")
    )
    assert truth.any()
    assert not truth.all()
    sure = model.probability(features)
    assert sure[truth].mean() > sure[~truth].mean() + 0.3


def test_pixels_of_ore_are_half_of_the_examples_and_as_many_of_each_lump(
    views: list[lumps.View],
) -> None:
    rng = np.random.default_rng(0)
    features, truth = lumps._pixels(views[0], CONFIG, rng)
    assert features.shape == (len(truth), len(PIXEL_FEATURES))
    assert len(truth) <= lumps.PIXELS
    assert truth.mean() == pytest.approx(0.5, abs=0.1)
    twice, _ = lumps._pixels(dataclasses.replace(views[0], weight=2.0), CONFIG, rng)
    assert len(twice) == pytest.approx(2 * len(truth), rel=0.1)


def test_a_network_of_pixels_tells_ore(views: list[lumps.View]) -> None:
    rng = np.random.default_rng(0)
    features, truth = lumps._pixels(views[0], CONFIG, rng)
    sure = lumps._network([lumps._pixels(view, CONFIG, rng) for view in views[1:]]).probability(
        features
    )
    assert sure[truth].mean() > sure[~truth].mean() + 0.4


def test_training_repeats_and_segments(views: list[lumps.View]) -> None:
    """With one lump declared rubble, so that there are parts that are none."""
    rubble = np.where(views[0].instance == views[0].wanted[-1], 0, views[0].instance)
    split = [
        dataclasses.replace(v, scene=f"{n}", instance=rubble, wanted=v.wanted[:-1])
        for n, v in enumerate(views)
    ]
    weights, held_out = lumps.train(split, CONFIG)
    assert (weights, held_out) == lumps.train(split, CONFIG)
    quality = lumps.judge(views[0], CONFIG, weights)
    assert quality.found >= 0.7 * quality.wanted
    assert 0 <= quality.false <= quality.given
    assert "recall" in str(held_out)


def test_weights_survive_their_file() -> None:
    assert Weights.from_dict(json.loads(load().to_json())) == load()


def test_weights_of_other_features_are_refused() -> None:
    data = json.loads(load().to_json())
    data["pair"]["features"][0] = "another"
    with pytest.raises(ValueError, match="other features"):
        Weights.from_dict(data)


def test_a_network_of_other_features_is_refused() -> None:
    data = json.loads(load().to_json())
    for name in ("mean", "scale", "hidden_weights"):
        data["pixel"][name].pop()
    with pytest.raises(ValueError, match="other features"):
        Weights.from_dict(data)


def test_logistic_is_its_equation() -> None:
    model = Logistic(("a", "b"), (1.0, 0.0), (2.0, 1.0), (0.5, -1.0), 0.25)
    np.testing.assert_allclose(
        model.probability(np.array([[3.0, 2.0]])), 1 / (1 + np.exp(0.5 * -1 + 2 - 0.25))
    )
