import dataclasses

import cv2
import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from screens import OPENING, RIG, WIDTH, Screen, draw

from stereo_ore.config import GrizzlyConfig, SegmentConfig
from stereo_ore.lab import synth
from stereo_ore.stages import grizzly, segment
from stereo_ore.stages.segment.cores import LEVEL_RATIO, cores
from stereo_ore.stages.segment.evidence import EDGE_VARIANCE, ore_mask
from stereo_ore.stages.segment.pixels import (
    PIXEL_FEATURES,
    Sight,
    candidates,
    ore_probability,
    pixel_features,
)
from stereo_ore.stages.segment.relief import fill_occlusions
from stereo_ore.stages.segment.split import smooth_relief, valley_depth
from stereo_ore.stages.segment.weights import PART_FEATURES, Logistic, Weights, load
from stereo_ore.types import Grizzly, OreMap, Rig, Site, Surface

CONFIG = SegmentConfig()
APART = ((-0.3, -0.2, 0.05, 0.11), (0.25, -0.25, 0.06, 0.12), (0.0, 0.3, 0.04, 0.1))
HEAP = ((-0.13, 0.0, 0.05, 0.14), (0.13, 0.0, 0.05, 0.14), (0.0, 0.02, 0.22, 0.1))


def screen_of(screen: Screen, surface: Surface) -> Grizzly:
    site = Site(plane=screen.plane, opening_m=OPENING, bar_width_m=WIDTH)
    return grizzly.find(surface, site, GrizzlyConfig())


def segmented(screen: Screen, config: SegmentConfig = CONFIG) -> tuple[OreMap, np.ndarray]:
    surface, labels = draw(screen)
    return segment.segment(surface, screen_of(screen, surface), None, config), labels


def overlaps(found: np.ndarray, truth: np.ndarray) -> list[float]:
    """Best intersection over union of each true lump."""
    out = []
    for lump in range(1, truth.max() + 1):
        mine = truth == lump
        ids = [i for i in np.unique(found[mine]) if i]
        out.append(
            max(((found == i) & mine).sum() / ((found == i) | mine).sum() for i in ids)
            if ids
            else 0.0
        )
    return out


@given(
    st.floats(-0.3, 0.3), st.floats(0, np.pi), st.integers(0, 100), st.sampled_from([0.05, 0.15])
)
@settings(max_examples=12, deadline=None, phases=[Phase.explicit, Phase.reuse, Phase.generate])
def test_outlines_of_lumps_that_lie_apart(tilt, yaw, seed, noise):
    ores, truth = segmented(
        Screen(tilt=tilt, yaw=yaw, lumps=APART, half=0.6, noise_px=noise, seed=seed)
    )
    assert ores.labels.max() == 3
    assert min(overlaps(ores.labels, truth)) > 0.85


@pytest.mark.parametrize("noise", [0.05, 0.15])
@pytest.mark.parametrize("seed", range(3))
def test_a_heap_is_split_into_its_lumps(noise, seed):
    ores, truth = segmented(Screen(tilt=0.1, lumps=HEAP, half=0.6, noise_px=noise, seed=seed))
    assert ores.labels.max() == 3
    assert min(overlaps(ores.labels, truth)) > 0.7


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("frame", [0.0, 0.03])
def test_an_empty_screen_has_no_ore(seed, frame):
    screen = Screen(
        tilt=0.1, yaw=0.2 * seed, half=0.5, rim=0.08, frame_height=frame, noise_px=0.2, seed=seed
    )
    assert segmented(screen)[0].labels.max() == 0


def test_numbers_lumps_from_the_top_and_gives_the_full_image():
    ores, _ = segmented(Screen(lumps=APART, half=0.6))
    assert ores.labels.shape == (RIG.height, RIG.width)
    assert ores.labels.dtype == np.int16
    assert sorted(np.unique(ores.labels)) == [0, 1, 2, 3]
    tops = [np.nonzero(ores.labels == i)[0].min() for i in (1, 2, 3)]
    assert tops == sorted(tops)
    assert not ores.cut


