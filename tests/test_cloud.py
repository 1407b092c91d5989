"""Reprojection against exact planes; surfaces hold what was kept."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereo_ore.config import CloudConfig
from stereo_ore.stages.cloud import nearest_beyond, reproject, surface
from stereo_ore.types import Disparity, RectifiedPair, Region, Rig, Volume

SIGMA = 0.2


def whole(rig: Rig) -> Region:
    return Region(0, 0, rig.width, rig.height, 0, 64)


def certain(values: np.ndarray, region: Region) -> Disparity:
    return Disparity(values, region, np.ones_like(values))


def box(low: list[float], high: list[float]) -> Volume:
    return Volume(np.eye(4), np.array(low), np.array(high))


def test_points_lie_on_the_plane_that_made_the_disparities(flat_plane_pair) -> None:
    pair = flat_plane_pair.pair
    cloud = reproject(
        certain(flat_plane_pair.disparity, whole(pair.rig)), pair, None, CloudConfig(), SIGMA
    )
    assert len(cloud) == flat_plane_pair.disparity.size
    np.testing.assert_allclose(
        cloud.xyz @ flat_plane_pair.normal, flat_plane_pair.offset, atol=1e-5
    )
    np.testing.assert_array_equal(cloud.bgr, pair.left.reshape(-1, 3))
    np.testing.assert_allclose(
        cloud.sigma_z, pair.rig.depth_sigma(cloud.xyz[:, 2], SIGMA), rtol=1e-5
    )


def test_doffs_enters_the_depth() -> None:
    rig = Rig(4, 3, 100.0, 100.0, 2.0, 1.0, 0.1, doffs_px=5.0)
    image = np.zeros((3, 4, 3), np.uint8)
    values = np.full((3, 4), -4.0, np.float32)
    cloud = reproject(
        certain(values, whole(rig)), RectifiedPair(image, image, rig), None, CloudConfig(), SIGMA
    )
    np.testing.assert_allclose(cloud.xyz[:, 2], 10.0)


@given(
    st.lists(st.sampled_from([np.nan, -3.0, 0.0, 1e-3, 0.6, 5.0, 60.0]), min_size=12, max_size=12)
)
@settings(deadline=None)
def test_only_pixels_with_a_finite_positive_depth_in_range_become_points(
    disparities: list[float],
) -> None:
    rig = Rig(4, 3, 100.0, 100.0, 2.0, 1.0, 0.1)
    values = np.array(disparities, np.float32).reshape(3, 4)
    image = np.arange(36, dtype=np.uint8).reshape(3, 4, 3)
    cloud = reproject(
        certain(values, whole(rig)), RectifiedPair(image, image, rig), None, CloudConfig(), SIGMA
    )
    expected = [i for i, d in enumerate(disparities) if d > 0 and 10 / np.float32(d) <= 20]
    assert cloud.pixel.tolist() == expected
    assert np.isfinite(cloud.xyz).all()
    np.testing.assert_allclose(rig.project(cloud.xyz)[:, 0], cloud.pixel % 4, atol=1e-4)
    np.testing.assert_allclose(rig.project(cloud.xyz)[:, 1], cloud.pixel // 4, atol=1e-4)


def test_the_volume_crops_in_its_own_frame(flat_plane_pair) -> None:
    pair = flat_plane_pair.pair
    angle = 0.3
    T = np.eye(4)
    T[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    T[:3, 3] = [0.1, -0.2, 0.05]
    volume = Volume(T, np.array([-0.2, -0.3, 0.0]), np.array([0.3, 0.2, 9.0]))
    disparity = certain(flat_plane_pair.disparity, whole(pair.rig))
    everything = reproject(disparity, pair, None, CloudConfig(), SIGMA)
    cropped = reproject(disparity, pair, volume, CloudConfig(), SIGMA)
    q = everything.xyz.astype(float) @ T[:3, :3].T + T[:3, 3]
    clear = np.abs(np.concatenate([q - volume.min_m, volume.max_m - q], 1)).min(1) > 1e-5
    inside = ((q >= volume.min_m) & (q <= volume.max_m)).all(1)
    assert 1000 < len(cropped) < len(everything)
    kept = np.isin(everything.pixel, cropped.pixel)
    np.testing.assert_array_equal(kept[clear], inside[clear])


def test_a_volume_without_points_gives_an_empty_cloud(flat_plane_pair) -> None:
    pair = flat_plane_pair.pair
    disparity = certain(flat_plane_pair.disparity, whole(pair.rig))
    cloud = reproject(disparity, pair, box([5, 5, 5], [6, 6, 6]), CloudConfig(), SIGMA)
    assert len(cloud) == 0
    assert np.isnan(surface(cloud, np.zeros(0, bool), pair, disparity.region).xyz).all()


def test_a_surface_is_the_kept_points_in_their_pixels(flat_plane_pair) -> None:
    pair = flat_plane_pair.pair
    region = Region(40, 20, 200, 120, 0, 64)
    cloud = reproject(certain(flat_plane_pair.disparity, region), pair, None, CloudConfig(), SIGMA)
    keep = np.random.default_rng(1).random(len(cloud)) < 0.5
    laid = surface(cloud, keep, pair, region)
    assert (laid.x0, laid.y0, laid.xyz.shape) == (40, 20, (100, 160, 3))
    mask = keep.reshape(100, 160)
    np.testing.assert_array_equal(np.isfinite(laid.xyz[..., 2]), mask)
    np.testing.assert_array_equal(np.isfinite(laid.sigma_z), mask)
    i, j = 33, 71
    if mask[i, j]:
        np.testing.assert_allclose(pair.rig.project(laid.xyz[i, j]), [40 + j, 20 + i], atol=1e-3)
    np.testing.assert_array_equal(laid.bgr, pair.left[region.slices])
    assert not np.shares_memory(laid.bgr, pair.left)


def test_what_the_depth_limit_alone_keeps_out_is_told(flat_plane_pair) -> None:
    pair, config = flat_plane_pair.pair, CloudConfig(max_depth_m=0.5)
    disparity = certain(flat_plane_pair.disparity, whole(pair.rig))
    depths = pair.rig.depth(flat_plane_pair.disparity)
    assert not len(reproject(disparity, pair, None, config, SIGMA))
    assert nearest_beyond(disparity, pair, None, config) == pytest.approx(depths.min(), rel=1e-6)
    away = box([-9, -9, 50], [9, 9, 60])
    assert nearest_beyond(disparity, pair, away, config) is None


@pytest.mark.parametrize("depth", [0.5, 3.0])
def test_max_depth_is_a_limit(depth: float, flat_plane_pair) -> None:
    pair = flat_plane_pair.pair
    disparity = certain(flat_plane_pair.disparity, whole(pair.rig))
    cloud = reproject(disparity, pair, None, CloudConfig(max_depth_m=depth), SIGMA)
    assert len(cloud) == (flat_plane_pair.depth <= depth).sum()
