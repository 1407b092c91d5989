"""``tune``: the cost, the search, the files it writes, the training of scorers."""

import itertools
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from stereo_ore.cli import app, load_verbs
from stereo_ore.config import FilterConfig
from stereo_ore.errors import ConfigError, StereoOreError
from stereo_ore.io import clouds
from stereo_ore.io.parameters import load_config
from stereo_ore.lab import tune
from stereo_ore.lab.bench.labelled import TUNING_SEED, LabelledCloud, bare_cloud
from stereo_ore.lab.metrics import FilterQuality, filter_quality
from stereo_ore.lab.training import bare_clouds, scorers, surfaces
from stereo_ore.stages import filters
from stereo_ore.stages.filters.adaptive import run_passes
from stereo_ore.stages.filters.evidence import bare_evidence
from stereo_ore.stages.filters.scorer import read


def cloud(seed: int = 0) -> LabelledCloud:
    rng = np.random.default_rng(seed)
    plane = np.column_stack([rng.uniform(0, 1, (700, 2)), rng.normal(0, 0.002, 700)])
    off = np.column_stack(
        [rng.uniform(0, 1, (100, 2)), rng.uniform(0.05, 0.4, 100) * rng.choice([-1, 1], 100)]
    )
    return LabelledCloud(
        "plane", "cell", bare_cloud(np.concatenate([plane, off])), np.arange(800) >= 700
    )


@pytest.fixture
def labelled_csv(tmp_path: Path) -> Path:
    made = cloud()
    columns = {axis: made.voxels.xyz[:, i] for i, axis in enumerate("xyz")} | {
        "noise": made.is_noise.astype(np.uint8)
    }
    path = tmp_path / "labelled.csv"
    clouds.write(path, clouds.from_columns(columns))
    return path


def test_cost_is_the_weighted_mean_of_the_losses() -> None:
    quality = FilterQuality(precision=0.9, recall=0.5, retention=0.8, f1=0.64)
    assert tune.CostWeights().cost(quality) == pytest.approx((0.1 + 0.5 + 0.2) / 3)
    assert tune.CostWeights(precision=0, recall=3, retention=1).cost(quality) == pytest.approx(
        (3 * 0.5 + 0.2) / 4
    )
    with pytest.raises(ConfigError, match="all weights are zero"):
        tune.CostWeights(precision=0, recall=0, retention=0).cost(quality)


def test_search_finds_the_best_of_a_small_grid() -> None:
    clouds, weights = [cloud()], tune.CostWeights()
    tuned = tune.search_parameters("statistical", clouds, weights)
    space = tune.SPACES["statistical"]
    costs = {
        values: tune._mean_cost(
            "statistical", dict(zip(space, values, strict=True)), clouds, weights
        )
        for values in itertools.product(*space.values())
    }
    assert tuned.cost <= sorted(costs.values())[2]
    assert tuned.cost == costs[tuple(tuned.params.values())]
    assert set(tuned.curves) == set(space)


def test_search_is_deterministic_and_counts() -> None:
    ticks = []
    first = tune.search_parameters(
        "adaptive", [cloud()], tune.CostWeights(), lambda: ticks.append(1)
    )
    assert first == tune.search_parameters("adaptive", [cloud()], tune.CostWeights())
    assert len(ticks) == len(tune.SPACES["adaptive"]["threshold"])


def test_weights_move_the_result() -> None:
    clouds = [cloud()]
    careful = tune.search_parameters(
        "adaptive", clouds, tune.CostWeights(recall=0, precision=0, retention=1)
    )
    greedy = tune.search_parameters(
        "adaptive", clouds, tune.CostWeights(recall=1, precision=0, retention=0)
    )
    assert careful.params["threshold"] >= greedy.params["threshold"]


@pytest.mark.parametrize("method", ["none", "adaptve"])
def test_what_can_not_be_tuned(method: str) -> None:
    with pytest.raises(ConfigError, match="can't be tuned"):
        tune.search_parameters(method, [cloud()], tune.CostWeights())


def test_command_writes_a_configuration_that_loads(labelled_csv: Path, tmp_path: Path) -> None:
    load_verbs()
    cost = tmp_path / "cost.yaml"
    cost.write_text("recall: 2.0\n")
    out = tmp_path / "tuned"
    arguments = ["tune", out, "--method", "statistical", "--cloud", labelled_csv, "--cost", cost]
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    assert result.exit_code == 0, result.output
    config = load_config(out / "config.yaml").filter
    assert config.method == "statistical"
    filters.parameters(config)
    assert yaml.safe_load(result.stdout) == yaml.safe_load((out / "config.yaml").read_text())
    assert (out / "cost.png").is_file() == bool(find_spec("matplotlib"))