def test_without_a_volume_what_lies_far_beside_the_screen_is_no_ore():
    screen = Screen(lumps=(*APART, (-0.85, -0.55, 0.1, 0.12)), half=0.5)
    ores, truth = segmented(screen)
    assert not ores.labels[truth == 4].any()
    assert ores.labels[truth == 1].any()


def test_names_the_lumps_that_the_image_border_cuts():
    ores, truth = segmented(Screen(lumps=((0.97, 0.0, 0.05, 0.15), *APART), half=1.2))
    cut = {int(i) for i in np.unique(ores.labels[truth == 1]) if i}
    assert cut
    assert ores.cut == cut


def test_small_lumps_are_dropped_and_counted():
    ores, _ = segmented(Screen(lumps=APART, half=0.6), replace_config(min_size_m=0.5))
    assert ores.labels.max() == 0
    assert ores.diagnostics["dropped_small"] == 3


def replace_config(**values: float) -> SegmentConfig:
    return SegmentConfig(**values)


def test_holes_in_a_lump_are_filled():
    screen = Screen(lumps=APART, half=0.6)
    surface, truth = draw(screen)
    y, x = (int(np.mean(side)) for side in np.nonzero(truth == 1))
    surface.xyz[y - 5 : y + 5, x - 5 : x + 5] = np.nan
    ores = segment.segment(surface, screen_of(screen, surface), None, CONFIG)
    assert (ores.labels[y - 5 : y + 5, x - 5 : x + 5] > 0).all()
    assert min(overlaps(ores.labels, truth)) > 0.85


def test_each_lump_is_in_one_piece_without_holes():
    ores, _ = segmented(Screen(tilt=0.2, lumps=(*HEAP, *APART), half=0.6, noise_px=0.2))
    for i in range(1, ores.labels.max() + 1):
        mine = (ores.labels == i).astype(np.uint8)
        assert cv2.connectedComponents(mine, connectivity=8)[0] == 2


def test_a_surface_without_points_has_no_ore():
    surface, _ = draw(Screen())
    screen = screen_of(Screen(), surface)
    surface.xyz[:] = np.nan
    ores = segment.segment(surface, screen, None, CONFIG)
    assert ores.labels.shape == (RIG.height, RIG.width)
    assert ores.labels.max() == 0


def test_works_without_bars_and_opening():
    screen = Screen(lumps=APART, half=0.6)
    surface, truth = draw(screen)
    ores = segment.segment(surface, Grizzly(screen.plane, "site"), None, CONFIG)
    assert min(overlaps(ores.labels, truth)) > 0.6


def test_a_crop_is_laid_where_it_was_cut_out():
    screen = Screen(lumps=APART, half=0.6)
    surface, _ = draw(screen)
    whole = segment.segment(surface, screen_of(screen, surface), None, CONFIG).labels
    part = np.s_[20:, 30:]
    cropped = Surface(
        surface.xyz[part].copy(),
        surface.bgr[part].copy(),
        surface.sigma_z[part].copy(),
        30,
        20,
        RIG,
    )
    labels = segment.segment(cropped, screen_of(screen, surface), None, CONFIG).labels
    assert ((labels > 0) != (whole > 0)).mean() < 0.005


