"""Rigid transforms: laws that hold for every rotation and translation."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stereo_ore import transforms

seeds = st.integers(0, 10_000)


def rigid(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = Rotation.random(rng=rng).as_matrix()
    T[:3, 3] = rng.normal(size=3)
    return T


@given(seeds)
@settings(deadline=None)
def test_inverse_undoes(seed: int) -> None:
    T, points = rigid(seed), np.random.default_rng(seed).normal(size=(5, 3))
    np.testing.assert_allclose(
        transforms.transform_points(transforms.inverse(T), transforms.transform_points(T, points)),
        points,
        atol=1e-12,
    )


@given(seeds)
@settings(deadline=None)
def test_apply_is_homogeneous_multiplication(seed: int) -> None:
    T, point = rigid(seed), np.array([0.3, -1.0, 2.0])
    np.testing.assert_allclose(
        transforms.transform_points(T, point), (T @ [*point, 1])[:3], atol=1e-12
    )


def test_a_direction_is_not_translated() -> None:
    T = np.eye(4)
    T[:3, 3] = [1, 2, 3]
    np.testing.assert_array_equal(transforms.rotate(T, [0, 0, 1]), [0, 0, 1])


@given(seeds)
@settings(deadline=None)
def test_frame_from_normal_is_a_rotation_with_that_normal(seed: int) -> None:
    normal = rigid(seed)[:3, 2]
    axes = transforms.frame_from_normal(normal, rigid(seed + 1)[:3, 0])
    assert transforms.rotation_fault(axes) is None
    np.testing.assert_allclose(axes[2], normal)


@pytest.mark.parametrize(
    ("matrix", "fault"),
    [
        (np.diag([1.0, 1, -1]), "reflection"),
        (2 * np.eye(3), "not orthonormal"),
        (np.full((3, 3), np.nan), "not finite"),
    ],
)
def test_what_is_no_rotation_is_named(matrix: np.ndarray, fault: str) -> None:
    assert fault in str(transforms.rotation_fault(matrix))
