from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from screens import DISTANCE, OPENING, PITCH, RIG, WIDTH, Screen, draw

from stereo_ore.config import GrizzlyConfig
from stereo_ore.errors import FrameError
from stereo_ore.lab import synth
from stereo_ore.stages import grizzly
from stereo_ore.types import F64, Grizzly, Mask, Plane, Rig, Site, Surface, Volume

CONFIG = GrizzlyConfig()
KNOWN = Site(opening_m=OPENING, bar_width_m=WIDTH)
IN_VOLUME = Site(volume=Volume(np.eye(4), np.full(3, -5.0), np.full(3, 5.0)))
# Half of the screen is under ore.
COVERED = tuple((s, c, 0.05, 0.12) for s in (-0.35, -0.12, 0.1, 0.33) for c in (-0.36, -0.13))


def angle_deg(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(abs(a @ b), 0, 1))))


def assert_found(found: Grizzly, screen: Screen, angle: float = 0.6, height: float = 0.008) -> None:
    assert angle_deg(found.plane.normal, screen.plane.normal) < angle
    assert found.plane.height(np.array([0, 0, DISTANCE])) == pytest.approx(0, abs=height)
    assert found.plane.normal[2] < 0
    assert found.bars is not None
    assert angle_deg(found.bars.direction, screen.axes[0]) < 2
    assert found.bars.pitch_m == pytest.approx(PITCH, rel=0.03)
    offset = (
        np.array([0, 0, DISTANCE]) @ found.bars.across - found.bars.phase_m
    ) / found.bars.pitch_m
    assert abs(offset - round(offset)) * PITCH < 0.25 * WIDTH


@given(
    st.floats(-np.radians(20), np.radians(20)),
    st.floats(0, np.pi),
    st.integers(0, 1000),
    st.sampled_from([(), COVERED]),
)
@settings(max_examples=15, deadline=None, phases=[Phase.explicit, Phase.reuse, Phase.generate])
def test_finds_tilted_and_covered_screens(tilt, yaw, seed, lumps):
    screen = Screen(tilt=tilt, yaw=yaw, lumps=lumps, noise_px=0.15, seed=seed)
    found = grizzly.find(draw(screen)[0], KNOWN, CONFIG)
    assert found.source == "auto"
    assert_found(found, screen)
    assert found.opening_m == OPENING


@pytest.mark.parametrize("site", [Site(), IN_VOLUME])
def test_measures_bars_that_nobody_described(site):
    screen = Screen(tilt=0.2, yaw=0.5, half=0.7, noise_px=0.1)
    found = grizzly.find(draw(screen)[0], site, CONFIG)
    assert_found(found, screen)
    assert found.opening_m == pytest.approx(OPENING, rel=0.02)
    assert found.bars.width_m == pytest.approx(WIDTH, rel=0.06)
    assert found.diagnostics["bars_seen"] >= 3
    assert found.diagnostics["bar_width_from"] == "image"


def test_bars_that_the_image_does_not_show_are_as_wide_as_depth_says():
    surface, _ = draw(Screen(tilt=0.2, yaw=0.5, half=0.7, noise_px=0.1))
    dark = replace(
        surface, bgr=np.random.default_rng(0).integers(0, 5, surface.bgr.shape).astype(np.uint8)
    )
    found = grizzly.find(dark, IN_VOLUME, CONFIG)
    assert found.opening_m == pytest.approx(OPENING, rel=0.25)
    assert found.diagnostics["bar_width_from"] == "depth"


def test_is_not_taken_in_by_a_floor_around():
    screen = Screen(tilt=0.1, yaw=0.3, half=0.42, floor=0.35, pit=0.35, noise_px=0.1)
    assert_found(grizzly.find(draw(screen)[0], KNOWN, CONFIG), screen)


def test_a_frame_above_the_bars_does_not_lift_the_plane():
    screen = Screen(yaw=0.4, frame_height=0.03, half=0.45, rim=0.1, noise_px=0.1)
    assert_found(grizzly.find(draw(screen)[0], KNOWN, CONFIG), screen)


def test_is_not_taken_in_by_a_big_flat_rock():
    screen = Screen(tilt=-0.1, noise_px=0.1)
    surface, _ = draw(screen)
    u, v = 60, 60
    slab = Plane(screen.plane.normal, screen.plane.offset + 0.2)
    rays = surface.xyz / surface.xyz[..., 2:]
    z = (slab.offset / (rays @ slab.normal)).astype(np.float32)
    surface.xyz[v : v + 110, u : u + 160] = (rays * z[..., None])[v : v + 110, u : u + 160]
    assert_found(grizzly.find(surface, KNOWN, CONFIG), screen)


def test_keeps_the_plane_of_the_site_and_says_how_far_the_cloud_disagrees():
    screen = Screen(tilt=0.1, noise_px=0.05)
    surface, _ = draw(screen)
    given_plane = Plane(screen.plane.normal, screen.plane.offset + 0.01)
    found = grizzly.find(surface, replace(KNOWN, plane=given_plane), CONFIG)
    assert found.plane is given_plane
    assert found.source == "site"
    assert found.diagnostics["cloud_offset_m"] == pytest.approx(0.01, abs=0.003)
    assert found.diagnostics["cloud_tilt_rad"] < 0.01
    exact = grizzly.find(surface, replace(KNOWN, plane=screen.plane), CONFIG)
    assert exact.rms_m < found.rms_m
    assert_found(exact, screen)


