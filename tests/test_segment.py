import json
import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from screens import OPENING, RIG, WIDTH, Screen, draw

from stereo_ore.config import GrizzlyConfig, SegmentConfig
from stereo_ore.errors import ConfigError
from stereo_ore.lab import synth
from stereo_ore.stages import grizzly, segment
from stereo_ore.stages.segment import channels, model, outputs, votes, whole
from stereo_ore.stages.segment.outline import drawn
from stereo_ore.types import Disparity, Grizzly, OreMap, Region, Rig, Site, Surface, Volume

CONFIG = SegmentConfig()
MODEL = segment.load_lump_model()
APART = ((-0.3, -0.2, 0.05, 0.11), (0.25, -0.25, 0.06, 0.12), (0.0, 0.3, 0.04, 0.1))
HEAP = ((-0.13, 0.0, 0.05, 0.14), (0.13, 0.0, 0.05, 0.14), (0.0, 0.02, 0.22, 0.1))


def screen_of(screen: Screen, surface: Surface) -> Grizzly:
    site = Site(plane=screen.plane, opening_m=OPENING, bar_width_m=WIDTH)
    return grizzly.find(surface, site, GrizzlyConfig())


def disparity_of(surface: Surface) -> Disparity:
    """What a matcher without a doubt would have given for a surface."""
    rig, (h, w) = surface.rig, surface.sigma_z.shape
    region = Region(surface.x0, surface.y0, surface.x0 + w, surface.y0 + h, 0, 128)
    values = np.full((rig.height, rig.width), np.nan, np.float32)
    values[region.slices] = rig.disparity(surface.xyz[..., 2])
    return Disparity(values, region, np.where(np.isfinite(values), np.float32(1), np.nan))


def found_in(
    surface: Surface,
    screen: Grizzly,
    config: SegmentConfig = CONFIG,
    volume: Volume | None = None,
    of: segment.LumpModel = MODEL,
) -> OreMap:
    return segment.segment(disparity_of(surface), surface, screen, volume, config, of)


def segmented(screen: Screen, config: SegmentConfig = CONFIG) -> tuple[OreMap, np.ndarray]:
    surface, labels = draw(screen)
    return found_in(surface, screen_of(screen, surface), config), labels


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
    assert min(overlaps(ores.labels, truth)) > 0.8


@pytest.mark.parametrize("noise", [0.05, 0.15])
@pytest.mark.parametrize("seed", range(3))
def test_a_heap_is_split_into_its_lumps(noise, seed):
    ores, truth = segmented(Screen(tilt=0.1, lumps=HEAP, half=0.6, noise_px=noise, seed=seed))
    assert ores.labels.max() == 3
    assert min(overlaps(ores.labels, truth)) > 0.6


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
    ores, _ = segmented(Screen(lumps=APART, half=0.6), SegmentConfig(min_size_m=0.5))
    assert ores.labels.max() == 0
    assert ores.diagnostics["dropped_small"] == 3


def test_what_the_filter_did_not_keep_is_no_lump():
    screen = Screen(lumps=APART, half=0.6)
    surface, truth = draw(screen)
    disparity, grid = disparity_of(surface), screen_of(screen, surface)
    surface.xyz[truth == 1] = np.nan
    ores = segment.segment(disparity, surface, grid, None, CONFIG, MODEL)
    assert not ores.labels[truth == 1].any()
    assert ores.labels[truth == 2].any()


def test_holes_in_a_lump_are_filled():
    screen = Screen(lumps=APART, half=0.6)
    surface, truth = draw(screen)
    y, x = (int(np.mean(side)) for side in np.nonzero(truth == 1))
    surface.xyz[y - 5 : y + 5, x - 5 : x + 5] = np.nan
    ores = found_in(surface, screen_of(screen, surface))
    assert (ores.labels[y - 5 : y + 5, x - 5 : x + 5] > 0).all()
    assert min(overlaps(ores.labels, truth)) > 0.8


