"""The default filter: its surface geometry, and that it beats every baseline at its best."""

import dataclasses

import numpy as np
import pytest

from stereo_ore.chain import Chain
from stereo_ore.config import Config, FilterConfig, MatchingConfig
from stereo_ore.errors import ConfigError
from stereo_ore.lab import synth
from stereo_ore.lab.bench import filters as bench
from stereo_ore.lab.bench.baselines import CONTENDERS
from stereo_ore.lab.bench.labelled import LabelledCloud, bare_cloud, paper_clouds, scene_stereo
from stereo_ore.lab.metrics import filter_quality
from stereo_ore.lab.synth import paper_cloud
from stereo_ore.network import Network
from stereo_ore.stages import filters
from stereo_ore.stages.filters.adaptive import run_passes
from stereo_ore.stages.filters.evidence import DENSITY_FEATURES, bare_evidence
from stereo_ore.stages.filters.scorer import Scorer, load_scorer
from stereo_ore.stages.filters.stereo import SURE, has_cues, image_space
from stereo_ore.stages.filters.stereo import stereo_evidence as gather_stereo
from stereo_ore.stages.filters.surface import eigen, fit_weighted_planes


@pytest.fixture(scope="module")
def protocol() -> list[LabelledCloud]:
    """One seed of the paper's nine cells, not used in training."""
    return list(paper_clouds(range(3, 4)))


@pytest.fixture(scope="module")
def stereo(synth_folder) -> LabelledCloud:  # type: ignore[no-untyped-def]
    return scene_stereo(synth_folder)


def removed(labelled: LabelledCloud, method: str = "adaptive", **params: object) -> np.ndarray:
    return ~filters.apply(labelled.voxels, FilterConfig(method=method, params=params)).keep


def test_eigen_is_that_of_numpy() -> None:
    rng = np.random.default_rng(0)
    half = rng.normal(size=(300, 3, 3)) * [1, 0.3, 0.01]
    matrices = half @ half.transpose(0, 2, 1)
    m = np.stack(
        [matrices[:, i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))], 1
    )
    values, normal = eigen(m)
    np.testing.assert_allclose(values, np.linalg.eigvalsh(matrices), atol=1e-6)
    np.testing.assert_allclose(
        np.einsum("nij,nj->ni", matrices, normal), values[:, :1] * normal, atol=1e-5
    )
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1)


@pytest.mark.parametrize("moments", [[0, 0, 0, 0, 0, 0], [1, 1, 1, 0, 0, 0], [2, 0, 0, 0, 0, 0]])
def test_eigen_of_degenerate_matrices_is_finite(moments: list[float]) -> None:
    values, normal = eigen(np.array([moments], np.float32))
    np.testing.assert_allclose(values[0], sorted(moments[:3]), atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(normal), 1)


def test_residual_is_the_distance_to_the_weighted_plane() -> None:
    rng = np.random.default_rng(0)
    plane = np.column_stack([rng.uniform(-5, 5, (100, 2)), np.zeros(100)])
    x = np.concatenate([[[0, 0, 2.0]], plane]).astype(np.float32)
    index = np.tile(np.argsort(np.linalg.norm(x[1:], axis=1))[:16].astype(np.int32) + 1, (101, 1))
    planes = fit_weighted_planes(x, index, np.ones(101, np.float32), x)
    assert abs(planes.height[0]) == pytest.approx(2.0, abs=1e-3)
    assert abs(planes.normal[0, 2]) == pytest.approx(1.0, abs=1e-6)
    assert np.exp(planes.shape[0, 0]) == pytest.approx(2.02, abs=1e-3)


def test_paper_protocol_beats_the_best_tuned_baseline(protocol: list[LabelledCloud]) -> None:
    ours = [filter_quality(c.is_noise, removed(c)) for c in protocol]
    assert np.mean([q.f1 for q in ours]) >= 0.90
    assert min(q.f1 for q in ours) >= 0.86
    tuned = [c for c in CONTENDERS if c.method in ("statistical", "radius")]
    best = [max(bench.judge_filter(c, t).f1 for t in tuned) for c in protocol[4:6]]
    assert np.mean([q.f1 for q in ours[4:6]]) >= np.mean(best) + 0.10


