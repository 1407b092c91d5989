"""The bars measured against their place, and the rows that show them elsewhere, on analytic
screens."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from screens import DISTANCE, OPENING, PITCH, RIG, WIDTH, Screen, draw

from stereo_ore.config import GrizzlyConfig, HealthConfig
from stereo_ore.stages.grizzly import corrected, find, register
from stereo_ore.stages.health import (
    bar_doubts,
    judge_parts,
    row_doubts,
    unmeasured_doubts,
    without_doubtful,
)
from stereo_ore.types import (
    F64,
    BarLine,
    Disparity,
    OreMap,
    Plane,
    Reason,
    Region,
    Registration,
    Rig,
    Site,
    Strike,
    StrikePlan,
)

CONFIG, HEALTH = GrizzlyConfig(), HealthConfig()
WIDE = Screen(half=5.0, noise_px=0.15, pit=0.5)
ACROSS = replace(WIDE, yaw=1.2)
"""Bars that all rows cross; of bars along the rows only the rows on them tell."""
LUMPS = ((0.1, 0.05, 0.1, 0.12), (-0.4, -0.3, 0.05, 0.15))
SITE = Site(opening_m=OPENING, bar_width_m=WIDTH)


@dataclass(frozen=True)
class Sized:
    """What is looked at of a solid."""

    size_m: F64


def seen(screen: Screen) -> Disparity:
    surface, _ = draw(screen)
    values = RIG.disparity(surface.xyz[..., 2]).astype(np.float32)
    return Disparity(values, Region(0, 0, RIG.width, RIG.height, 0, 64), np.ones_like(values))


def field(coefficients: F64) -> F64:
    v, u = np.mgrid[: RIG.height, : RIG.width]
    return (
        coefficients[0]
        + coefficients[1] * (u - RIG.cx) / RIG.fx
        + coefficients[2] * (v - RIG.cy) / RIG.fy
    )


def planted(disparity: Disparity, coefficients: F64) -> Disparity:
    return replace(disparity, values=(disparity.values + field(coefficients)).astype(np.float32))


def measured(disparity: Disparity, plane: Plane, rig: Rig = RIG, site: Site = SITE) -> Registration:
    found = register(disparity, rig, plane, site, CONFIG)
    assert found is not None
    return found


@given(
    st.floats(-0.3, 0.3), st.floats(0, np.pi), st.integers(0, 1000), st.sampled_from([(), LUMPS])
)
@settings(max_examples=15, deadline=None)
def test_bars_at_their_place_are_measured_there(
    tilt: float, yaw: float, seed: int, lumps: tuple
) -> None:
    screen = replace(WIDE, tilt=tilt, yaw=yaw, seed=seed, lumps=lumps)
    found = measured(seen(screen), screen.plane)
    assert abs(found.offset_m) < 0.002
    assert found.tilt_rad < np.radians(0.3)
    assert found.worst_m < 0.03 * OPENING


@given(st.floats(-0.4, 0.4), st.floats(-0.4, 0.4), st.floats(-0.4, 0.4), st.floats(0, np.pi))
@settings(max_examples=15, deadline=None)
def test_a_planted_field_is_measured_and_taken_off(
    constant: float, along_x: float, along_y: float, yaw: float
) -> None:
    screen = replace(WIDE, yaw=yaw, lumps=LUMPS)
    sound, coefficients = seen(screen), np.array([constant, along_x, along_y])
    faulty = planted(sound, coefficients)
    found = measured(faulty, screen.plane)
    left = field(found.field_px - coefficients)
    assert np.abs(left).max() < 0.1
    mended = corrected(faulty, found, RIG)
    assert np.nanmax(np.abs(mended.values - sound.values)) < 0.1
    assert not np.shares_memory(mended.values, faulty.values)
    doubtful = replace(faulty, measured=faulty.values)
    np.testing.assert_array_equal(corrected(doubtful, found, RIG).measured, mended.values)


@pytest.mark.parametrize("factor", [0.97, 0.98, 0.995, 1.005, 1.02, 1.03])
def test_a_wrong_baseline_shows_as_bars_that_are_nearer_or_farther(factor: float) -> None:
    disparity, wrong = seen(WIDE), replace(RIG, baseline_m=factor * RIG.baseline_m)
    found = measured(disparity, WIDE.plane, wrong)
    assert found.offset_m == pytest.approx((1 - factor) * DISTANCE, abs=0.002)
    told = [reason.code for reason in bar_doubts(found, OPENING, HEALTH)]
    assert told == (
        ["SCREEN_MOVED"]
        if abs(1 - factor) * DISTANCE
        > max(HEALTH.max_bar_shift * OPENING, HEALTH.max_bar_shift_px * found.px_m)
        + 2 * found.sigma_m
        else []
    )
    depth = wrong.depth(corrected(disparity, found, wrong).values)
    true = draw(replace(WIDE, noise_px=0.0))[0].xyz[..., 2]
    bars = np.abs(WIDE.plane.height(draw(replace(WIDE, noise_px=0.0))[0].xyz)) < 0.001
    assert abs(np.median((depth - true)[bars])) < 0.003


@given(st.floats(-0.4, 0.4), st.floats(-3, 3), st.floats(0, np.pi), st.integers(-3, 3))
@settings(max_examples=15, deadline=None)
def test_bars_beside_a_known_one_are_told(
    slid: float, turned_deg: float, yaw: float, number: int
) -> None:
    """The site knows one bar, whichever it is; the others lie a share of a pitch to its side."""
    screen = replace(WIDE, yaw=yaw, lumps=LUMPS)
    along, across, normal = screen.axes
    point = np.array([0, 0, DISTANCE]) + (number - slid) * PITCH * across
    angle = np.radians(turned_deg)
    direction = np.cos(angle) * along - np.sin(angle) * np.cross(normal, along)
    site = replace(SITE, bar=BarLine(point, direction))
    found = measured(seen(screen), screen.plane, site=site)
    assert found.slide_m is not None
    assert found.turn_rad is not None
    assert abs(found.slide_m) == pytest.approx(abs(slid) * PITCH, abs=0.03 * OPENING)
    assert np.degrees(found.turn_rad) == pytest.approx(turned_deg, abs=0.5)
    told = [reason.code for reason in bar_doubts(found, OPENING, HEALTH)]
    if abs(slid) * PITCH > 0.14 * OPENING or abs(turned_deg) > 1.5:
        assert told == ["SCREEN_MOVED"]
    if abs(slid) * PITCH < 0.06 * OPENING and abs(turned_deg) < 0.5:
        assert told == []


def test_in_a_grid_the_known_bar_is_of_those_that_run_its_way() -> None:
    screen = replace(WIDE, yaw=0.4, cross=1.5 * OPENING)
    along, across, _ = screen.axes
    for direction, side in ((along, across), (across, along)):
        point = np.array([0, 0, DISTANCE]) + 0.03 * side
        site = replace(SITE, cross_opening_m=screen.cross, bar=BarLine(point, direction))
        found = measured(seen(screen), screen.plane, site=site)
        assert found.slide_m is not None
        assert found.turn_rad is not None
        assert abs(found.slide_m) == pytest.approx(0.03, abs=0.01)
        assert abs(np.degrees(found.turn_rad)) < 0.5


def test_few_bars_at_one_end_tell_little_of_the_other() -> None:
    """Ore hides the rest of the screen: a little tilt of what is left lifts its far end by much."""
    whole, half = seen(WIDE), seen(WIDE)
    half.values[:, 120:] += np.float32(25.0)
    near, far = measured(whole, WIDE.plane), measured(half, WIDE.plane)
    assert far.sigma_m > 4 * near.sigma_m
    assert list(bar_doubts(near, OPENING, HEALTH)) == []
    worse = replace(far, sigma_m=HEALTH.max_bar_shift * OPENING)
    assert [reason.code for reason in bar_doubts(worse, OPENING, HEALTH)] == ["SCREEN_UNSURE"]


@given(st.floats(0, np.pi), st.integers(0, 1000))
@settings(max_examples=10, deadline=None)
def test_the_plane_is_off_by_no_more_than_some_of_its_deviations(yaw: float, seed: int) -> None:
    screen = replace(WIDE, yaw=yaw, seed=seed, lumps=LUMPS)
    found = measured(seen(screen), screen.plane)
    assert 0.0 < found.sigma_m < 0.004
    assert found.worst_m < 5 * found.sigma_m + 0.001


def unmeasured(screen: Screen, opening_m: float = OPENING) -> list[str]:
    surface, _ = draw(screen)
    reasons = unmeasured_doubts(surface, screen.plane, opening_m, CONFIG, HEALTH)
    return [reason.code for reason in reasons]


def test_a_screen_that_one_sees_through_must_show_its_bars() -> None:
    """Asked where nothing was registered: single depths tell the plane to 37 mm here."""
    assert unmeasured(WIDE) == ["SCREEN_UNSURE"]
    assert unmeasured(replace(WIDE, bars=False)) == []
    assert unmeasured(WIDE, opening_m=4 * OPENING) == []


def test_without_bars_nothing_is_measured_and_nothing_corrected() -> None:
    floor = replace(WIDE, bars=False)
    assert register(seen(floor), RIG, floor.plane, SITE, CONFIG) is None
    assert corrected(seen(floor), None, RIG).values is not None
    assert list(bar_doubts(None, OPENING, HEALTH)) == []


@pytest.mark.parametrize("openings", [-1.2, -0.9, -0.6, 0.6, 0.9, 1.2])
def test_bars_that_are_too_far_from_their_place_to_be_put_right_are_told(openings: float) -> None:
    """Seen at hard_0712 with 0.4 px of offset: beyond the first search nothing was registered, the
    frame was ok, and two of six targets were wrong.
    """
    far = Plane(WIDE.plane.normal, WIDE.plane.offset + openings * OPENING)
    found = measured(seen(WIDE), far)
    assert abs(found.offset_m) == pytest.approx(abs(openings) * OPENING, abs=0.003)
    assert [reason.code for reason in bar_doubts(found, OPENING, HEALTH)] == ["SCREEN_MOVED"]


def test_an_unknown_opening_is_no_obstacle() -> None:
    assert abs(measured(seen(WIDE), WIDE.plane, site=Site()).offset_m) < 0.002


def rows_told(disparity: Disparity) -> tuple[np.ndarray, list[str]]:
    screen = replace(ACROSS, lumps=LUMPS)
    surface, _ = draw(screen)
    grizzly = find(surface, replace(SITE, plane=screen.plane), CONFIG)
    parts = judge_parts(disparity, RIG, grizzly, None)
    assert parts is not None
    return parts.rows, [reason.code for reason in row_doubts(parts, HEALTH)]


def test_sound_rows_are_not_told() -> None:
    rows, codes = rows_told(seen(replace(ACROSS, lumps=LUMPS)))
    assert (rows.sum(), codes) == (0, [])


def test_rows_that_swing_alike_in_both_eyes_are_told() -> None:
    sound = seen(replace(ACROSS, lumps=LUMPS))
    swing = np.rint(12 * np.sin(np.arange(RIG.height) / 25)).astype(int)
    values = np.stack([np.roll(row, by) for row, by in zip(sound.values, swing, strict=True)])
    rows, codes = rows_told(replace(sound, values=values))
    assert codes == ["PARTS_DISAGREE"]
    assert 0.2 < rows.mean() < 0.9
    assert rows_told(replace(sound, values=np.roll(sound.values, 2, 1)))[1] == []


def test_a_floor_beside_the_screen_is_no_row_of_bars() -> None:
    """Seen at paper_0711: the comb goes on over the floor on which the table stands."""
    disparity = seen(replace(ACROSS, lumps=LUMPS))
    v, u = np.mgrid[: RIG.height, : RIG.width]
    rays = RIG.back_project(u, v, np.ones(u.shape))
    floor = RIG.disparity(ACROSS.plane.offset / (rays @ ACROSS.plane.normal)) - 9.0
    hidden = np.random.default_rng(0).random(floor.shape) < 0.45
    disparity.values[:40] = np.where(hidden, np.nan, floor)[:40]
    assert rows_told(disparity)[1] == []


@pytest.mark.parametrize("shift_px", [-3.0, 2.0, 6.0])
def test_rows_that_slipped_are_told_and_no_others(shift_px: float) -> None:
    disparity = seen(replace(ACROSS, lumps=LUMPS))
    disparity.values[100:160] += np.float32(shift_px)
    rows, codes = rows_told(disparity)
    assert codes == ["PARTS_DISAGREE"]
    assert rows[55:75].all()
    assert not rows[:45].any()
    assert not rows[85:].any()


def test_a_lump_on_the_comb_or_in_a_doubtful_row_is_no_target() -> None:
    screen = replace(ACROSS, lumps=LUMPS)
    surface, labels = draw(screen)
    grizzly = find(surface, replace(SITE, plane=screen.plane), CONFIG)
    disparity = seen(screen)
    disparity.values[280:] += np.float32(3.0)
    parts = judge_parts(disparity, RIG, grizzly, None)
    assert parts is not None
    height = np.abs(screen.plane.height(surface.xyz))
    labels[(height < 0.001) & (np.arange(RIG.height)[:, None] < 60)] = 3
    labels[284:, :60], labels[284:, 80:140] = 4, 5
    strike = Strike(np.zeros(3), np.array([0, 0, 1.0]), 0.0, 0.0, 1.0)
    plans = [StrikePlan((strike,))] * 4 + [StrikePlan((), (Reason("TOO_STEEP", "before"),))]
    long, short = (Sized(np.array([length, 0.1, 0.1])) for length in (1.5 * OPENING, 0.7 * OPENING))
    kept = without_doubtful(plans, [long] * 5, OreMap(labels), disparity, grizzly, parts)
    assert [bool(plan.strikes) for plan in kept] == [True, True, False, False, False]
    assert [[reason.code for reason in plan.reasons] for plan in kept[2:]] == [
        ["ON_BARS"],
        ["IN_BAD_ROWS"],
        ["TOO_STEEP"],
    ]
    assert without_doubtful(plans, [long] * 5, OreMap(labels), disparity, grizzly, None) == tuple(
        plans
    )
    assert without_doubtful(plans, [short] * 5, OreMap(labels), disparity, grizzly, parts)[
        2
    ].strikes
