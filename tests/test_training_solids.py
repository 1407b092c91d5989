"""Training of the solids' shape prior: what it is shown, that it learns, and the file it writes."""

import dataclasses
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from stereo_ore.cli import app, load_verbs
from stereo_ore.lab.training import casts, shape_prior, solids
from stereo_ore.stages.solid import Cues, prior

MADE_SEED = 400


@pytest.fixture(scope="module")
def found(synth_folder: Path) -> list[solids.SolidSample]:
    return list(solids.recorded(synth_folder))


@pytest.fixture(scope="module")
def made() -> list[solids.SolidSample]:
    pytest.importorskip("mujoco", reason="the extra [train] is not installed")
    return list(casts.made_up(MADE_SEED))


def test_a_scene_is_seen_in_every_appearance(found: list[solids.SolidSample]) -> None:
    count = Counter(sample.seen_as for sample in found)
    assert set(count) == {"measured", "unplaced", "outlined", "true"}
    assert count["true"] == count["outlined"] >= count["measured"]


def test_samples_tell_the_truth(
    found: list[solids.SolidSample], made: list[solids.SolidSample]
) -> None:
    for sample in [*found, *made]:
        truth = sample.truth
        assert sample.size == pytest.approx(np.exp(truth["longest"]))
        assert truth["longest"] >= truth["middle"] - 0.05
        box = sum(truth[name] for name in ("longest", "middle", "shortest"))
        assert 0.25 < np.exp(truth["volume"] - box) < 0.8
        assert abs(truth["x"]) + abs(truth["y"]) < 0.8


def test_a_made_up_screen_is_seen_as_it_is_and_as_it_would_be_measured(
    made: list[solids.SolidSample],
) -> None:
    count = Counter(sample.seen_as for sample in made)
    assert count["true"] >= count["measured"] > 0.8 * count["true"]
    again = list(casts.made_up(MADE_SEED))
    assert [sample.truth for sample in again] == [sample.truth for sample in made]
    # The shipped prior knows such lumps, and better by true depth.
    shift = {
        name: np.median([_shift(s) for s in made if s.seen_as == name])
        for name in ("true", "measured")
    }
    assert shift["true"] < shift["measured"] + 0.01 < 0.09


def _shift(sample: solids.SolidSample) -> float:
    mean = prior.load_prior().estimate(sample.cues.even, sample.cues.odd).mean
    return float(np.linalg.norm([mean[k] - sample.truth[k] for k in "xyz"])) / sample.size


def law(seed: int) -> list[solids.SolidSample]:
    """Samples of a law that is linear in cues and a square, with wild errors among them, larger
    where a is."""
    rng = np.random.default_rng(seed)
    made = []
    for scene in range(12):
        for _ in range(100):
            a, b, c, p, q = rng.normal(size=5)
            wild = 0.05 * np.exp(a) * rng.standard_t(3, len(prior.TARGETS))
            truth = {
                t: k + 2 * a - c + 0.5 * b * b + error
                for k, (t, error) in enumerate(zip(prior.TARGETS, wild, strict=True))
            }
            cues = Cues({"a": a, "b": b, "c": c}, {"p": p, "q": q}, 0.0, None, None)  # type: ignore[arg-type]
            made.append(
                solids.SolidSample(
                    f"{scene}", "measured", False, cues, truth | {"y": 0.5 * p + wild[-1]}, 1.0
                )
            )
    return made


def test_training_recovers_a_law_and_survives_its_file(tmp_path: Path, few_steps: None) -> None:
    fitted, errors = shape_prior.train_prior(law(1))
    file = tmp_path / "prior.json"
    file.write_text(fitted.to_json())
    loaded = prior.load_prior(file)
    one, other = (
        loaded.estimate({"a": 0.5, "b": b, "c": 0.5}, {"p": 2.0, "q": 0.5}).mean for b in (0.0, 1.5)
    )
    for k, target in enumerate(prior.TARGETS[:-1]):
        assert one[target] == pytest.approx(k + 0.5, abs=0.3)
        assert other[target] == pytest.approx(k + 0.5 + 1.125, abs=0.4)
    assert one["y"] == pytest.approx(1.0, abs=0.1)
    assert np.median(np.abs(errors[:, 0])) < 0.2
    sure, doubtful = (
        loaded.estimate({"a": a, "b": 0.0, "c": 0.0}, {"p": 0.0, "q": 0.0}).sigma["y"]
        for a in (-1.0, 1.0)
    )
    assert doubtful > 1.5 * sure