def test_what_is_small_or_cut_must_be_likelier_a_lump():
    small, large = (-0.3, -0.2, 0.05, 0.08), (0.2, 0.1, 0.05, 0.15)
    screen = Screen(lumps=(small, large), half=0.6)
    surface, truth = draw(screen)
    areas = np.bincount(truth.ravel())[1:]
    config = CONFIG.model_copy(update={"small_pixels": int(areas.mean())})
    zeros, ones = ((value,) * len(PART_FEATURES) for value in (0.0, 1.0))
    two_of_three = Logistic(PART_FEATURES, zeros, ones, zeros, float(np.log(2)))
    weights = Weights(load().pixel, load().pair, two_of_three)

    def found(of: Surface, config: SegmentConfig) -> list[float]:
        labels = segment.segment(of, screen_of(screen, surface), None, config, weights).labels
        return [float((labels[truth == lump] > 0).mean()) for lump in (1, 2)]

    assert min(found(surface, CONFIG)) > 0.8
    of_small, of_large = found(surface, config)
    assert of_small == 0 < 0.8 < of_large
    middle = int(np.nonzero(truth == 2)[1].mean())
    cut = Surface(
        *(image[:, :middle].copy() for image in (surface.xyz, surface.bgr, surface.sigma_z)),
        0,
        0,
        RIG,
    )
    assert found(cut, CONFIG)[1] == 0 < 0.8 < found(cut, CONFIG)[0]


def test_same_bits_for_any_number_of_threads_and_nothing_changed():
    screen = Screen(tilt=0.1, lumps=HEAP, half=0.6, noise_px=0.15)
    surface, _ = draw(screen)
    before = surface.xyz.copy(), surface.bgr.copy()
    found, threads = [], cv2.getNumThreads()
    for number in (1, 4):
        cv2.setNumThreads(number)
        found.append(segment.segment(surface, screen_of(screen, surface), None, CONFIG).labels)
    cv2.setNumThreads(threads)
    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_array_equal(surface.xyz, before[0])
    np.testing.assert_array_equal(surface.bgr, before[1])


def test_the_lumps_of_a_synth_scene(synth_scene: synth.Scene):
    K, truth = synth_scene.rectified.K, synth_scene.instance
    height, width = truth.shape
    rig = Rig(
        width,
        height,
        K[0, 0],
        K[1, 1],
        K[0, 2],
        K[1, 2],
        synth_scene.rectified.focal_baseline / K[0, 0],
    )
    v, u = np.mgrid[:height, :width]
    xyz = rig.back_project(u, v, synth_scene.depth_m).astype(np.float32)
    xyz[~synth_scene.site.volume.contains(xyz)] = np.nan
    sigma = rig.depth_sigma(xyz[..., 2], 0.15).astype(np.float32)
    surface = Surface(xyz, synth_scene.pair.left, sigma, 0, 0, rig)
    screen = grizzly.find(surface, synth_scene.site, GrizzlyConfig())
    ores = segment.segment(surface, screen, synth_scene.site.volume, CONFIG)
    found = overlaps(ores.labels, np.maximum(truth - 1, 0))
    assert np.mean(np.array(found) > 0.5) >= 0.75


def test_a_convex_dome_has_no_valleys_and_two_have_one():
    y, x = np.mgrid[:60, :120].astype(np.float32)
    one = 10 - ((x - 60) ** 2 + (y - 30) ** 2) / 200
    two = np.maximum(
        10 - ((x - 35) ** 2 + (y - 30) ** 2) / 100, 10 - ((x - 85) ** 2 + (y - 30) ** 2) / 100
    )
    inner = np.s_[10:-10, 10:-10]
    assert valley_depth(one.astype(np.float32), 8)[inner].max() <= 1e-4
    depth = valley_depth(two.astype(np.float32), 8)[inner]
    assert np.unravel_index(depth.argmax(), depth.shape)[1] == 50
    assert depth.max() > 1


@pytest.mark.parametrize(("neck", "count"), [(0.95, 1), (0.4, 2)])
def test_a_neck_parts_cores_only_when_it_is_thin(neck, count):
    mask = np.zeros((80, 160), np.uint8)
    cv2.circle(mask, (45, 40), 25, 1, -1)
    cv2.circle(mask, (115, 40), 25, 1, -1)
    half = round(25 * neck)
    mask[40 - half : 40 + half + 1, 45:115] = 1
    labels = cores(mask > 0, np.zeros(mask.shape, bool), 0.85, 2.0)
    assert len(np.unique(labels)) - 1 == count