def test_noise_along_the_normal_at_the_papers_share(protocol: list[LabelledCloud]) -> None:
    quality = filter_quality(protocol[4].is_noise, removed(protocol[4]))
    assert quality.precision >= 0.9568
    assert quality.recall >= 0.95
    assert quality.retention >= 0.99


def test_real_noise_free_surfaces_are_kept(shared_data) -> None:  # type: ignore[no-untyped-def]
    from stereo_ore.io import clouds

    records = clouds.read(shared_data / "stones" / "A46_point_cloud.ply")[::5]
    xyz = clouds.xyz(records)
    keep = filters.apply(bare_cloud(xyz - xyz.mean(0)), FilterConfig()).keep
    assert keep.mean() > 0.95


def test_thin_bar_is_not_eaten() -> None:
    """A bar three points wide, far from everything."""
    rng = np.random.default_rng(0)
    u, v = np.meshgrid(np.arange(120), np.arange(100))
    ground = np.column_stack([u.ravel() * 5.0, v.ravel() * 5.0, np.zeros(u.size)])
    u, v = np.meshgrid(np.arange(120), np.arange(3))
    bar = np.column_stack([u.ravel() * 5.0, 200 + v.ravel() * 5.0, np.full(u.size, 80.0)])
    xyz = np.concatenate([ground, bar]) + rng.normal(0, 0.4, (len(ground) + len(bar), 3))
    keep = filters.apply(bare_cloud(xyz / 1000), FilterConfig()).keep
    assert keep[len(ground) :].mean() >= 0.95
    assert keep.mean() >= 0.99


def test_higher_threshold_removes_less(protocol: list[LabelledCloud]) -> None:
    counts = [removed(protocol[1], threshold=t).sum() for t in (0.2, 0.5, 0.8)]
    assert counts == sorted(counts, reverse=True)
    assert counts[0] > counts[2]


def test_stereo_clouds_use_the_cues_in_image_space(stereo: LabelledCloud) -> None:
    assert has_cues(stereo.voxels)
    result = filters.apply(stereo.voxels, FilterConfig())
    assert result.diagnostics["scorer"] == "stereo"
    blind = dataclasses.replace(stereo.voxels, cues={})
    assert filters.apply(blind, FilterConfig()).diagnostics["scorer"] == "geometry"
    quality = filter_quality(stereo.is_noise, ~result.keep)
    assert (
        quality.f1
        > filter_quality(stereo.is_noise, removed(dataclasses.replace(stereo, voxels=blind))).f1
    )
    assert quality.retention > 0.85


def test_what_the_matcher_doubts_is_left_to_the_filter(synth_scene: synth.Scene) -> None:
    site = dataclasses.replace(synth_scene.site, plane=None)
    lenient, strict = (
        Chain(synth_scene.calibration, site, Config(matching=MatchingConfig(min_confidence=limit)))(
            synth_scene.pair
        )
        for limit in (0.4, 0.9)
    )
    assert lenient.disparity is not None
    assert strict.disparity is not None
    sure = np.isfinite(strict.disparity.values)
    assert sure.sum() < np.isfinite(lenient.disparity.values).sum()
    assert strict.voxels is not None
    assert lenient.voxels is not None
    np.testing.assert_array_equal(strict.voxels.xyz, lenient.voxels.xyz)
    assert strict.counts["kept"] == lenient.counts["kept"]
    assert strict.cloud is not None
    assert not sure.ravel()[strict.cloud.pixel].all()


def test_image_space_has_pixels_and_disparity(stereo: LabelledCloud) -> None:
    voxels = stereo.voxels
    image = image_space(voxels)
    focal = np.median(voxels.xyz[:, 2] / voxels.pixel_m)
    np.testing.assert_allclose(
        image[:, 0], voxels.xyz[:, 0] / voxels.xyz[:, 2] * focal, rtol=1e-4, atol=1e-3
    )
    assert np.corrcoef(image[:, 2], 1 / voxels.xyz[:, 2])[0, 1] > 0.99