@pytest.mark.parametrize("plane", [None, Plane(np.array([0, 0, -1.0]), -DISTANCE)])
def test_a_cloud_without_points(plane):
    blank, _ = draw(Screen())
    blank.xyz[:] = np.nan
    site = replace(KNOWN, plane=plane)
    if plane is None:
        with pytest.raises(FrameError, match=r"among 0 points.*grizzly.plane") as error:
            grizzly.find(blank, site, CONFIG)
        assert error.value.code == "NO_SCREEN"
    else:
        found = grizzly.find(blank, site, CONFIG)
        assert found.plane is plane
        assert found.bars is None


@pytest.mark.parametrize("site", [Site(), IN_VOLUME, KNOWN])
def test_a_floor_without_bars_is_no_screen(site):
    floor, _ = draw(Screen(bars=False, floor=0.25, noise_px=0.1))
    with pytest.raises(FrameError, match="no plane of bars"):
        grizzly.find(floor, site, CONFIG)


def test_bars_as_rough_as_their_gaps_need_a_description():
    noise_px = 0.8
    surface, _ = draw(Screen(noise_px=noise_px))
    rough = replace(surface, sigma_z=surface.sigma_z * np.float32(noise_px / 0.15))
    assert grizzly.find(rough, KNOWN, CONFIG).opening_m == OPENING
    with pytest.raises(FrameError, match="no plane of bars"):
        grizzly.find(rough, Site(), CONFIG)


def test_a_cloud_without_a_plane_is_no_screen():
    surface, _ = draw(Screen())
    z = np.random.default_rng(0).uniform(0.5, 3, surface.sigma_z.shape).astype(np.float32)
    surface.xyz[:] *= (z / surface.xyz[..., 2])[..., None]
    with pytest.raises(FrameError, match="no plane of bars"):
        grizzly.find(surface, Site(), CONFIG)


def test_same_bits_for_any_number_of_threads_and_nothing_changed():
    surface, _ = draw(Screen(tilt=0.1, lumps=COVERED, noise_px=0.1))
    before = surface.xyz.copy()
    found = []
    threads = cv2.getNumThreads()
    for number in (1, 4):
        cv2.setNumThreads(number)
        found.append(grizzly.find(surface, KNOWN, CONFIG))
    cv2.setNumThreads(threads)
    assert np.array_equal(found[0].plane.normal, found[1].plane.normal)
    assert found[0].plane.offset == found[1].plane.offset
    assert found[0].bars.phase_m == found[1].bars.phase_m
    np.testing.assert_array_equal(surface.xyz, before)


@given(st.floats(0.3, 3.0))
@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_a_scaled_scene_gives_a_scaled_screen(scale):
    surface, _ = draw(Screen(tilt=0.15, noise_px=0.05))
    rig = replace(RIG, baseline_m=RIG.baseline_m * scale)
    factor = np.float32(scale)
    scaled = Surface(surface.xyz * factor, surface.bgr, surface.sigma_z * factor, 0, 0, rig)
    one = grizzly.find(surface, KNOWN, CONFIG)
    other = grizzly.find(scaled, Site(opening_m=OPENING * scale, bar_width_m=WIDTH * scale), CONFIG)
    assert other.plane.offset == pytest.approx(one.plane.offset * scale, rel=1e-3)
    assert angle_deg(one.plane.normal, other.plane.normal) < 0.1


def test_the_screen_of_a_synth_scene(synth_scene: synth.Scene):
    site, K = synth_scene.site, synth_scene.rectified.K
    height, width = synth_scene.depth_m.shape
    baseline = synth_scene.rectified.focal_baseline / K[0, 0]
    rig = Rig(width, height, K[0, 0], K[1, 1], K[0, 2], K[1, 2], baseline)
    v, u = np.mgrid[: rig.height, : rig.width]
    xyz = rig.back_project(u, v, synth_scene.depth_m).astype(np.float32)
    xyz[~site.volume.contains(xyz)] = np.nan
    surface = Surface(
        xyz, synth_scene.pair.left, rig.depth_sigma(xyz[..., 2], 0.15).astype(np.float32), 0, 0, rig
    )
    found = grizzly.find(surface, replace(site, plane=None), CONFIG)
    assert angle_deg(found.plane.normal, site.plane.normal) < 0.5
    assert found.plane.offset == pytest.approx(site.plane.offset, abs=0.005)


# --- grids


@pytest.mark.parametrize("cross", [0.15, 0.21])
def test_bars_across_are_found_where_nobody_described_them(cross: float) -> None:
    screen = Screen(tilt=0.2, yaw=0.5, half=0.7, noise_px=0.1, cross=cross)
    found = grizzly.find(draw(screen)[0], IN_VOLUME, CONFIG)
    assert found.cross_bars is not None
    assert found.openings_m is not None
    assert sorted(found.openings_m) == pytest.approx(sorted((OPENING, cross)), rel=0.04)


