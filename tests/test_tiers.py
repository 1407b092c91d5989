"""Another tier of bars in the working volume: told where it is a comb above the site's plane."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from screens import DISTANCE, OPENING, PITCH, WIDTH, Screen, draw

from stereo_ore.chain import Chain
from stereo_ore.lab import synth
from stereo_ore.lab.synth.families import sample_spec
from stereo_ore.stages.health import tier_doubts
from stereo_ore.transforms import inverse
from stereo_ore.types import BarLine, Bars, Grizzly, Plane, Site, Surface, Volume

WIDE = Screen(half=5.0, noise_px=0.15, pit=0.5)
ALL = Volume(np.eye(4), np.full(3, -10.0), np.full(3, 10.0))


def told(screen: Screen, rise: float, surface: Surface | None = None, turn: bool = False) -> bool:
    """Whether bars are told that lie so much above the site's plane [openings]; `turn`ed, the bars
    that are known run across them."""
    along, across, normal = screen.axes
    plane = Plane(normal, screen.plane.offset - rise * OPENING)
    bars = Bars(across, along, PITCH, 0.0, WIDTH) if turn else Bars(along, across, PITCH, 0, WIDTH)
    grizzly = Grizzly(plane, "site", None, bars, OPENING)
    doubts = tier_doubts(surface or draw(screen)[0], grizzly, ALL)
    return [doubt.code for doubt in doubts] == ["OTHER_TIER"]


@given(
    st.floats(-0.4, 0.4),
    st.floats(0, np.pi),
    st.floats(0.5, 3.0),
    st.booleans(),
    st.integers(0, 1000),
)
@settings(max_examples=25, deadline=None)
def test_bars_above_the_plane_are_told(
    tilt: float, yaw: float, rise: float, turn: bool, seed: int
) -> None:
    assert told(replace(WIDE, tilt=tilt, yaw=yaw, seed=seed), rise, turn=turn)


@given(
    st.floats(-0.4, 0.4), st.floats(0, np.pi), st.sampled_from([-2.0, -0.5, 0]), st.integers(0, 99)
)
@settings(max_examples=25, deadline=None)
def test_bars_at_the_plane_or_beneath_are_none_of_another_tier(
    tilt: float, yaw: float, rise: float, seed: int
) -> None:
    lumps = ((0.1, 0.05, 0.1, 0.12), (-0.4, -0.3, 0.05, 0.15), (0.3, -0.3, 0.2, 0.1))
    assert not told(replace(WIDE, tilt=tilt, yaw=yaw, lumps=lumps, seed=seed), rise)


@given(st.integers(0, 1000), st.integers(5, 25))
@settings(max_examples=25, deadline=None)
def test_a_heap_is_no_comb(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    heap = rng.uniform((-0.5, -0.4, 0.0, 0.04), (0.5, 0.4, 0.2, 0.15), (count, 4))
    assert not told(replace(WIDE, lumps=tuple(map(tuple, heap)), seed=seed), 0.0)


def test_what_is_out_of_the_volume_or_kept_out_is_not_told() -> None:
    surface, _ = draw(WIDE)
    assert told(WIDE, 1.0, surface)
    plane = WIDE.plane
    surface.xyz[np.abs(plane.height(surface.xyz)) < 0.3 * OPENING] = np.nan
    assert not told(WIDE, 1.0, surface)


@pytest.mark.parametrize(("bars", "expected"), [(2, False), (3, True)])
def test_three_bars_make_a_comb(bars: int, expected: bool) -> None:
    surface, _ = draw(WIDE)
    across = surface.xyz @ WIDE.axes[1] - WIDE.axes[1][2] * DISTANCE
    surface.xyz[~(np.abs(across - (bars % 2 == 0) * PITCH / 2) < bars * PITCH / 2)] = np.nan
    assert told(WIDE, 1.0, surface) is expected


@pytest.mark.slow
def test_a_higher_tier_gives_no_target_to_the_site_of_the_lower_one() -> None:
    spec = sample_spec(9002, "large", "HD720")
    spec = replace(spec, screen=replace(spec.screen, ties=2, step=spec.screen.opening))
    scene = synth.scene(spec)
    result = Chain(scene.calibration, _of_lower_tier(scene))(scene.pair)
    assert [reason.code for reason in result.reasons] == ["OTHER_TIER"]
    assert result.ores
    assert not result.targets


def _of_lower_tier(scene: synth.Scene) -> Site:
    """The site with the plane of the lower tier, and both in the working volume."""
    spec, site = scene.spec, scene.site
    assert site.volume is not None
    assert site.plane is not None
    assert site.T_arm_camera is not None
    screen = spec.screen
    left = float(screen.bar_centres[screen.bar_centres < 0][-1])
    middle = BarLine(np.array([left, 0.0, -screen.step]), np.array([0.0, 1, 0]))
    deeper = site.volume.min_m - [0, 0, screen.step]
    return replace(
        site,
        plane=Plane(site.plane.normal, site.plane.offset - screen.step),
        volume=replace(site.volume, min_m=deeper),
        bar=middle.seen_from(inverse(spec.T_world_screen) @ site.T_arm_camera),
    )