def _cores_level_by_level(mask, barrier, ratio, least):
    """The definition of `cores`: connected sets of one level after another, from the thickest
    down."""
    thickness = cv2.distanceTransform(np.pad(mask & ~barrier, 1).astype(np.uint8), cv2.DIST_L2, 5)[
        1:-1, 1:-1
    ]
    count = int(np.log(thickness.max() / least) / np.log(LEVEL_RATIO)) + 1
    labels, heights, places = np.zeros(mask.shape, np.int32), {}, {}
    for level in least * LEVEL_RATIO ** np.arange(count - 1, -1, -1):
        parts, part = cv2.connectedComponents((thickness > level).astype(np.uint8), connectivity=4)
        for number in range(1, parts):
            here = part == number
            met = sorted(
                label for label in heights if labels[places[label]] == label and here[places[label]]
            )
            if not met:
                new = len(heights) + 1
                places[new] = np.unravel_index(np.where(here, thickness, 0).argmax(), here.shape)
                heights[new], met = thickness[places[new]], [new]
            thickest = max(met, key=heights.get)
            thin = [label for label in met if label != thickest and heights[label] * ratio <= level]
            labels[np.isin(labels, thin)] = thickest
            if len(thin) == len(met) - 1:
                labels[here] = thickest
    return labels


@pytest.mark.parametrize("seed", range(5))
def test_cores_are_those_of_the_tree_level_by_level(seed):
    rng = np.random.default_rng(seed)
    mask = cv2.GaussianBlur(rng.normal(size=(90, 120)), (0, 0), 5) > 0
    barrier = rng.random(mask.shape) < 0.004
    labels = cores(mask, barrier, 0.85, 1.5)
    assert labels.max() > 3
    np.testing.assert_array_equal(labels, _cores_level_by_level(mask, barrier, 0.85, 1.5))


def test_half_occlusions_are_filled_from_the_farther_side_and_wide_gaps_are_not():
    nan = np.nan
    row = np.array([[1, nan, nan, nan, 5, 5, nan, nan, nan, nan, nan, 5, nan, 1]], np.float32)
    expected = np.array([[1, 1, 1, 1, 5, 5, nan, nan, nan, nan, nan, 5, 1, 1]], np.float32)
    np.testing.assert_array_equal(fill_occlusions(row), expected)


def test_gaps_at_a_border_and_across_rows_stay():
    nan = np.nan
    rows = np.array([[nan, 3, nan, 3], [nan, 2, 2, nan], [2, nan, 2, nan]], np.float32)
    expected = np.array([[nan, 3, 3, 3], [nan, 2, 2, nan], [2, 2, 2, nan]], np.float32)
    np.testing.assert_array_equal(fill_occlusions(rows), expected)


@pytest.mark.parametrize("height", [3, 90, 401])
def test_probability_filtered_in_strips_is_that_of_the_whole_image(height: int):
    rng = np.random.default_rng(height)
    likely = np.clip(
        cv2.GaussianBlur(rng.normal(0.5, 30, (height, 120)).astype(np.float32), (0, 0), 5), 0, 1
    )
    grey = rng.integers(0, 255, likely.shape, np.uint8)
    whole = (
        cv2.ximgproc.guidedFilter(grey, likely, CONFIG.guide_radius_px, EDGE_VARIANCE)
        > CONFIG.ore_probability
    )
    opened = cv2.morphologyEx(whole.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    assert height < 50 or opened.any()
    np.testing.assert_array_equal(ore_mask(likely, grey, CONFIG, 0.0), opened > 0)


def test_ore_of_fewer_pixels_is_none():
    likely = np.zeros((60, 90), np.float32)
    likely[10:20, 10:20] = likely[30:50, 40:80] = 1
    mask = ore_mask(likely, np.full(likely.shape, 90, np.uint8), CONFIG, 300.0)
    assert mask[40, 60]
    assert not mask[:25, :30].any()


def sight_of(relief: np.ndarray, on_bar: np.ndarray, bgr: np.ndarray) -> Sight:
    grey = cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY)
    return Sight(
        np.clip(np.nan_to_num(relief, nan=-1), -1, 2).astype(np.float32),
        relief,
        on_bar,
        np.ones_like(relief),
        bgr,
        grey,
    )


