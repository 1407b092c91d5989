"""Matching against exact disparities: planes, steps, borders, offsets, gains, weak texture,
threads."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereo_ore.config import MatchingConfig
from stereo_ore.errors import ConfigError
from stereo_ore.stages import matching
from stereo_ore.types import CUES, RectifiedPair, Region, Rig, Volume

CONFIG = MatchingConfig()
RIG = Rig(480, 320, 300.0, 300.0, 240.5, 159.0, 0.12)


def whole(rig: Rig, lowest: int = 0, count: int = 64) -> Region:
    return Region(0, 0, rig.width, rig.height, lowest, count)


def texture(height: int, width: int, seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=(height, width))
    mixed = sum(2.0**k * cv2.GaussianBlur(noise, (0, 0), 1.2 * 2.0**k) for k in range(4))
    return np.clip(128 + 40 * mixed / mixed.std(), 0, 255)


def pair_of(
    disparity: np.ndarray, rig: Rig = RIG, noise: float = 0.0, gain: float = 1.0
) -> RectifiedPair:
    """A pair whose left pixels have these disparities, seen where nothing hides them."""
    height, width = disparity.shape
    right = texture(height, width)
    u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    left = cv2.remap(
        right, u - disparity.astype(np.float32), v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
    )
    rng = np.random.default_rng(1)
    eyes = [
        np.clip(g * e + rng.normal(0, noise, e.shape), 0, 255)
        for g, e in ((1.0, left), (gain, right))
    ]
    return RectifiedPair(*(cv2.merge([np.rint(eye).astype(np.uint8)] * 3) for eye in eyes), rig)


def plate_before_wall(near: int, far: int) -> RectifiedPair:
    """A plate of left columns 150 to 330, rows 100 to 220, before a wall; each at its disparity."""
    wall, plate = texture(320, 480, 0), texture(320, 480, 5)
    left, right = np.roll(wall, far, 1), wall.copy()
    left[100:220, 150:330] = plate[100:220, 150:330]
    right[100:220, 150 - near : 330 - near] = plate[100:220, 150:330]
    return RectifiedPair(
        *(cv2.merge([np.rint(eye).astype(np.uint8)] * 3) for eye in (left, right)), RIG
    )


def errors(
    pair: RectifiedPair, truth: np.ndarray, region: Region, config: MatchingConfig = CONFIG
) -> np.ndarray:
    return matching.match(pair, region, config).values - truth


def test_a_tilted_plane_is_matched_to_a_few_hundredths_of_a_pixel(flat_plane_pair) -> None:
    pair = flat_plane_pair.pair
    region = whole(pair.rig)
    error = errors(pair, flat_plane_pair.disparity, region)
    seen = np.arange(pair.rig.width) - flat_plane_pair.disparity > 4
    inner = seen & (np.abs(np.arange(pair.rig.height)[:, None] - 160) < 150)
    assert np.isfinite(error[inner]).mean() > 0.99
    assert np.nanmedian(np.abs(error)) < 0.05
    assert abs(np.nanmedian(error)) < 0.01


@pytest.mark.parametrize("fraction", [0.0, 0.25, 0.5, 0.75])
def test_fractions_of_a_pixel_are_not_pulled_to_whole_ones(fraction: float) -> None:
    truth = np.full((160, 300), 20 + fraction)
    rig = replace(RIG, width=300, height=160)
    error = errors(pair_of(truth, rig, noise=1.0), truth, whole(rig, 0, 48))
    assert abs(np.nanmean(error[:, 40:])) < 0.04  # the parabola alone: 0.13 to 0.2


def test_what_both_eyes_see_is_matched_up_to_the_left_border() -> None:
    truth = np.full((120, 300), 23.0)
    rig = replace(RIG, width=300, height=120)
    found = np.isfinite(errors(pair_of(truth, rig), truth, whole(rig)))
    assert not found[:, :23].any()
    assert found[10:-10, 26:].mean() > 0.97


def test_a_region_is_matched_as_within_the_whole_image() -> None:
    truth = np.full((200, 400), 30.4)
    rig = replace(RIG, width=400, height=200)
    region = Region(100, 40, 300, 160, 21, 16)
    error = errors(pair_of(truth, rig), truth, region)
    inside = np.zeros(error.shape, bool)
    inside[region.slices] = True
    assert not np.isfinite(error[~inside]).any()
    assert np.isfinite(error[inside]).mean() > 0.98
    assert np.nanmax(np.abs(error)) < 0.3


@given(st.integers(-20, 40))
@settings(deadline=None, max_examples=8)
def test_the_smallest_disparity_may_have_either_sign(shift: int) -> None:
    truth = np.full((80, 240), shift + 7.0)
    rig = replace(RIG, width=240, height=80)
    error = errors(pair_of(truth, rig), truth, whole(rig, shift, 16))
    assert np.isfinite(error[10:-10, 70:-70]).mean() > 0.95
    assert np.nanmedian(np.abs(error)) < 0.1


def test_the_calibrations_offset_is_added_once() -> None:
    truth = np.full((80, 240), 12.0)
    rig = replace(RIG, width=240, height=80, disparity_offset_px=1.5)
    assert np.nanmedian(errors(pair_of(truth, rig), truth, whole(rig, 0, 32))) == pytest.approx(
        1.5, abs=0.02
    )


def test_a_brighter_eye_changes_little() -> None:
    truth = np.tile(np.linspace(15, 35, 300), (160, 1))
    rig = replace(RIG, width=300, height=160)
    error = errors(pair_of(truth, rig, noise=1.0, gain=0.85), truth, whole(rig))
    assert np.nanmedian(np.abs(error)) < 0.08
    assert abs(np.nanmedian(error)) < 0.02


def test_what_one_eye_cannot_see_is_not_invented() -> None:
    """A near square before a far wall: the strip beside it that only the left eye sees has no
    disparity."""
    disparity = matching.match(plate_before_wall(40, 10), whole(RIG), CONFIG)
    hidden = disparity.values[110:210, 150 - 30 + 4 : 150 - 4]
    assert np.isfinite(hidden).mean() < 0.35
    np.testing.assert_allclose(np.nanmedian(disparity.values[110:210, 160:320]), 40, atol=0.05)
    np.testing.assert_allclose(np.nanmedian(disparity.values[:90, 100:]), 10, atol=0.05)


def test_flat_grey_gives_no_confident_surface() -> None:
    rng = np.random.default_rng(0)
    eyes = [np.rint(128 + rng.normal(0, 1.0, (200, 300, 3))).astype(np.uint8) for _ in range(2)]
    rig = replace(RIG, width=300, height=200)
    disparity = matching.match(RectifiedPair(*eyes, rig), whole(rig), CONFIG)
    textured = matching.match(pair_of(np.full((200, 300), 20.0), rig), whole(rig), CONFIG)
    assert np.isfinite(disparity.values).mean() < 0.6
    assert disparity.cues["texture"].mean() < 0.2 * textured.cues["texture"].mean()
    assert disparity.cues["valid_share"].mean() < textured.cues["valid_share"].mean()


def test_a_saturated_highlight_has_no_disparity() -> None:
    truth = np.full((200, 300), 20.0)
    rig = replace(RIG, width=300, height=200)
    pair = pair_of(truth, rig)
    left, right = pair.left.copy(), pair.right.copy()
    left[80:130, 150:200] = 255
    right[80:130, 130:180] = 255
    values = matching.match(RectifiedPair(left, right, rig), whole(rig), CONFIG).values
    assert not np.isfinite(values[86:124, 156:194]).any()
    assert np.isfinite(values[20:70, 100:250]).all()


def test_every_cue_is_a_finite_image_and_tells_noise_from_surface(flat_plane_pair) -> None:
    pair = flat_plane_pair.pair
    spoilt = pair.right.copy()
    spoilt[60:260, 100:350] = np.random.default_rng(2).integers(0, 255, (200, 250, 3))
    disparity = matching.match(replace(pair, right=spoilt), whole(pair.rig), CONFIG)
    assert set(disparity.cues) == set(CUES)
    valid = np.isfinite(disparity.values)
    wrong = valid & (np.abs(disparity.values - flat_plane_pair.disparity) > 1)
    right = valid & ~wrong
    assert wrong.sum() > 50
    for name, cue in disparity.cues.items():
        assert np.isfinite(cue[valid]).all(), name
    for name, sign in (
        ("valid_share", -1),
        ("spread_px", 1),
        ("photometric", 1),
        ("median_diff_px", 1),
    ):
        cue = disparity.cues[name]
        assert sign * (cue[wrong].mean() - cue[right].mean()) > 0, name


def test_the_result_does_not_depend_on_threads(flat_plane_pair) -> None:
    pair, results = flat_plane_pair.pair, []
    threads = cv2.getNumThreads()
    try:
        for count in (1, 2, 4):
            cv2.setNumThreads(count)
            results.append(matching.match(pair, whole(pair.rig), CONFIG))
    finally:
        cv2.setNumThreads(threads)
    for other in results[1:]:
        assert other.values.tobytes() == results[0].values.tobytes()
        assert all(
            other.cues[name].tobytes() == cue.tobytes() for name, cue in results[0].cues.items()
        )


@pytest.mark.parametrize("size", [(3, 40), (1, 33), (97, 17)])
def test_tiny_images_are_matched_or_empty_but_never_fail(size: tuple[int, int]) -> None:
    height, width = size
    rig = replace(RIG, width=width, height=height)
    pair = pair_of(np.full(size, 3.0), rig)
    region = matching.narrow(pair, matching.find_region(rig, None, CONFIG), None, CONFIG)
    assert matching.match(pair, region, CONFIG).values.shape == size


def slab(low: float, high: float, half: float = 0.3, x: float = 0.0) -> Volume:
    return Volume(np.eye(4), np.array([x - half, -half, low]), np.array([x + half, half, high]))


@given(
    st.floats(0.0, 1.0),
    st.floats(-0.5, 0.5),
    st.floats(0.3, 2.0),
    st.floats(0.05, 0.4),
    st.floats(-0.6, 0.6),
    st.floats(-80.0, 80.0),
    st.floats(-40.0, 40.0),
)
@settings(deadline=None, max_examples=60)
def test_all_of_the_volume_that_is_in_view_is_in_the_region(
    tilt: float, roll: float, distance: float, half: float, x: float, doffs: float, offset: float
) -> None:
    """Whatever is added to its disparities before they are depths."""
    rig = replace(RIG, doffs_px=doffs, disparity_offset_px=offset)
    R = cv2.Rodrigues(np.array([tilt, roll, 0.0]))[0]
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, -R @ [x, 0.0, distance]
    volume = Volume(T, np.array([-half, -half, -0.1]), np.array([half, half, 0.2]))
    grid = np.random.default_rng(0).uniform(volume.min_m, volume.max_m, (4000, 3))
    points = (grid - T[:3, 3]) @ R
    uv, d = rig.project(points), rig.disparity(points[:, 2]) - offset  # as it is measured
    reach = 96 + max(0.0, -doffs - offset)
    seen = (uv >= 0).all(1) & (uv <= [RIG.width - 1, RIG.height - 1]).all(1) & (d < reach)
    if not seen.any():
        return
    region = matching.find_region(rig, volume, CONFIG)
    assert (uv[seen] >= [region.x0, region.y0]).all()
    assert (uv[seen] <= [region.x1, region.y1]).all()
    assert region.min_disparity <= d[seen].min()
    assert d[seen].max() <= region.min_disparity + region.num_disparities
    assert region.num_disparities % 16 == 0
    assert 0 <= region.x0 < region.x1 <= RIG.width
    assert 0 <= region.y0 < region.y1 <= RIG.height


def test_a_region_is_no_larger_than_needed() -> None:
    region = matching.find_region(RIG, slab(1.0, 1.2), CONFIG)
    assert region.min_disparity == int(RIG.disparity(1.2)) - 2
    assert region.num_disparities == 16
    assert region.x1 - region.x0 < 0.6 * 300 / 1.0 + 2 * 8 + 2
    disparity = matching.match(pair_of(np.full((320, 480), 33.0)), region, CONFIG)
    assert disparity.diagnostics["saved_share"] > 0.9


def test_a_volume_around_the_camera_is_cut_at_the_nearest_searched_disparity() -> None:
    region = matching.find_region(RIG, slab(-1.0, 2.0, 1.0), CONFIG)
    assert (region.x0, region.y0, region.x1, region.y1) == (0, 0, 480, 320)
    assert region.num_disparities <= 112


@pytest.mark.parametrize(
    "volume", [slab(-2.0, -1.0), slab(1.0, 1.2, 0.1, 5.0)], ids=["behind", "beside"]
)
def test_a_volume_out_of_view_is_refused(volume: Volume) -> None:
    with pytest.raises(ConfigError, match="working_volume"):
        matching.find_region(RIG, volume, CONFIG)


def test_a_volume_nearer_than_the_search_is_told_as_such() -> None:
    with pytest.raises(ConfigError, match=r"in view, but nearer than the 0\.375 m that 96 disp"):
        matching.find_region(RIG, slab(0.1, 0.25, 0.02), CONFIG)
    given = MatchingConfig(num_disparities=256)
    region = matching.find_region(RIG, slab(0.15, 0.25, 0.02), given)
    assert region.min_disparity + region.num_disparities > RIG.disparity(0.15)


def test_without_a_volume_the_whole_image_and_a_fifth_of_its_width_are_searched() -> None:
    assert matching.find_region(RIG, None, CONFIG) == Region(0, 0, 480, 320, 0, 96)
    assert (
        matching.find_region(RIG, slab(1, 2), MatchingConfig(use_region=False)).num_disparities
        == 96
    )
    given = MatchingConfig(min_disparity=5, num_disparities=40)
    assert matching.find_region(RIG, slab(1, 2), given).min_disparity == 5
    assert matching.find_region(RIG, slab(1, 2), given).num_disparities == 48


def test_narrowing_keeps_what_the_frame_shows(flat_plane_pair) -> None:
    pair, truth = flat_plane_pair.pair, flat_plane_pair.disparity
    region = matching.narrow(pair, whole(RIG, 0, 128), None, CONFIG)
    assert region.min_disparity <= truth.min() + 1
    assert region.min_disparity + region.num_disparities > truth.max()
    assert region.num_disparities < 96
    assert matching.narrow(pair, whole(RIG, 0, 32), None, CONFIG) == whole(RIG, 0, 32)
    off = MatchingConfig(narrow=False)
    assert matching.narrow(pair, whole(RIG), None, off) == whole(RIG)


def test_narrowing_looks_behind_the_volume_and_no_wider_than_it() -> None:
    """A plate inside the volume before a wall behind it: the wall's disparity is searched, not all
    of its pixels."""
    volume = slab(0.9, 1.1)
    first = matching.find_region(RIG, volume, CONFIG)
    region = matching.narrow(plate_before_wall(36, 14), first, volume, CONFIG)
    assert region.min_disparity <= 14 < first.min_disparity
    assert region.x0 <= 150
    assert region.x1 >= 330
    assert (region.x1 - region.x0) * (region.y1 - region.y0) < 300 * 240


def test_narrowing_gives_up_where_nothing_can_be_matched() -> None:
    black = np.zeros((320, 480, 3), np.uint8)
    region = whole(RIG, 3, 128)
    assert (
        matching.narrow(RectifiedPair(black, black, RIG), region, None, CONFIG).num_disparities
        >= 16
    )
    assert (
        np.isnan(
            matching.match(RectifiedPair(black, 255 - black, RIG), region, CONFIG).values
        ).mean()
        >= 0
    )


def test_narrowing_keeps_a_small_far_piece_of_the_volume() -> None:
    near, far = texture(320, 480, 0), texture(320, 480, 5)
    left, right = np.roll(near, 42, 1), near.copy()
    left[100:130, 200:230] = far[100:130, 200:230]
    right[100:130, 168:198] = far[100:130, 200:230]
    pair = RectifiedPair(
        *(cv2.merge([np.rint(eye).astype(np.uint8)] * 3) for eye in (left, right)), RIG
    )
    volume = slab(0.8, 1.2, 0.6)
    region = matching.narrow(pair, matching.find_region(RIG, volume, CONFIG), volume, CONFIG)
    assert region.min_disparity <= 31
    assert region.min_disparity + region.num_disparities > 43
