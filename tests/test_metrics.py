"""Metrics against plain loops over their definitions."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from stereo_ore.lab import metrics

MASKS = st.integers(1, 40).flatmap(
    lambda n: st.tuples(arrays.arrays(bool, n), arrays.arrays(bool, n))
)


@given(MASKS)
@settings(deadline=None)
def test_filter_quality_is_equation_7(masks: tuple[np.ndarray, np.ndarray]) -> None:
    noise, removed = masks
    tp = sum(a and b for a, b in zip(noise, removed, strict=True))
    fp = sum(not a and b for a, b in zip(noise, removed, strict=True))
    fn = sum(a and not b for a, b in zip(noise, removed, strict=True))
    tn = sum(not a and not b for a, b in zip(noise, removed, strict=True))
    quality = metrics.filter_quality(noise, removed)
    assert quality.precision == pytest.approx(tp / (tp + fp) if tp + fp else 0)
    assert quality.recall == pytest.approx(tp / (tp + fn) if tp + fn else 0)
    assert quality.retention == pytest.approx(tn / (tn + fp) if tn + fp else 0)
    assert quality.f1 == pytest.approx(2 * tp / (2 * tp + fp + fn) if tp else 0)


def test_filter_quality_refuses_masks_of_different_length() -> None:
    with pytest.raises(ValueError, match=r"\(3,\).*\(4,\)"):
        metrics.filter_quality(np.ones(3, bool), np.ones(4, bool))


def test_noise_is_what_no_true_surface_lies_near() -> None:
    K, focal_baseline = np.array([[50.0, 0, 16], [0, 50, 12], [0, 0, 1]]), 6.0
    rng = np.random.default_rng(0)
    truth = rng.uniform(5, 12, (24, 32)) * (rng.random((24, 32)) > 0.4)
    u, v, d = rng.uniform(-3, 35, 300), rng.uniform(-3, 27, 300), rng.uniform(3, 14, 300)
    z = focal_baseline / d
    xyz = np.stack([(u - 16) / 50 * z, (v - 12) / 50 * z, z], 1)
    expected = []
    for ui, vi, di in zip(np.rint(u).astype(int), np.rint(v).astype(int), d, strict=True):
        window = truth[max(vi - 2, 0) : max(vi + 3, 0), max(ui - 2, 0) : max(ui + 3, 0)]
        expected.append(not ((window > 0) & (np.abs(window - di) <= 1)).any())
    assert metrics.is_noise(xyz, truth, K, focal_baseline).tolist() == expected
    assert 0 < np.mean(expected) < 1


def test_disparity_quality_counts_missing_as_bad() -> None:
    disparity = np.array([[10.0, np.nan, 12.5, 10.2, 99.0]], np.float32)
    quality = metrics.disparity_quality(
        disparity, np.full((1, 5), 10.0), np.array([[True, True, True, True, False]])
    )
    assert (quality.valid, quality.bad1) == (0.75, 0.5)
    assert quality.median_px == pytest.approx(0.2, abs=1e-5)


def test_disparity_quality_of_nothing_is_nan() -> None:
    quality = metrics.disparity_quality(
        np.zeros((2, 2), np.float32), np.zeros((2, 2)), np.zeros((2, 2), bool)
    )
    assert np.isnan([quality.valid, quality.bad1, quality.median_px]).all()


@given(
    arrays.arrays(np.int32, (6, 7), elements=st.integers(0, 4)),
    arrays.arrays(np.int32, (6, 7), elements=st.integers(0, 5)),
)
@settings(deadline=None)
def test_iou_matrix_counts_pixels(truth: np.ndarray, found: np.ndarray) -> None:
    truth_ids, found_ids = [2, 3, 4], [1, 3, 5]
    iou = metrics.iou_matrix(truth, found, truth_ids, found_ids)
    for a, t in enumerate(truth_ids):
        for b, f in enumerate(found_ids):
            union = ((truth == t) | (found == f)).sum()
            assert iou[a, b] == pytest.approx(((truth == t) & (found == f)).sum() / max(union, 1))


def test_iou_matrix_without_labels_is_empty() -> None:
    assert metrics.iou_matrix(np.zeros((2, 2), int), np.ones((2, 2), int), [], [1]).shape == (0, 1)


def test_best_pairs_prefer_the_greatest_sum_to_the_greatest_single() -> None:
    assert metrics.best_pairs(np.array([[0.9, 0.8], [0.8, 0.1]])) == [(0, 1), (1, 0)]


def test_split_along_a_normal() -> None:
    assert metrics.split_along(np.array([3.0, 4.0, -2.0]), np.array([0.0, 0, 1])) == (5.0, 2.0)


def test_strike_on_a_plane() -> None:
    x, y = np.meshgrid(np.linspace(-0.2, 0.2, 41), np.linspace(-0.2, 0.2, 41))
    plane = np.stack([x.ravel(), y.ravel(), 1.0 + 0.0 * x.ravel()], 1)
    tilted = np.array([0.0, np.sin(0.3), np.cos(0.3)])
    distance, angle = metrics.surface_distance_and_angle(np.array([0.0, 0, 0.95]), tilted, plane)
    assert distance == pytest.approx(0.05)
    assert angle == pytest.approx(0.3)
