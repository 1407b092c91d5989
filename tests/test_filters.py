"""What holds for every filter: bad parameters, degenerate clouds, order, rigid motion, threads."""

import os
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereo_ore.cli import filter as filter_command
from stereo_ore.config import FilterConfig
from stereo_ore.errors import ConfigError
from stereo_ore.lab import synth
from stereo_ore.lab.bench.labelled import bare_cloud
from stereo_ore.stages import filters
from stereo_ore.stages.filters.neighbours import nearest
from stereo_ore.types import FilterResult

METHODS = sorted(filters.METHODS)


def run(xyz: object, method: str = "adaptive", **params: object) -> FilterResult:
    return filters.apply(bare_cloud(np.asarray(xyz)), FilterConfig(method=method, params=params))


def surface(points: int = 2000, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, 0.3, (points, 2))
    z = 0.02 * np.sin(20 * xy[:, 0]) * np.cos(15 * xy[:, 1])
    noise = rng.random(points) < 0.1
    z[noise] += rng.normal(0, 0.02, noise.sum())
    return np.column_stack([xy, z]).astype(np.float32)


@pytest.mark.parametrize(
    ("method", "params", "words"),
    [
        ("adaptiv", {}, "did you mean adaptive"),
        ("paper", {"aplha": 1.0}, "did you mean alpha"),
        ("paper", {"R": 0.0}, "R: "),
        ("statistical", {"k": 0}, "k: "),
        ("radius", {"radius_m": -1.0}, "radius_m: "),
        ("adaptive", {"threshold": 1.5}, "threshold: "),
        ("lof", {"k": float("nan")}, "k: "),
    ],
)
def test_bad_parameters_name_key_and_remedy(method: str, params: dict, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        run(surface(50), method, **params)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("points", [0, 1, 2, 3, 6, 16, 17])
def test_few_points_give_an_answer(method: str, points: int) -> None:
    result = run(surface(points), method)
    assert result.keep.shape == (points,)
    assert points > 1 or result.keep.all()
    assert not np.isnan(result.score).any()


@pytest.mark.parametrize("method", METHODS)
def test_rows_that_are_not_finite_are_removed_and_change_nothing_else(method: str) -> None:
    xyz = surface(500)
    spoilt = np.insert(
        xyz, [0, 100, 500], [[np.nan] * 3, [0, np.inf, 0], [-np.inf] * 3], axis=0
    ).astype(np.float32)
    bad = ~np.isfinite(spoilt).all(1)
    clean, result = run(xyz, method), run(spoilt, method)
    assert not result.keep[bad].any()
    assert np.isinf(result.score[bad]).all()
    np.testing.assert_array_equal(result.keep[~bad], clean.keep)
    assert result.diagnostics["not_finite"] == 3


@pytest.mark.parametrize("method", METHODS)
def test_all_rows_not_finite(method: str) -> None:
    assert not run(np.full((20, 3), np.nan), method).keep.any()


def identical(n: int) -> np.ndarray:
    return np.ones((n, 3))


def line(n: int) -> np.ndarray:
    return np.linspace(0, 1, n)[:, None] * [1.0, 2.0, -1.0]


def clumps(n: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    return rng.normal(0, 1e-3, (n, 3)) + np.where(np.arange(n) < n // 2, 0, 1e4)[:, None]


def huge(n: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(-1e9, 1e9, (n, 3))


@pytest.mark.parametrize("method", ["adaptive", "paper", "statistical", "radius"])
@pytest.mark.parametrize("make", [identical, line, clumps, huge])
def test_degenerate_clouds_end_soon_with_an_answer(method: str, make: object) -> None:
    result = run(make(3000), method)  # type: ignore[operator]
    assert result.keep.shape == (3000,)
    assert not np.isnan(result.score).any()


def test_200_000_identical_points_take_under_five_seconds_and_are_one() -> None:
    start = time.process_time()
    result = run(identical(200_000), "paper")
    assert time.process_time() - start < 5
    assert result.keep.all()
    assert result.diagnostics["duplicates"] == 199_999


@pytest.mark.slow
@pytest.mark.parametrize("make", [line, clumps, huge])
def test_200_000_degenerate_points(make: object) -> None:
    start = time.process_time()
    run(make(200_000))  # type: ignore[operator]
    assert time.process_time() - start < 10


def test_points_at_the_same_place_share_their_fate() -> None:
    xyz = surface(800)
    twice = run(np.concatenate([xyz, xyz]))
    np.testing.assert_array_equal(twice.keep[:800], twice.keep[800:])
    np.testing.assert_array_equal(twice.keep[:800], run(xyz).keep)


@pytest.mark.parametrize("method", METHODS)
@given(seed=st.integers(0, 2**31))
@settings(max_examples=5, deadline=None)
def test_order_of_the_points_does_not_matter(method: str, seed: int) -> None:
    xyz = surface(700)
    order = np.random.default_rng(seed).permutation(700)
    straight, shuffled = run(xyz, method), run(xyz[order], method)
    np.testing.assert_array_equal(straight.keep[order], shuffled.keep)
    np.testing.assert_array_equal(straight.score[order], shuffled.score)


@pytest.mark.parametrize("method", METHODS)
@given(seed=st.integers(0, 2**31))
@settings(max_examples=5, deadline=None)
def test_rigid_motion_and_scale_hardly_matter(method: str, seed: int) -> None:
    """Masks may differ only where the score is within rounding of the threshold."""
    rng = np.random.default_rng(seed)
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    xyz = surface(1500).astype(float)
    moved = (xyz @ (q * np.sign(np.diag(r))).T + rng.uniform(-1, 1, 3)) * 10 ** rng.uniform(-2, 2)
    assert (run(xyz, method).keep != run(moved, method).keep).sum() <= 4


def test_arguments_are_not_changed() -> None:
    voxels = bare_cloud(surface(300))
    before = voxels.xyz.copy()
    filters.apply(voxels, FilterConfig())
    np.testing.assert_array_equal(voxels.xyz, before)


def test_same_bytes_for_any_number_of_threads() -> None:
    code = (
        "import hashlib, os, numpy as np\nos.cpu_count = lambda: int(os.environ['THREADS'])\nfrom"
        " stereo_ore.stages import filters\nfrom stereo_ore.lab.bench.labelled import"
        " bare_cloud\nfrom stereo_ore.config import FilterConfig\nx ="
        " np.random.default_rng(0).normal(size=(20000, 3)) * [1, 1, 0.02]\nr ="
        " [filters.apply(bare_cloud(x), FilterConfig(method=m)).score.tobytes() for m in"
        " ('adaptive', 'paper')]\nprint(hashlib.sha256(b''.join(r)).hexdigest())"
    )
    digests = set()
    for threads in ("1", "4"):
        env = os.environ | dict.fromkeys(
            ("THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), threads
        )
        digests.add(
            subprocess.run(
                [sys.executable, "-c", code], env=env, check=True, capture_output=True
            ).stdout
        )
    assert len(digests) == 1


def test_own_lof_is_the_one_of_scikit_learn() -> None:
    from sklearn.neighbors import LocalOutlierFactor

    xyz = surface(600)
    theirs = -LocalOutlierFactor(20).fit(xyz).negative_outlier_factor_
    np.testing.assert_allclose(run(xyz, "lof", k=20).score, theirs, rtol=1e-4)


def test_statistical_agrees_with_open3d() -> None:
    """Open3D counts the point itself among the K."""
    import open3d as o3d

    xyz = surface(1500).astype(float)
    kept = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(xyz)).remove_statistical_outlier(
        21, 1.0
    )[1]
    ours = np.flatnonzero(run(xyz, "statistical", k=20).keep)
    assert len(set(kept) ^ set(ours)) < 15


def test_radius_is_a_count_within_a_radius() -> None:
    xyz = surface(400).astype(float)
    distance = np.linalg.norm(xyz[:, None] - xyz, axis=2)
    counted = (distance <= 0.02).sum(1) - 1
    np.testing.assert_array_equal(run(xyz, "radius", n=6, radius_m=0.02).keep, counted >= 6)


def test_none_keeps_all() -> None:
    xyz, _ = synth.paper_cloud(0)
    assert run(xyz, "none").keep.all()


@given(
    seed=st.integers(0, 2**31),
    scale=st.sampled_from([1e-12, 1.0, 1e25]),
    queries=st.integers(1, 40),
)
@settings(max_examples=20, deadline=None)
def test_nearest_are_those_of_brute_force_with_and_without_flann(
    seed: int, scale: float, queries: int
) -> None:
    rng = np.random.default_rng(seed)
    points = (rng.normal(size=(90, 3)) * scale).astype(np.float32)
    at = (rng.normal(size=(queries, 3)) * scale).astype(np.float32)
    every = np.linalg.norm(at[:, None].astype(float) - points, axis=2)
    for found in (nearest(points, at, 7), _without_flann(points, at, 7)):
        np.testing.assert_array_equal(found[0], np.argsort(every, axis=1)[:, :7])
        np.testing.assert_allclose(found[1], np.sort(every, axis=1)[:, :7], rtol=1e-5)


def _without_flann(points: np.ndarray, at: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
    with pytest.MonkeyPatch.context() as patch:
        patch.delattr("cv2.flann_Index", raising=False)
        return nearest(points, at, k)


@given(seed=st.integers(0, 2**31), steps=st.sampled_from([2, 30, 10**6]))
@settings(max_examples=20, deadline=None)
def test_prepared_points_are_distinct_and_sorted_within_their_cell(seed: int, steps: int) -> None:
    xyz = (np.random.default_rng(seed).integers(-steps, steps, (600, 3)) * 0.001).astype(np.float32)
    points = filters.prepared(bare_cloud(xyz))[0].xyz
    cell = filters._coarse_cell(xyz)
    order = np.lexsort((*xyz.T[::-1], cell))
    expected = [tuple(p) for p in xyz[order].tolist()]
    assert [tuple(p) for p in points.tolist()] == list(dict.fromkeys(expected))


def test_help_and_parameters_name_every_method() -> None:
    told = FilterConfig.model_fields["method"].description
    help_text = (Path(filter_command.__file__)).read_text(encoding="utf-8")
    for method in filters.METHODS:
        assert re.search(rf"(^|[ ,]){method}([ ,.]|$)", told or "", re.MULTILINE), method
        assert re.search(rf'help="[^"]*\b{method}\b', help_text), method