@pytest.mark.parametrize("turned", [False, True])
def test_a_grid_that_is_described_is_laid_over_the_bars_either_way(turned: bool) -> None:
    cross = 0.22
    screen = Screen(tilt=0.2, yaw=0.5, half=0.7, noise_px=0.1, cross=cross)
    openings = (cross, OPENING) if turned else (OPENING, cross)
    site = Site(opening_m=openings[0], cross_opening_m=openings[1], bar_width_m=WIDTH)
    found = grizzly.find(draw(screen)[0], replace(site, plane=screen.plane), CONFIG)
    assert found.openings_m == openings
    assert found.bars is not None
    assert found.cross_bars is not None
    along, across, _ = screen.axes
    expected = (along, across) if turned else (across, along)
    assert angle_deg(found.bars.across, expected[0]) < 2
    assert angle_deg(found.cross_bars.across, expected[1]) < 2
    assert found.diagnostics["bar_contrast"] > 0.25


@pytest.mark.parametrize("site", [Site(), IN_VOLUME, KNOWN])
def test_parallel_bars_are_no_grid(site: Site) -> None:
    screen = Screen(tilt=0.2, yaw=0.5, half=0.7, noise_px=0.1)
    found = grizzly.find(draw(screen)[0], site, CONFIG)
    assert found.cross_bars is None
    assert found.openings_m is not None
    assert len(found.openings_m) == 1


def test_bars_across_that_depth_does_not_tell_are_found_in_the_image() -> None:
    screen = Screen(tilt=0.2, yaw=0.5, half=0.7, noise_px=0.1, cross=0.21)
    surface, _ = draw(screen)
    found = grizzly.find(surface, Site(plane=screen.plane), CONFIG)
    alone = replace(found, cross_bars=None)
    site = grizzly.with_crossing(alone, surface, Site(), CONFIG)
    assert sorted((site.opening_m, site.cross_opening_m)) == pytest.approx(
        [OPENING, 0.21], rel=0.04
    )
    assert grizzly.with_crossing(found, surface, Site(), CONFIG) == Site()
    slots, _ = draw(replace(screen, cross=None))
    assert (
        grizzly.with_crossing(grizzly.find(slots, Site(), CONFIG), slots, Site(), CONFIG) == Site()
    )


def painted(screen: Screen, surface: Surface, shade: F64, where: Mask) -> Surface:
    """The surface with other grey levels."""
    grey = surface.bgr[..., 0].astype(float)
    grey[where] = shade[where]
    return replace(surface, bgr=np.dstack([np.clip(grey, 0, 255).astype(np.uint8)] * 3))


def places(screen: Screen) -> tuple[F64, F64]:
    """Where rays meet the plane of the bars, along and across them, (H, W) each [m]."""
    v, u = np.mgrid[: RIG.height, : RIG.width]
    ray = np.stack([(u - RIG.cx) / RIG.fx, (v - RIG.cy) / RIG.fy, np.ones(u.shape)], -1)
    along, across, normal = screen.axes
    at = ray * (screen.plane.offset / (ray @ normal))[..., None] - [0, 0, DISTANCE]
    return at @ along, at @ across


def test_ties_are_no_bars_across_though_they_shine() -> None:
    """Every third place of a comb as fine as the bars shows them, and brighter than bars are."""
    screen = Screen(tilt=0.2, yaw=0.5, half=0.7, noise_px=0.1)
    surface, _ = draw(screen)
    along, across = places(screen)
    ties = np.abs(along - 0.57 * np.round(along / 0.57)) < WIDTH / 2
    ties &= (np.abs(along) < 0.7) & (np.abs(across) < 0.7)
    surface = painted(screen, surface, np.full(along.shape, 250.0), ties)
    found = grizzly.find(surface, Site(plane=screen.plane), CONFIG)
    alone = replace(found, cross_bars=None)
    assert grizzly.with_crossing(alone, surface, Site(), CONFIG) == Site()


@pytest.mark.parametrize("flank", [40.0, 5.0], ids=["dark as the pit", "darker than it"])
def test_round_bars_end_beside_their_gleam(flank: float) -> None:
    screen = Screen(tilt=0.2, yaw=0.5, half=0.7, noise_px=0.1)
    surface, _ = draw(screen)
    along, across = places(screen)
    off = np.abs(across - PITCH * np.round(across / PITCH)) * 2 / WIDTH
    bars = (off < 1) & (np.abs(along) < 0.7) & (np.abs(across) < 0.7)
    gleam = flank + (140 - flank) * np.clip(1 - off**2, 0, 1) ** (1 if flank > 20 else 4)
    surface = painted(screen, surface, gleam, bars)
    site = replace(IN_VOLUME, bar_profile="round")
    found = grizzly.find(surface, site, CONFIG)
    assert found.bars is not None
    assert found.bars.width_m == pytest.approx(WIDTH, abs=0.06 * OPENING)