def test_each_lump_is_in_one_piece_without_holes():
    ores, _ = segmented(Screen(tilt=0.2, lumps=(*HEAP, *APART), half=0.6, noise_px=0.2))
    for i in range(1, ores.labels.max() + 1):
        mine = (ores.labels == i).astype(np.uint8)
        assert cv2.connectedComponents(mine, connectivity=8)[0] == 2


def test_a_surface_without_points_has_no_ore():
    surface, _ = draw(Screen())
    screen = screen_of(Screen(), surface)
    surface.xyz[:] = np.nan
    ores = found_in(surface, screen)
    assert ores.labels.shape == (RIG.height, RIG.width)
    assert ores.labels.max() == 0


def test_works_without_bars_and_opening():
    screen = Screen(lumps=APART, half=0.6)
    surface, truth = draw(screen)
    config = SegmentConfig(default_opening_m=OPENING)
    ores = found_in(surface, Grizzly(screen.plane, "site"), config)
    assert min(overlaps(ores.labels, truth)) > 0.6


def test_a_crop_is_laid_where_it_was_cut_out():
    screen = Screen(lumps=APART, half=0.6)
    surface, _ = draw(screen)
    grid = screen_of(screen, surface)
    part = np.s_[20:, 30:]
    images = (image[part].copy() for image in (surface.xyz, surface.bgr, surface.sigma_z))
    labels = found_in(Surface(*images, 30, 20, RIG), grid).labels
    assert ((labels > 0) != (found_in(surface, grid).labels > 0)).mean() < 0.01


def test_same_bits_for_any_number_of_threads_and_nothing_changed():
    screen = Screen(tilt=0.1, lumps=HEAP, half=0.6, noise_px=0.15)
    surface, _ = draw(screen)
    before = surface.xyz.copy(), surface.bgr.copy()
    found, threads = [], cv2.getNumThreads()
    for number in (1, 2, 4):
        cv2.setNumThreads(number)
        found.append(found_in(surface, screen_of(screen, surface)).labels)
    cv2.setNumThreads(threads)
    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_array_equal(found[0], found[2])
    np.testing.assert_array_equal(surface.xyz, before[0])
    np.testing.assert_array_equal(surface.bgr, before[1])


def test_the_lumps_of_a_synth_scene(synth_scene: synth.Scene):
    K, truth = synth_scene.rectified.K, synth_scene.instance
    height, width = truth.shape
    baseline = synth_scene.rectified.focal_baseline / K[0, 0]
    rig = Rig(width, height, K[0, 0], K[1, 1], K[0, 2], K[1, 2], baseline)
    v, u = np.mgrid[:height, :width]
    xyz = rig.back_project(u, v, synth_scene.depth_m).astype(np.float32)
    sigma = rig.depth_sigma(xyz[..., 2], 0.15).astype(np.float32)
    surface = Surface(xyz, synth_scene.pair.left, sigma, 0, 0, rig)
    disparity = disparity_of(surface)
    xyz[~synth_scene.site.volume.contains(xyz)] = np.nan
    screen = grizzly.find(surface, synth_scene.site, GrizzlyConfig())
    volume = synth_scene.site.volume
    ores = segment.segment(disparity, surface, screen, volume, CONFIG, MODEL)
    found = overlaps(ores.labels, np.maximum(truth - 1, 0))
    assert np.mean(np.array(found) > 0.5) >= 0.75


def test_channels_are_those_of_a_sphere_on_a_plane():
    screen = Screen(lumps=((0.0, 0.0, 0.0, 0.15),), half=0.6, bars=False, pit=0.0)
    surface, truth = draw(screen)
    disparity = disparity_of(surface)
    seen = channels.measure_channels(
        disparity, surface, Grizzly(screen.plane, "site"), OPENING, disparity.region
    )
    shape = truth.shape
    size = round(shape[1] * seen.scale), round(shape[0] * seen.scale)
    assert seen.x.shape == (len(channels.CHANNELS), size[1], size[0])
    height, nx, ny = seen.x[:3]
    # The sphere's top is its radius, one opening, above the plane.
    assert height.max() == pytest.approx(0.15 / OPENING, rel=0.03)
    assert abs(np.median(height)) < 0.01
    y, x = np.unravel_index(height.argmax(), height.shape)
    # Normals lean outwards: to the right on its right side, down the image below.
    assert nx[y, x + 10] > 0.2 > -0.2 > nx[y, x - 10]
    assert ny[y + 10, x] > 0.2 > -0.2 > ny[y - 10, x]
    assert seen.x[4].min() == 1


