"""Clean clouds stay whole, planted outliers go, and neither scale, turn nor order decides."""

import numpy as np
import pytest

from stereo_ore.config import FilterConfig
from stereo_ore.lab import synth
from stereo_ore.lab.bench.clean import CLEAN, clean_clouds, planted_clouds, scan
from stereo_ore.lab.bench.labelled import bare_cloud
from stereo_ore.lab.metrics import filter_quality
from stereo_ore.lab.synth.outliers import ADDED, MOVED, cloud_spacing, normals, plant_outliers
from stereo_ore.network import Network, average
from stereo_ore.stages import filters
from stereo_ore.stages.filters.evidence import quantiles, vote_scales
from stereo_ore.stages.filters.scorer import Scorer
from stereo_ore.types import F64, centred_cloud


def kept(xyz: F64, method: str = "adaptive") -> np.ndarray:
    return filters.apply(bare_cloud(xyz), FilterConfig(method=method)).keep


def smooth(seed: int = 0, side: int = 60) -> F64:
    xy = np.random.default_rng(seed).uniform(0, side, (side * side, 2))
    return np.column_stack([xy, 3 * np.sin(xy[:, 0] / 9) * np.cos(xy[:, 1] / 11)])


@pytest.mark.parametrize("name", CLEAN)
def test_shapes_that_no_training_has_lose_two_per_cent_at_most(name: str) -> None:
    xyz = CLEAN[name](np.random.default_rng([31, 2]))
    assert kept(xyz).mean() >= 0.98
    assert filters.apply(bare_cloud(xyz), FilterConfig(method="closed-form")).keep.mean() >= 0.9


def test_a_real_boulder_bed_is_kept(shared_data) -> None:  # type: ignore[no-untyped-def]
    bed = scan(shared_data / "stones" / "Otira_1cm_grains.ply")
    lost = {
        c.name: (~kept(c.voxels.xyz)).mean()
        for c in clean_clouds(range(7, 8), [("bed", bed)])
        if "bed" in c.name
    }
    assert len(lost) == 3
    assert max(lost.values()) <= 0.02, lost


def test_the_papers_outliers_on_a_real_boulder_bed(shared_data) -> None:  # type: ignore[no-untyped-def]
    bed = scan(shared_data / "stones" / "Otira_1cm_grains.ply")
    f1: dict[str, list[float]] = {}
    for c in planted_clouds(range(1), [("bed", bed)]):
        f1.setdefault(c.cell, []).append(filter_quality(c.is_noise, ~kept(c.voxels.xyz)).f1)
    paper = [np.mean(values) for cell, values in f1.items() if "paper" in cell]
    other = [np.mean(values) for cell, values in f1.items() if "paper" not in cell]
    assert np.all(np.array(paper) >= [0.72, 0.78, 0.83]), f1
    assert np.mean(other) >= 0.80, f1


@pytest.mark.parametrize("kind", [*MOVED, *ADDED])
def test_outliers_of_all_kinds_on_a_smooth_surface(kind: str) -> None:
    xyz, noise = plant_outliers(np.random.default_rng(3), smooth(), 0.08, kind)
    assert noise.mean() == pytest.approx(0.08, abs=0.002)
    assert filter_quality(noise, ~kept(xyz)).f1 >= 0.7


def test_planting_leaves_the_surface_alone() -> None:
    clean = smooth()
    for kind in (*MOVED, *ADDED):
        xyz, noise = plant_outliers(np.random.default_rng(3), clean, 0.08, kind)
        np.testing.assert_array_equal(
            xyz[: len(clean)][~noise[: len(clean)]], clean[~noise[: len(clean)]]
        )
    with pytest.raises(ValueError, match="no outliers are called"):
        plant_outliers(np.random.default_rng(3), clean, 0.08, "clump")


def test_normals_and_spacing_of_a_lattice() -> None:
    plane = np.insert(np.indices((20, 20)).reshape(2, -1).T.astype(float), 0, 0, axis=1)
    np.testing.assert_allclose(np.abs(normals(plane)) @ [1, 0, 0], 1, atol=1e-9)
    assert cloud_spacing(plane) == pytest.approx((4 + 4 * np.sqrt(2)) / 8)