def test_a_cue_that_never_varies_does_no_harm(few_steps: None) -> None:
    still = [
        dataclasses.replace(s, cues=dataclasses.replace(s.cues, even={**s.cues.even, "b": 1.0}))
        for s in law(4)
    ]
    fitted, _ = shape_prior.train_prior(still)
    estimate = fitted.estimate({"a": 0.0, "b": 2.0, "c": 0.0}, {"p": 0.0, "q": 0.0})
    assert np.isfinite(list(estimate.mean.values())).all()
    assert np.isfinite(list(estimate.sigma.values())).all()


@pytest.mark.parametrize("recorded", [False, True])
def test_sigma_holds_errors_of_scenes_left_out(few_steps: None, recorded: bool) -> None:
    """Of scene folders where there are some, in spite of made-up scenes that err otherwise."""
    found = law(2)
    if recorded:
        found += [dataclasses.replace(s, scene=f"r{s.scene}", recorded=True) for s in law(3)]
    _, errors = shape_prior.train_prior(found)
    rows = [k for k, s in enumerate(found) if s.recorded is recorded]
    quality = shape_prior.prior_quality([found[k] for k in rows], errors[rows])
    assert quality.inside == pytest.approx(shape_prior.HELD, abs=0.02)
    assert quality.bounded == pytest.approx(shape_prior.HELD, abs=0.02)
    assert quality.lumps == len(rows)


def test_equal_samples_give_equal_bytes(few_steps: None) -> None:
    one, other = (shape_prior.train_prior(law(5))[0].to_json() for _ in range(2))
    assert one == other


def test_a_scene_is_left_out_whole(few_steps: None) -> None:
    """What is true of one scene alone is not learned for that scene."""
    odd = [
        dataclasses.replace(s, truth={**s.truth, "z": 50.0}) if s.scene == "3" else s
        for s in law(3)
    ]
    _, errors = shape_prior.train_prior(odd)
    alone = np.array([s.scene == "3" for s in odd])
    assert np.abs(errors[alone, 0, 1]).min() > 20


@pytest.fixture
def few_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shape_prior, "DESCENTS", 400)
    monkeypatch.setattr(shape_prior, "NETWORKS", 2)


def test_the_command_writes_a_prior_that_loads(
    tmp_path: Path,
    synth_folder: Path,
    made: list[solids.SolidSample],
    few_steps: None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    load_verbs()
    monkeypatch.setattr(casts, "made_up", lambda seed: iter(made))
    arguments = ["tune", tmp_path, "--train", "solids", "--seeds", 1, "--scene", synth_folder]
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    assert result.exit_code == 0, result.output
    assert set(prior.load_prior(tmp_path / "solids.json").even) == set(prior.load_prior().even)


def test_true_depth_of_path_traced_scenes(shared_data: Path) -> None:
    """What the shape prior leaves open with exact depth and outlines, on scenes not fitted to."""
    found = [
        sample
        for folder in sorted((shared_data / "scenes_dev").glob("*/"))
        for sample in solids.recorded(folder)
        if sample.seen_as == "true"
    ]
    quality = shape_prior.prior_quality(found, _errors(found))
    assert quality.lumps > 50
    assert quality.shift < 0.04
    assert quality.volume < 0.13
    assert quality.longest < 0.05
    assert quality.inside > 0.93
    assert quality.bounded > 0.92


def _errors(found: list[solids.SolidSample]) -> np.ndarray:
    """Errors and sigmas (N, 2, T) of the shipped prior."""
    estimates = [prior.load_prior().estimate(s.cues.even, s.cues.odd) for s in found]
    return np.array(
        [
            [[e.mean[n] - s.truth[n] for n in prior.TARGETS], [e.sigma[n] for n in prior.TARGETS]]
            for e, s in zip(estimates, found, strict=True)
        ]
    )