def test_channels_have_no_nan_where_nothing_was_measured():
    surface, _ = draw(Screen(lumps=APART))
    surface.xyz[:] = np.nan
    disparity = disparity_of(surface)
    screen = Grizzly(Screen().plane, "site")
    x = channels.measure_channels(disparity, surface, screen, OPENING, disparity.region).x
    assert np.isfinite(x).all()
    assert not x[:8].any()


def said(labels: np.ndarray, lines: np.ndarray | None = None) -> outputs.Outputs:
    """The outputs of a network that is sure of the right thing."""
    raw = np.zeros((len(outputs.OUTPUTS), *labels.shape), np.float32)
    raw[0] = np.where(labels > 0, 8, -8)
    raw[1] = -8 if lines is None else np.where(lines, 8, -8)
    v, u = np.mgrid[: labels.shape[0], : labels.shape[1]]
    for i in range(1, labels.max() + 1):
        mine = labels == i
        raw[2][mine] = (u[mine].mean() - u[mine]) / channels.UNIT
        raw[3][mine] = (v[mine].mean() - v[mine]) / channels.UNIT
        raw[4][mine] = np.log(np.sqrt(mine.sum()) / channels.UNIT)
    return outputs.read(raw)


def voted(told: outputs.Outputs, least: float = 8.0) -> np.ndarray:
    return votes.lumps(told, least, 0.5, 0.35, 0.3)


def test_votes_name_touching_lumps_and_a_small_one_on_a_large_one():
    labels = np.zeros((120, 160), np.int32)
    labels[20:70, 20:60], labels[20:70, 60:100] = 1, 2
    cv2.circle(labels, (48, 57), 8, 3, -1)
    found = voted(said(labels))
    assert found.max() == 3
    assert min(overlaps(found, labels)) > 0.95


def test_a_contact_line_cuts_and_the_cut_off_scrap_grows_back():
    labels = np.zeros((60, 90), np.int32)
    labels[10:40, 10:70] = 1
    lines = np.zeros(labels.shape, bool)
    lines[10:40, 20:22] = True
    found = voted(said(labels, lines))
    assert found.max() == 1
    # The scrap is no farther from the body than lumps grow back.
    np.testing.assert_array_equal(found > 0, labels > 0)


def test_few_pixels_and_votes_that_disagree_are_no_lump():
    labels = np.zeros((60, 90), np.int32)
    labels[10:40, 10:40] = 1
    told = said(labels)
    assert voted(told, least=901).max() == 0
    rng = np.random.default_rng(0)
    x, y = (rng.uniform(0, 60, labels.shape).astype(np.float32) for _ in range(2))
    scattered = outputs.Outputs(told.ore, told.line, x, y, told.diameter)
    assert voted(scattered).max() == 0


def test_outputs_are_rounded_before_anything_is_decided():
    raw = np.random.default_rng(0).normal(size=(5, 20, 30)).astype(np.float32)
    raw = np.round(raw * outputs.GRID) / np.float32(outputs.GRID)
    other = raw + np.random.default_rng(1).uniform(-1e-4, 1e-4, raw.shape).astype(np.float32)
    for name in outputs.Outputs.__dataclass_fields__:
        one, two = (getattr(outputs.read(r), name) for r in (raw, other))
        np.testing.assert_array_equal(one, two)