@pytest.mark.parametrize(
    ("text", "words"),
    [("recal: 1", "did you mean recall"), ("recall: -1", "recall: "), ("- 1", "mapping")],
)
def test_bad_cost_files(labelled_csv: Path, tmp_path: Path, text: str, words: str) -> None:
    load_verbs()
    (tmp_path / "cost.yaml").write_text(text)
    arguments = ["tune", tmp_path, "--cloud", labelled_csv, "--cost", tmp_path / "cost.yaml"]
    fault = CliRunner().invoke(app, [str(a) for a in arguments]).exception
    assert isinstance(fault, StereoOreError)
    assert words in str(fault)


def test_training_learns_and_repeats(monkeypatch: pytest.MonkeyPatch) -> None:
    recipe = scorers.Recipe(2 * ((scorers.Fit(8, 19), scorers.Fit(8, 19)),), 700, 30, 0.4)
    monkeypatch.setitem(scorers.RECIPES, "geometry", recipe)
    clouds = [cloud(seed) for seed in range(3)]
    scorer = scorers.train_scorer(clouds, "geometry")
    assert scorer == scorers.train_scorer(clouds, "geometry")
    unseen = cloud(9)
    voxels, rows = filters.prepared(unseen.voxels)
    quality = filter_quality(
        unseen.is_noise[rows], run_passes(bare_evidence(voxels.xyz, 16), scorer) > 0.5
    )
    assert quality.f1 > 0.9


def test_a_trained_scorer_says_where_it_comes_from_and_is_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    load_verbs()
    monkeypatch.setitem(
        scorers.RECIPES, "geometry", scorers.Recipe(((scorers.Fit(4),),), 200, 2, 0.4)
    )
    monkeypatch.setattr(bare_clouds, "PIECES_A_SEED", 3)
    result = CliRunner().invoke(app, ["tune", str(tmp_path), "--train", "geometry", "--seeds", "1"])
    assert result.exit_code == 0, result.output
    written = read(tmp_path / "geometry.json")
    assert written.provenance["fitted to"] == {"seeds": [TUNING_SEED, TUNING_SEED], "scans": []}
    assert set(written.provenance) == {"version", "seed", "fitted to", "left out"}
    params = {"scorer": str(tmp_path / "geometry.json")}
    used = filters.apply(cloud().voxels, FilterConfig(params=params))
    assert used.diagnostics["threshold"] == written.threshold
    assert not np.array_equal(used.score, filters.apply(cloud().voxels, FilterConfig()).score)


def test_a_file_that_is_no_scorer(tmp_path: Path) -> None:
    (tmp_path / "no.json").write_text('{"passes": []}')
    for name, words in (("no.json", "is no scorer"), ("absent.json", "can't be read")):
        with pytest.raises(ConfigError, match=words):
            filters.apply(cloud().voxels, FilterConfig(params={"scorer": str(tmp_path / name)}))


def test_a_good_third_of_what_is_learned_has_no_outlier() -> None:
    made = list(bare_clouds.bare_clouds(range(TUNING_SEED, TUNING_SEED + 1), []))
    clean = [c for c in made if not c.is_noise.any()]
    assert len(made) == bare_clouds.clouds_a_seed()
    assert len(clean) / len(made) >= 0.35


@pytest.mark.parametrize("name", surfaces.SHAPES)
def test_shapes_to_learn_from_are_pieces_of_some_thousand_points(name: str) -> None:
    xyz = surfaces.SHAPES[name](np.random.default_rng(1), 2000)
    assert 500 < len(xyz) <= 5000
    assert np.isfinite(xyz).all()


def test_seeds_of_tuning_and_reporting_are_disjoint() -> None:
    """`bench filter` takes at most a hundred seeds, from 0."""
    assert TUNING_SEED >= 100


def test_varied_clouds_differ_from_the_protocol() -> None:
    varied = bare_clouds.varied(TUNING_SEED, 1)
    assert 0 < varied.is_noise.mean() < 0.7
    assert len(varied.voxels) < 18_809