@pytest.mark.parametrize(
    ("direction", "share"), [("isotropic", 0.148), ("normal", 0.564), ("ray", 0.099)]
)
def test_scale_turn_and_order_decide_a_thousandth_at_most(
    direction: synth.Direction, share: float
) -> None:
    xyz, _ = synth.paper_cloud(4, direction, share)
    rng, config = np.random.default_rng(0), FilterConfig()
    keep = filters.apply(centred_cloud(xyz), config).keep
    order = rng.permutation(len(xyz))
    np.testing.assert_array_equal(
        filters.apply(centred_cloud(xyz[order]), config).keep, keep[order]
    )
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    for moved in (xyz * 1e-3, xyz * 1e3, xyz @ turn):
        assert (filters.apply(centred_cloud(moved), config).keep != keep).mean() <= 0.001


def test_quantiles_are_those_of_numpy() -> None:
    values = np.random.default_rng(0).normal(size=777).astype(np.float32)
    at = (0.0, 0.1, 0.5, 0.97, 1.0)
    np.testing.assert_allclose(quantiles(values, at), np.quantile(values, at), rtol=1e-5)


def test_votes_are_as_strict_as_the_cloud_is_smooth() -> None:
    residual = np.abs(np.random.default_rng(0).normal(0, 0.7, 5000)).astype(np.float32)
    strict, lenient = vote_scales(residual, np.ones(5000, np.float32))
    assert strict == pytest.approx(0.7, rel=0.1)
    assert lenient / strict == pytest.approx(0.8 / 0.3)
    assert vote_scales(residual / 100, np.ones(5000, np.float32)) == (0.3, 0.8)


def network(seed: int, units: int = 5) -> Network:
    rng = np.random.default_rng(seed)
    mean, scale = [0.5, 1.0, -1.0], [1.0, 2.0, 0.5]
    weights = rng.normal(size=(3, units)).tolist()
    return Network(
        mean, scale, weights, rng.normal(size=units).tolist(), rng.normal(size=units).tolist(), 0.3
    )


def logit(p: np.ndarray) -> np.ndarray:
    return np.asarray(np.log(p / (1 - p)))


def test_networks_average_by_their_log_odds_and_take_known_features() -> None:
    features = np.random.default_rng(5).normal(size=(50, 3)).astype(np.float32)
    features[:, 2] = 0.7
    one, two = network(1), network(2, units=3)
    mean = (logit(one.probability(features)) + logit(two.probability(features))) / 2
    both = average([one, two])
    np.testing.assert_allclose(logit(both.probability(features)), mean, rtol=1e-3, atol=1e-4)
    known = both.given(np.array([0.7], np.float32)).probability(features[:, :2])
    np.testing.assert_allclose(known, both.probability(features), rtol=1e-5)


def foretold(noise: np.ndarray, threshold: float) -> tuple[float, float]:
    """F1, and the share of good points lost, that probabilities foretell."""
    gone = noise[noise > threshold]
    return 2 * gone.sum() / (len(gone) + noise.sum()), (1 - gone).sum() / (1 - noise).sum()


@pytest.mark.parametrize("most_lost", [0.02, 0.06, 1.0])
@pytest.mark.parametrize("power", [1.0, 3.0, 8.0])
def test_the_decision_has_the_greatest_f1_foretold_that_spares_the_good(
    most_lost: float, power: float
) -> None:
    noise = (np.random.default_rng(0).random(400) ** power).astype(np.float32)
    threshold = Scorer([], [], 0.2, most_lost).decide(noise)
    f1, lost = foretold(noise, threshold)
    assert lost <= most_lost
    assert threshold >= 0.2
    others = [foretold(noise, t) for t in [0.2, *noise[noise > 0.2]]]
    assert f1 == pytest.approx(max(other for other, gone in others if gone <= most_lost))


def test_the_decision_without_a_bound_or_without_noise_is_the_threshold() -> None:
    noise = np.array([0.9, 0.6, 0.1], np.float32)
    assert Scorer([], [], 0.35).decide(noise) == 0.35
    assert Scorer([], [], 0.35, 0.06).decide(noise[2:]) == 0.35
    assert Scorer([], [], 0.35, 0.06).decide(noise[:0]) == 0.35