def test_labels_are_drawn_at_their_place_and_size():
    small = np.zeros((30, 40), np.int32)
    small[5:20, 10:20], small[5:20, 20:30] = 1, 2
    large = drawn(small, np.full((60, 80, 3), 90, np.uint8), 2)
    expected = cv2.resize(small.astype(np.float32), (80, 60), interpolation=cv2.INTER_NEAREST)
    # Without an edge in the picture only corners are rounded.
    assert (large != expected).mean() < 0.06
    assert (large[20:30] == expected[20:30]).all()
    assert drawn(np.zeros_like(small), np.zeros((60, 80, 3), np.uint8), 2).max() == 0


def test_outlines_move_to_edges_near_by_only():
    colour = np.full((80, 80, 3), (60, 90, 120), np.uint8)
    colour[20:60, 20:60] = (90, 90, 90)
    for off, expected, error in ((1, 20, 1), (-1, 20, 1), (6, 8, 4)):
        small = np.zeros((40, 40), np.int32)
        small[10 - off : 30 + off, 10 - off : 30 + off] = 1
        rows = np.flatnonzero(drawn(small, colour, 2)[:, 40])
        assert abs(rows[0] - expected) <= error
        assert abs(79 - rows[-1] - expected) <= error


def test_features_tell_a_whole_lump_from_a_part_of_one():
    labels = np.zeros((60, 90), np.int32)
    labels[10:40, 10:50] = 1
    told, x = said(labels), np.zeros((len(channels.CHANNELS), *labels.shape), np.float32)
    one = whole.features(labels, told, x)
    labels[10:40, 30:50] = 2
    two = whole.features(labels, told, x)
    assert one.shape == (1, len(whole.FEATURES))
    assert two.shape == (2, len(whole.FEATURES))
    share, beside = whole.FEATURES.index("log_share"), whole.FEATURES.index("beside")
    assert one[0, share] == pytest.approx(0, abs=0.02)
    assert two[0, share] == pytest.approx(np.log(0.5), abs=0.02)
    assert two[0, beside] > one[0, beside] == 0


def copied(tmp_path: Path, **changed: object) -> Path:
    """The shipped model with other entries in its card; None takes one out."""
    card = {
        **MODEL.card.about,
        "inputs": MODEL.card.inputs,
        "unit_px": MODEL.card.unit_px,
        "outputs": MODEL.card.outputs,
        "sha256": MODEL.card.sha256,
        **changed,
    }
    kept = {key: value for key, value in card.items() if value is not None}
    (tmp_path / "card.json").write_text(json.dumps(kept))
    (tmp_path / "model.onnx").write_bytes(MODEL.onnx)
    return tmp_path


def test_a_model_folder_gives_what_the_shipped_one_gives(tmp_path: Path):
    x = np.random.default_rng(0).normal(size=(10, 50, 70)).astype(np.float32)
    mine = segment.load_lump_model(str(copied(tmp_path)))
    np.testing.assert_array_equal(mine(x), MODEL(x))
    assert MODEL(x).shape == (5, 50, 70)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(mine))(x), MODEL(x))


@pytest.mark.parametrize(
    ("changed", "key"),
    [
        ({"inputs": ["height"]}, "inputs"),
        ({"unit_px": 48}, "unit_px"),
        ({"version": 9}, "version"),
        ({"format": "other"}, "format"),
        ({"sha256": "0"}, "sha256"),
        ({"outputs": None}, None),
        ({"whole": {"features": ["ore"]}}, None),
    ],
)
def test_a_card_that_does_not_fit_is_named(tmp_path: Path, changed: dict[str, object], key: str):
    with pytest.raises(ConfigError, match=r"card\.json") as caught:
        segment.load_lump_model(str(copied(tmp_path, **changed)))
    assert caught.value.key == key
    assert "tune" in str(caught.value)


def test_a_folder_without_a_model_and_a_broken_network_are_named(tmp_path: Path):
    with pytest.raises(ConfigError, match=r"models\.lumps.*model\.onnx"):
        segment.load_lump_model(str(tmp_path / "none"))
    model.write(tmp_path, b"no network", {})
    with pytest.raises(ConfigError, match=r"models\.lumps.*ONNX Runtime"):
        segment.load_lump_model(str(tmp_path))
