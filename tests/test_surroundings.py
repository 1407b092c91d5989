"""What lies around a voxel in the image."""

import dataclasses

import numpy as np
import pytest

from stereo_ore.stages.surroundings import look_around
from stereo_ore.types import CONTEXT, CUES, Disparity, RectifiedPair, Region, Rig, VoxelCloud

RIG = Rig(200, 120, 100.0, 100.0, 100.0, 60.0, 0.1)
REGION = Region(8, 4, 200, 120, 0, 64)


def world(step: float = 0.0) -> tuple[VoxelCloud, Disparity, RectifiedPair]:
    """A wall at 20 px of disparity, nearer by `step` to the right of column 100, and a voxel each 4
    px."""
    values = np.full((120, 200), 20, np.float32)
    values[:, 100:] += step
    cues = {name: np.full((116, 192), 0.5, np.float32) for name in CUES}
    image = np.full((120, 200, 3), 90, np.uint8)
    v, u = (a.ravel() for a in np.mgrid[10:116:4, 12:196:4])
    z = (RIG.fx * RIG.baseline_m / values[v, u]).astype(np.float32)
    xyz = RIG.back_project(u, v, z).astype(np.float32)
    one = np.ones(len(u), np.float32)
    voxels = VoxelCloud(
        xyz, one.astype(np.int32), np.arange(len(u), dtype=np.int32), 0.01, one, one
    )
    return (
        voxels,
        Disparity(values, REGION, np.ones_like(values), cues),
        RectifiedPair(image, image, RIG),
    )


def test_all_context_is_there_and_a_wall_has_none() -> None:
    cues = look_around(*world()).cues
    assert set(cues) == set(CONTEXT)
    np.testing.assert_allclose(cues["known_41"], 1)
    np.testing.assert_allclose(cues["texture_around_15"], 0.5, rtol=1e-5)
    np.testing.assert_allclose(cues["lr_diff_px_known_101"], np.log(0.55), rtol=2e-3)
    np.testing.assert_allclose(cues["confidence_around_15"], 0.5, rtol=1e-5)
    np.testing.assert_allclose(cues["confidence_known_41"], 0, atol=1e-5)
    for name in ("off_15", "nearer_61", "farther_61"):
        np.testing.assert_allclose(cues[name], 0, atol=0.02)
    np.testing.assert_allclose(cues["brightness"], np.log(93), rtol=1e-5)


def test_beside_an_edge_things_lie_nearer_and_farther() -> None:
    voxels, disparity, pair = world(step=6.0)
    cues = look_around(voxels, disparity, pair).cues
    u = RIG.project(voxels.xyz)[:, 0]
    np.testing.assert_allclose(cues["nearer_61"][(u > 82) & (u < 98)], np.log(7), rtol=1e-3)
    np.testing.assert_allclose(cues["nearer_61"][(u < 50) | (u > 104)], 0, atol=1e-3)
    np.testing.assert_allclose(cues["farther_61"][(u > 104) & (u < 118)], np.log(7), rtol=1e-3)
    assert (cues["off_101"][u < 96] <= 0.02).all()
    assert (cues["off_101"][u > 104] >= -0.02).all()


def test_unknown_pixels_do_not_count_in_means_of_known_ones() -> None:
    voxels, disparity, pair = world()
    values = disparity.values.copy()
    values[:, ::2] = np.nan
    cues = {
        name: np.where(np.isfinite(values[REGION.slices]), cue, 9)
        for name, cue in disparity.cues.items()
    }
    found = look_around(voxels, Disparity(values, REGION, np.ones_like(values), cues), pair).cues
    np.testing.assert_allclose(found["known_41"], 0.5, atol=0.06)
    np.testing.assert_allclose(found["spread_px_known_41"], np.log(0.55), rtol=5e-3)
    np.testing.assert_allclose(found["off_41"], 0, atol=0.02)


@pytest.mark.parametrize("lack", ["cues", "voxels"])
def test_nothing_is_added_where_there_is_nothing_to_look_at(lack: str) -> None:
    voxels, disparity, pair = world()
    if lack == "cues":
        disparity = dataclasses.replace(disparity, cues={})
    else:
        none = np.zeros(0, np.float32)
        voxels = VoxelCloud(
            np.zeros((0, 3), np.float32), none.astype(np.int32), voxels.inverse, 0.01, none, none
        )
    assert look_around(voxels, disparity, pair) is voxels
