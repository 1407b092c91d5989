"""The published filter against plain loops over its printed equations."""

import math

import numpy as np
import pytest

from stereo_ore.config import FilterConfig
from stereo_ore.config.filters import PaperParams
from stereo_ore.lab import synth
from stereo_ore.lab.bench.labelled import bare_cloud
from stereo_ore.lab.metrics import filter_quality
from stereo_ore.stages import filters
from stereo_ore.stages.filters.paper import quantities, two_clusters


def cloud(points: int = 90) -> np.ndarray:
    rng = np.random.default_rng(3)
    plane = np.column_stack([rng.uniform(0, 0.1, (points - 12, 2)), np.zeros(points - 12)])
    return np.concatenate([plane, rng.uniform(0, 0.1, (12, 3))]).astype(np.float32)


class PlainLoops:
    """Equations 1 to 6, a point and a neighbour at a time, in double precision."""

    def __init__(self, xyz: np.ndarray, p: PaperParams) -> None:
        n = len(xyz)
        x = xyz.astype(float)
        self.order, self.d = [], []
        for i in range(n):
            distances = [math.dist(x[i], x[j]) for j in range(n)]
            near = sorted((j for j in range(n) if j != i), key=lambda j: distances[j])
            self.order.append(near)
            self.d.append([distances[j] for j in near])
        self.rho = [self.density(i, p.k0) for i in range(n)]
        noise_centre, kept_centre = np.quantile(self.rho, p.centres)
        for _ in range(100):
            self.noise = [abs(r - noise_centre) < abs(r - kept_centre) for r in self.rho]
            low = [r for r, is_noise in zip(self.rho, self.noise, strict=True) if is_noise]
            high = [r for r, is_noise in zip(self.rho, self.noise, strict=True) if not is_noise]
            noise_centre, kept_centre = sum(low) / len(low), sum(high) / len(high)
        self.mu = [
            sum(low) / len(low) if is_noise else sum(high) / len(high) for is_noise in self.noise
        ]
        self.k_sigma = p.k_sigma or max(p.k_grid, key=self.mean_sigma)
        unclamped = [
            math.floor(p.alpha * m / r + p.beta * self.k_sigma)
            for m, r in zip(self.mu, self.rho, strict=True)
        ]
        self.k = [min(max(k, p.k_min), p.k_max) for k in unclamped]
        entering = (
            self.rho if p.density_at == "k0" else [self.density(i, self.k[i]) for i in range(n)]
        )
        self.lof = [
            sum(entering[j] for j in self.order[i][: self.k[i]]) / self.k[i] / entering[i]
            for i in range(n)
        ]

    def density(self, i: int, k: int) -> float:
        return 1 / (sum(self.d[i][:k]) / k)

    def mean_sigma(self, k: int) -> float:
        rho = [self.density(i, k) for i in range(len(self.d))]
        sigma = [
            math.sqrt(sum((rho[j] - rho[i]) ** 2 for j in self.order[i][:k]) / k)
            for i in range(len(self.d))
        ]
        return sum(sigma) / len(sigma)


@pytest.mark.parametrize(
    "params",
    [
        PaperParams(),
        PaperParams(k0=6, alpha=3.5, beta=0.7, k_grid=(4, 8, 12), centres=(0.2, 0.8)),
        PaperParams(density_at="k_i", k_sigma=7, alpha=4.0, k_min=5, k_max=12),
    ],
)
def test_all_quantities_match_plain_loops_over_the_printed_equations(params: PaperParams) -> None:
    xyz = cloud()
    mine, plain = quantities(xyz, params), PlainLoops(xyz, params)
    np.testing.assert_allclose(mine.rho, plain.rho, rtol=1e-5)
    np.testing.assert_array_equal(mine.in_noise_cluster, plain.noise)
    np.testing.assert_allclose(mine.mu, plain.mu, rtol=1e-5)
    assert mine.k_sigma == plain.k_sigma
    np.testing.assert_array_equal(mine.k, plain.k)
    np.testing.assert_allclose(mine.lof, plain.lof, rtol=1e-5)


def test_decision_is_lof_above_r() -> None:
    xyz = cloud()
    result = filters.apply(bare_cloud(xyz), FilterConfig(method="paper"))
    np.testing.assert_array_equal(result.keep, np.array(PlainLoops(xyz, PaperParams()).lof) <= 1.0)


def test_the_printed_threshold_removes_about_half_of_the_good_points() -> None:
    xyz, noise = synth.paper_cloud(3)
    result = filters.apply(bare_cloud(xyz), FilterConfig(method="paper"))
    assert 0.3 < filter_quality(noise, ~result.keep).retention < 0.65


def test_mask_stays_under_scaling_by_powers_of_two() -> None:
    xyz = cloud(200)
    masks = [
        filters.apply(bare_cloud(xyz * scale), FilterConfig(method="paper")).keep
        for scale in (1, 1024, 0.125)
    ]
    np.testing.assert_array_equal(masks[0], masks[1])
    np.testing.assert_array_equal(masks[0], masks[2])


def test_two_clusters_split_at_the_gap_and_survive_one_value() -> None:
    values = np.array([1, 1.1, 0.9, 9, 9.2, 8.7], np.float32)
    np.testing.assert_array_equal(
        two_clusters(values, (0.0, 10.0)), [True, True, True, False, False, False]
    )
    assert not two_clusters(np.ones(5, np.float32), (1.0, 1.0)).any()


def test_clamped_k_is_counted() -> None:
    params = {"k_max": 4, "k_min": 4}
    result = filters.apply(bare_cloud(cloud()), FilterConfig(method="paper", params=params))
    assert result.diagnostics["k_clamped"] > 80
    assert result.diagnostics["k_mean"] == 4
