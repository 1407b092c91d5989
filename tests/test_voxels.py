"""The voxel grid against plain loops: anchored, sorted, reversible."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereo_ore.config import VoxelConfig
from stereo_ore.errors import CloudError
from stereo_ore.stages.voxels import voxel_size, voxelise
from stereo_ore.types import Disparity, PointCloud, Region, Rig, Volume

RIG = Rig(64, 48, 50.0, 50.0, 32.0, 24.0, 0.12)
REGION = Region(0, 0, 64, 48, 0, 16)


def cloud_of(xyz: np.ndarray) -> PointCloud:
    n = len(xyz)
    return PointCloud(
        xyz.astype(np.float32), np.arange(n, dtype=np.int32), np.zeros((n, 3), np.uint8),
        np.linspace(0.01, 0.02, n, dtype=np.float32), (48, 64),
    )  # fmt: skip


def disparity_with(texture: np.ndarray) -> Disparity:
    cue = np.zeros((48, 64), np.float32)
    cue.ravel()[: len(texture)] = texture
    return Disparity(
        np.ones((48, 64), np.float32), REGION, np.ones((48, 64), np.float32), {"texture": cue}
    )


def random_points(seed: int, n: int = 500) -> np.ndarray:
    return np.random.default_rng(seed).uniform([-0.3, -0.2, 0.8], [0.3, 0.2, 1.0], (n, 3))


@given(
    st.integers(0, 50), st.sampled_from([0.004, 0.02, 0.1, 2.0]), st.sampled_from([0, 1, 7, 400])
)
@settings(deadline=None, max_examples=40)
def test_voxels_are_what_a_dictionary_of_cells_gives(seed: int, size: float, n: int) -> None:
    cloud = cloud_of(random_points(seed, n))
    texture = np.random.default_rng(seed).random(n).astype(np.float32)
    grid = voxelise(cloud, disparity_with(texture), RIG, size)
    cells: dict[tuple[int, ...], list[int]] = {}
    for i, p in enumerate(cloud.xyz):
        cells.setdefault(tuple(np.floor(p / np.float64(size)).astype(int)), []).append(i)
    members = [cells[key] for key in sorted(cells)]
    assert grid.count.tolist() == [len(m) for m in members]
    assert grid.inverse.dtype == np.int32
    for voxel, m in enumerate(members):
        assert (grid.inverse[m] == voxel).all()
        np.testing.assert_allclose(grid.xyz[voxel], cloud.xyz[m].mean(0), rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(grid.sigma_z[voxel], cloud.sigma_z[m].mean(), rtol=1e-5)
        np.testing.assert_allclose(
            grid.cues["texture"][voxel], texture[m].mean(), rtol=1e-4, atol=1e-6
        )
    np.testing.assert_allclose(grid.pixel_m, grid.xyz[:, 2] / RIG.fx, rtol=1e-6)


@given(st.integers(0, 1000))
@settings(deadline=None, max_examples=20)
def test_the_order_of_the_points_does_not_matter(seed: int) -> None:
    xyz = random_points(1)
    order = np.random.default_rng(seed).permutation(len(xyz))
    a, b = (
        voxelise(cloud_of(p), disparity_with(np.zeros(0)), RIG, 0.03) for p in (xyz, xyz[order])
    )
    np.testing.assert_allclose(a.xyz, b.xyz, rtol=1e-6)
    np.testing.assert_array_equal(a.inverse[order], b.inverse)


def test_the_grid_is_anchored_so_a_far_point_regrids_nothing() -> None:
    xyz = random_points(2)
    a = voxelise(cloud_of(xyz), disparity_with(np.zeros(0)), RIG, 0.02)
    b = voxelise(
        cloud_of(np.vstack([xyz, [-5.003, -4.001, 19.0]])), disparity_with(np.zeros(0)), RIG, 0.02
    )
    assert len(b) == len(a) + 1
    np.testing.assert_array_equal(a.xyz, b.xyz[1:])


def test_duplicates_share_a_voxel() -> None:
    grid = voxelise(
        cloud_of(np.tile([[0.1, 0.2, 1.0]], (300, 1))), disparity_with(np.zeros(0)), RIG, 0.01
    )
    assert grid.count.tolist() == [300]


def test_voxels_too_small_to_number_are_refused() -> None:
    xyz = np.array([[-1e3, -1e3, 0.1], [1e3, 1e3, 1e3]])
    with pytest.raises(CloudError, match=r"voxel\.size_m"):
        voxelise(cloud_of(xyz), disparity_with(np.zeros(0)), RIG, 1e-5)


def test_the_automatic_size_follows_the_middle_depth_in_steps() -> None:
    near, far = (cloud_of(random_points(3) * s) for s in (1.0, 2.0))
    sizes = [voxel_size(VoxelConfig(pixels=2.4), RIG, None, c) for c in (near, far)]
    assert sizes[1] == pytest.approx(2 * sizes[0], rel=0.02)
    assert sizes[0] == pytest.approx(2.4 * np.median(near.xyz[:, 2]) / RIG.fx, abs=0.0003)
    assert sizes[0] == pytest.approx(round(sizes[0] / 0.0005) * 0.0005)
    shaken = replace(near, xyz=(near.xyz * np.float32(1.0005)))
    assert voxel_size(VoxelConfig(pixels=2.4), RIG, None, shaken) == sizes[0]


def test_sizes_without_points_and_given_sizes() -> None:
    volume = Volume(np.eye(4), np.array([-1.0, -1.0, 1.0]), np.array([1.0, 1.0, 3.0]))
    assert voxel_size(VoxelConfig(size_m=0.007), RIG, volume, cloud_of(np.zeros((0, 3)))) == 0.007
    assert voxel_size(VoxelConfig(), RIG, volume, cloud_of(np.zeros((0, 3)))) == pytest.approx(
        VoxelConfig().pixels * 2.0 / 50, abs=3e-4
    )
    assert voxel_size(VoxelConfig(), RIG, None, cloud_of(np.zeros((0, 3)))) > 0