def test_scorer_survives_its_file_and_its_equation() -> None:
    scorer = load_scorer("geometry")
    assert Scorer.from_dict(__import__("json").loads(scorer.to_json())) == scorer
    network = Network([1.0, 0.0], [2.0, 1.0], [[1.0], [-1.0]], [0.5], [2.0], -1.0)
    features = np.array([[3.0, 0.25], [-9.0, 0.0]], np.float32)
    logits = [2 * max(0.0, 1.0 - 0.25 + 0.5) - 1, -1.0]
    np.testing.assert_allclose(
        network.probability(features), [1 / (1 + np.exp(-v)) for v in logits], rtol=1e-5
    )


def test_scorer_of_other_features_is_refused() -> None:
    evidence = bare_evidence(bare_cloud(paper_cloud(0)[0][:200]).xyz, 16)
    assert evidence.names[: len(DENSITY_FEATURES)] == DENSITY_FEATURES
    with pytest.raises(ConfigError, match="other features"):
        run_passes(evidence, load_scorer("stereo"))


def test_what_the_cues_decide_is_not_judged_again(stereo: LabelledCloud) -> None:
    evidence = gather_stereo(stereo.voxels, 16)
    first, final = (
        load_scorer("stereo").passes[0].probability(evidence.cues(slice(None))),
        run_passes(evidence, load_scorer("stereo")),
    )
    sure = (first <= SURE) | (first >= 1 - SURE)
    assert 0.1 < sure.mean() < 0.95
    np.testing.assert_array_equal(final[sure], first[sure])
    assert (final[~sure] != first[~sure]).mean() > 0.99


def test_all_voxels_decided_by_cues_need_no_neighbours(stereo: LabelledCloud) -> None:
    evidence = gather_stereo(stereo.voxels, 16)
    width = evidence.cues(slice(0)).shape[1]
    certain = Network([0.0] * width, [1.0] * width, [[0.0]] * width, [0.0], [0.0], -30.0)
    scorer = Scorer(list(evidence.names), [certain, load_scorer("stereo").passes[1]])
    assert run_passes(evidence, scorer).max() < SURE


def test_closed_form_finds_offsets_that_density_does_not_see(protocol: list[LabelledCloud]) -> None:
    quality = filter_quality(protocol[1].is_noise, removed(protocol[1], "closed-form"))
    assert quality.f1 > max(
        bench.judge_filter(protocol[1], t).f1 for t in CONTENDERS if t.method == "paper"
    )


def test_closed_form_is_its_equation() -> None:
    """A plane, and one point four spacings over it that no plane speaks for."""
    u, v = np.meshgrid(np.arange(20.0), np.arange(20.0))
    xyz = np.column_stack([u.ravel(), v.ravel(), np.zeros(u.size)])
    xyz = np.concatenate(
        [xyz + np.random.default_rng(0).normal(0, 0.01, xyz.shape), [[9.5, 9.5, 4.0]]]
    )
    result = filters.apply(bare_cloud(xyz), FilterConfig(method="closed-form"))
    assert not result.keep[-1]
    assert result.score[-1] > 0.999
    assert result.keep[:-1].mean() > 0.95


def test_closed_form_heeds_the_doubts_of_a_stereo_cloud(stereo: LabelledCloud) -> None:
    params = FilterConfig(method="closed-form")
    trusted = dict.fromkeys(stereo.voxels.cues, np.zeros(len(stereo.voxels), np.float32))
    certain = dataclasses.replace(stereo.voxels, cues=trusted)
    doubted = filters.apply(stereo.voxels, params).score - filters.apply(certain, params).score
    assert doubted[stereo.is_noise].mean() > doubted[~stereo.is_noise].mean() > 0
    assert filter_quality(stereo.is_noise, ~filters.apply(stereo.voxels, params).keep).f1 > 0.3
