"""Training of the solids' shape prior: what it is shown, that it learns, and the file it writes."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from stereo_ore.cli import app, load_verbs
from stereo_ore.lab.training import shape_prior, solids
from stereo_ore.stages.solid import Cues, prior
from stereo_ore.types import F64

NO_DOUBT = dict.fromkeys(prior.DOUBTS, 0.0)


@pytest.fixture(scope="module")
def known(synth_folder: Path) -> solids.KnownLump:
    return solids.recorded(synth_folder)


@pytest.fixture(scope="module")
def found(known: solids.KnownLump) -> list[solids.SolidSample]:
    return list(solids.samples(known))


def test_a_scene_is_seen_in_every_appearance(
    known: solids.KnownLump, found: list[solids.SolidSample]
) -> None:
    count = {name: sum(s.seen_as == name for s in found) for name in solids.WEIGHTS}
    assert count["true"] == count["outlined"] == len(known.bodies)
    assert all(count.values())


def test_samples_tell_the_truth(found: list[solids.SolidSample]) -> None:
    for sample in found:
        truth = sample.truth
        assert sample.size == pytest.approx(np.exp(truth["longest"]))
        assert truth["longest"] >= truth["middle"] - 0.05
        box = sum(truth[name] for name in ("longest", "middle", "shortest"))
        assert 0.25 < np.exp(truth["volume"] - box) < 0.8
        assert abs(truth["x"]) + abs(truth["y"]) < 0.8


def law(seed: int) -> list[solids.SolidSample]:
    """Samples of a law that is linear in cues and a square, with wild errors among them."""
    rng = np.random.default_rng(seed)
    made = []
    for scene in range(12):
        for _ in range(100):
            a, b, c, p, q = rng.normal(size=5)
            truth = {
                t: k + 2 * a - c + 0.5 * b * b + 0.01 * rng.standard_t(2)
                for k, t in enumerate(prior.TARGETS)
            }
            cues = Cues({"a": a, "b": b, "c": c}, {"p": p, "q": q}, NO_DOUBT, 0.0, None, None)  # type: ignore[arg-type]
            made.append(
                solids.SolidSample(f"{scene}", "measured", False, cues, truth | {"y": 0.5 * p}, 1.0)
            )
    return made


def test_training_recovers_a_law_and_survives_its_file(tmp_path: Path) -> None:
    fitted, errors = shape_prior.train_prior(law(1))
    file = tmp_path / "prior.json"
    file.write_text(fitted.to_json())
    one, other = (
        prior.load_prior(file)
        .estimate({"a": 1.0, "b": b, "c": 0.5}, {"p": 2.0, "q": 9.0}, NO_DOUBT)
        .mean
        for b in (1.0, 2.0)
    )
    for k, target in enumerate(prior.TARGETS):
        assert one[target] == pytest.approx(k + 2, abs=0.3)
        assert other[target] > one[target] + 0.5
    assert one["y"] == other["y"] == pytest.approx(1.0, abs=0.05)
    assert np.median(np.abs(errors)) < 0.4
    assert "b*b" in json.loads(file.read_text())["even"]


def test_a_cue_that_never_varies_does_no_harm(tmp_path: Path) -> None:
    still = [
        dataclasses.replace(s, cues=dataclasses.replace(s.cues, even={**s.cues.even, "b": 1.0}))
        for s in law(4)
    ]
    file = tmp_path / "prior.json"
    file.write_text(shape_prior.train_prior(still)[0].to_json())
    estimate = prior.load_prior(file).estimate(
        {"a": 0.0, "b": 1.0, "c": 0.0}, {"p": 0.0, "q": 0.0}, NO_DOUBT
    )
    assert np.isfinite(list(estimate.mean.values())).all()


def test_sigma_holds_errors_of_scenes_left_out() -> None:
    found = law(2)
    fitted, errors = shape_prior.train_prior(found)
    quality = shape_prior.prior_quality(found, errors, fitted)
    assert quality.inside == pytest.approx(shape_prior.HELD, abs=0.02)
    assert quality.bounded == pytest.approx(shape_prior.HELD, abs=0.02)
    assert quality.lumps == len(found)


def test_a_scene_is_left_out_whole() -> None:
    """What is true of one scene alone is not learned for that scene."""
    odd = [
        dataclasses.replace(s, truth={**s.truth, "z": 50.0}) if s.scene == "3" else s
        for s in law(3)
    ]
    _, errors = shape_prior.train_prior(odd)
    alone = np.array([s.scene == "3" for s in odd])
    assert np.abs(errors[alone, 1]).min() > 20


def test_the_command_writes_a_prior_that_loads(
    tmp_path: Path, synth_folder: Path, known: solids.KnownLump, monkeypatch: pytest.MonkeyPatch
) -> None:
    load_verbs()
    monkeypatch.setattr(solids, "made_solids", lambda seed: known)
    arguments = ["tune", tmp_path, "--train", "solids", "--seeds", 1, "--scene", synth_folder]
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    assert result.exit_code == 0, result.output
    assert set(prior.load_prior(tmp_path / "solids.json").even.cues) == set(
        prior.load_prior().even.cues
    )


def test_seeds_differ_in_family_and_lumps(monkeypatch: pytest.MonkeyPatch) -> None:
    specs = []
    monkeypatch.setattr(
        solids.synth, "scene", lambda spec: specs.append(spec) or pytest.fail("made")
    )
    for seed in range(solids.FIRST_SEED, solids.FIRST_SEED + 12):
        with pytest.raises(pytest.fail.Exception):
            solids.made_solids(seed)
    assert {spec.family for spec in specs} == {"large", "paper", "hard", "raw"}
    assert sum(spec.angular for spec in specs) == 9
    assert {spec.family for spec in specs if not spec.angular} != {"large"}


def test_true_depth_of_path_traced_scenes(shared_data: Path) -> None:
    """What the shape prior leaves open with exact depth and outlines, on scenes not fitted to."""
    found = []
    for folder in sorted((shared_data / "scenes_dev").glob("*/")):
        scene = solids.recorded(folder)
        measured = solids._process(scene, scene.pair, scene.site)
        found += solids._samples(
            scene, "true", solids._true(solids._outlined(measured, scene), scene)
        )
    quality = shape_prior.prior_quality(found, _errors(found), prior.load_prior())
    assert quality.lumps > 50
    assert quality.shift < 0.04
    assert quality.volume < 0.13
    assert quality.longest < 0.05
    assert quality.inside > 0.9
    assert quality.bounded > 0.9


def _errors(found: list[solids.SolidSample]) -> F64:
    estimates = [
        prior.load_prior().estimate(s.cues.even, s.cues.odd, s.cues.doubts).mean for s in found
    ]
    names = (*prior.TARGETS, "y")
    return np.array(
        [[mean[n] - s.truth[n] for n in names] for mean, s in zip(estimates, found, strict=True)]
    )