def patch(height: float, colour: int, holes: float = 0.0) -> tuple[Sight, np.ndarray]:
    """A square at a height [thresholds] on bars of grey level 150, a share of it not measured."""
    rng = np.random.default_rng(0)
    relief = rng.normal(0, 0.1, (90, 120)).astype(np.float32)
    square = np.zeros(relief.shape, bool)
    square[30:60, 40:80] = True
    relief[square] += height
    relief[square & (rng.random(relief.shape) < holes)] = np.nan
    bgr = np.where(square[..., None], colour, 150) + rng.normal(0, 3, (90, 120, 3))
    return sight_of(
        relief, np.ones(relief.shape, bool), np.clip(bgr, 0, 255).astype(np.uint8)
    ), square


@pytest.mark.parametrize("colour", [40, 150, 240])
def test_what_stands_out_is_ore_whatever_its_colour(colour: int):
    sight, square = patch(4.0, colour)
    likely = ore_probability(sight, load().pixel)
    inner = cv2.erode(square.astype(np.uint8), np.ones((13, 13), np.uint8)) > 0
    assert likely[inner].min() == 1
    assert likely[~square].mean() < 0.05


def test_bars_and_what_was_hardly_measured_are_no_ore():
    assert ore_probability(patch(0.0, 150)[0], load().pixel).max(initial=0) < 0.5
    sight, square = patch(1.5, 150, holes=0.7)
    assert ore_probability(sight, load().pixel)[square].mean() < 0.5


def test_pixels_are_judged_near_evidence_alone():
    sight, square = patch(4.0, 40)
    at = candidates(sight)
    near = cv2.dilate(square.astype(np.uint8), np.ones((27, 27), np.uint8)).ravel() > 0
    assert np.isin(np.flatnonzero(square), at).all()
    assert near[at].all()
    assert np.isfinite(pixel_features(sight, at)).all()
    assert pixel_features(sight, at).shape == (len(at), len(PIXEL_FEATURES))


@pytest.mark.parametrize("what", ["relief", "bars"])
def test_a_view_without_anything_measured_or_without_bars_has_features(what: str):
    sight, _ = patch(4.0, 90)
    if what == "relief":
        sight = dataclasses.replace(sight, relief=np.full_like(sight.relief, np.nan))
    else:
        sight = dataclasses.replace(sight, on_bar=np.zeros_like(sight.on_bar))
    assert np.isfinite(pixel_features(sight, candidates(sight))).all()


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (3, 5), (9, 8)])
@pytest.mark.parametrize("evidence", [-1.0, 2.0])
def test_the_smallest_crops_are_judged(shape: tuple[int, int], evidence: float):
    relief, bgr = np.full(shape, 5.0, np.float32), np.zeros((*shape, 3), np.uint8)
    sight = Sight(
        np.full(shape, evidence, np.float32),
        relief,
        relief > 9,
        np.ones_like(relief),
        bgr,
        bgr[..., 0],
    )
    likely = ore_probability(sight, load().pixel)
    assert likely.shape == shape
    assert likely.all() == (evidence > 0)


def test_a_hole_in_a_lump_is_no_valley():
    relief = np.full((80, 80), 6.0, np.float32)
    relief[36:44, 36:44] = np.nan
    mask = np.zeros(relief.shape, bool)
    mask[10:70, 10:70] = True
    smooth = smooth_relief(relief, mask, 1.5)
    np.testing.assert_allclose(smooth[mask], 6.0, rtol=1e-4)
    assert not smooth[~mask].any()
