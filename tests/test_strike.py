from dataclasses import replace

import numpy as np
import pytest
from analytic import Ellipsoid, View, look_down
from hypothesis import given, settings
from hypothesis import strategies as st

from stereo_ore.config.models import SolidConfig, StrikeConfig
from stereo_ore.stages.solid import solids
from stereo_ore.stages.strike import plans
from stereo_ore.types import Site, Solid, StrikePlan

CONFIG = StrikeConfig()
FLAT_TOP = Ellipsoid((0.14, 0.12, 0.06), (0.02, 0.01, 0.06))
SITE = Site()


def plan(view: View, config: StrikeConfig = CONFIG, site: Site = SITE) -> StrikePlan:
    found = solids(view.surface, view.ore_map, view.grizzly, SolidConfig())
    return plans(view.surface, view.ore_map, found, view.grizzly, site, config)[0]


def true_normal(view: View, lump: Ellipsoid, point: np.ndarray) -> np.ndarray:
    R, t = view.T_camera_screen[:3, :3], view.T_camera_screen[:3, 3]
    gradient = (R.T @ (point - t) - lump.centre) / np.square(lump.radii)
    return R @ (gradient / np.linalg.norm(gradient))


def code(found: StrikePlan) -> str:
    assert found.strikes == ()
    (reason,) = found.reasons
    return reason.code


@pytest.mark.parametrize("pitch", [50.0, 70.0, 89.0])
def test_the_strike_lies_on_the_lump_and_points_into_it(pitch: float) -> None:
    view = look_down([FLAT_TOP], pitch)
    strikes = plan(view).strikes
    for strike in strikes:
        inside = (
            view.T_camera_screen[:3, :3].T @ (strike.point - view.T_camera_screen[:3, 3])
            - FLAT_TOP.centre
        )
        assert np.linalg.norm(inside / FLAT_TOP.radii) == pytest.approx(1.0, abs=0.03)
        normal = true_normal(view, FLAT_TOP, strike.point)
        assert strike.direction @ -normal > np.cos(np.radians(6))
        assert np.linalg.norm(strike.direction) == pytest.approx(1.0)
        assert strike.slope_rad <= CONFIG.max_slope_rad
        assert strike.slope_rad == pytest.approx(
            np.arccos(-strike.direction @ view.grizzly.plane.normal), abs=1e-6
        )
        u, v = np.rint(view.surface.rig.project(strike.point)).astype(int)
        assert view.ore_map.labels[v, u] == 1
    lever = strikes[0].point - view.to_camera(FLAT_TOP.centre)
    lever -= (lever @ view.grizzly.plane.normal) * view.grizzly.plane.normal
    assert np.linalg.norm(lever) < 0.05


def test_a_lump_too_far_to_be_measured_is_no_target() -> None:
    """Seen at hard_0815: at 4.7 m a pixel of disparity of a VGA eye is 0.7 m."""
    view = look_down([FLAT_TOP])
    share = float(np.nanmedian(view.surface.sigma_z / view.surface.xyz[..., 2]))
    assert code(plan(view, replace_config(max_depth_sigma=0.7 * share))) == "UNCERTAIN_DEPTH"
    assert plan(view, replace_config(max_depth_sigma=1.1 * share)).strikes


def test_alternates_are_ranked_and_apart() -> None:
    strikes = plan(look_down([FLAT_TOP])).strikes
    assert len(strikes) == 1 + CONFIG.alternates
    scores = [strike.score for strike in strikes]
    assert scores == sorted(scores, reverse=True)
    assert all(0 < score <= 1 for score in scores)
    points = np.array([strike.point for strike in strikes])
    apart = np.linalg.norm(points[:, None] - points[None], axis=-1)[np.triu_indices(len(points), 1)]
    assert apart.min() >= 1.5 * CONFIG.tool_diameter_m
    assert len(plan(look_down([FLAT_TOP]), replace_config(alternates=0)).strikes) == 1


def replace_config(**changes: float) -> StrikeConfig:
    return CONFIG.model_copy(update=changes)


@given(clearance=st.floats(0.0, 0.06))
@settings(deadline=None, max_examples=8)
def test_clearance_is_kept_from_the_outline(clearance: float) -> None:
    view = look_down([FLAT_TOP], 80.0)
    strikes = plan(view, replace_config(clearance_m=clearance)).strikes
    outside = view.surface.xyz[view.ore_map.labels == 0].astype(float)
    rays = outside / outside[:, 2:]
    for strike in strikes:
        gap = strike.point[2] * np.linalg.norm(rays - strike.point / strike.point[2], axis=1).min()
        assert gap >= 0.5 * CONFIG.tool_diameter_m + clearance - 0.005


def test_why_there_is_no_strike() -> None:
    view = look_down([FLAT_TOP])
    assert code(plan(view, replace_config(max_slope_rad=1e-4))) == "TOO_STEEP"
    assert code(plan(view, replace_config(tool_diameter_m=0.4))) == "NEAR_EDGE"
    rough = view.surface.xyz.copy()
    rough *= 1 + 0.015 * np.random.default_rng(0).standard_normal(rough.shape[:2])[
        ..., None
    ].astype(np.float32)
    assert code(plan(replace(view, surface=replace(view.surface, xyz=rough)))) == "TOO_SMALL_PATCH"
    holes = view.surface.xyz.copy()
    holes[np.random.default_rng(0).random(holes.shape[:2]) < 0.6] = np.nan
    assert code(plan(replace(view, surface=replace(view.surface, xyz=holes)))) == "UNCERTAIN_DEPTH"


def test_reach_is_a_box_in_the_arm_frame() -> None:
    view = look_down([FLAT_TOP])
    T_arm_camera = np.linalg.inv(view.T_camera_screen)
    site = Site(
        T_arm_camera=T_arm_camera,
        reach_min_m=np.array([0.03, -1, -1]),
        reach_max_m=np.array([1.0, 1, 1]),
    )
    strikes = plan(view, site=site).strikes
    assert strikes
    assert all((T_arm_camera @ [*strike.point, 1])[0] >= 0.03 for strike in strikes)
    assert (
        code(plan(view, site=replace(site, reach_min_m=np.array([0.5, -1, -1])))) == "OUT_OF_REACH"
    )


def test_bars_are_kept_off() -> None:
    sunk = Ellipsoid((0.10, 0.10, 0.04), (0.0, 0.0, -0.03))
    view = look_down([sunk], 80.0)
    below = replace(
        view,
        grizzly=replace(
            view.grizzly, plane=replace(view.grizzly.plane, offset=view.grizzly.plane.offset + 0.05)
        ),
    )
    assert code(plan(below)) == "NEAR_EDGE"


def test_lumps_without_a_solid_or_pixels_keep_their_place() -> None:
    view = look_down([FLAT_TOP, Ellipsoid((0.06, 0.06, 0.05), (-0.25, 0.0, 0.05))])
    found: list[Solid | None] = list(
        solids(view.surface, view.ore_map, view.grizzly, SolidConfig())
    )
    found[0] = None
    first, second = plans(view.surface, view.ore_map, found, view.grizzly, SITE, CONFIG)
    assert code(first) == "UNCERTAIN_DEPTH"
    assert second.strikes
    assert plans(view.surface, view.ore_map, [], view.grizzly, SITE, CONFIG) == ()


def test_noise_widens_the_window_and_steadies_the_direction() -> None:
    view = look_down([FLAT_TOP], 80.0)
    noise = view.surface.sigma_z * np.random.default_rng(3).standard_normal(
        view.surface.sigma_z.shape
    )
    xyz = view.surface.xyz * (1 + noise / view.surface.xyz[..., 2])[..., None].astype(np.float32)
    strike = plan(replace(view, surface=replace(view.surface, xyz=xyz.astype(np.float32)))).strikes[
        0
    ]
    assert strike.direction @ -true_normal(view, FLAT_TOP, strike.point) > np.cos(np.radians(8))


def test_equal_input_gives_equal_bytes() -> None:
    view = look_down([FLAT_TOP])
    one, other = plan(view).strikes, plan(view).strikes
    assert [a.point.tobytes() + a.direction.tobytes() for a in one] == [
        b.point.tobytes() + b.direction.tobytes() for b in other
    ]


@given(seed=st.integers(0, 10_000))
@settings(deadline=None, max_examples=15)
def test_no_surface_breaks_it(seed: int) -> None:
    """Random labels over random depths with holes: whatever comes out is finite."""
    rng = np.random.default_rng(seed)
    view = look_down([FLAT_TOP], float(rng.uniform(45, 89)))
    labels = np.zeros_like(view.ore_map.labels)
    for number in range(1, int(rng.integers(2, 9))):
        (v, u), (h, w) = rng.integers(0, (470, 630)), rng.integers(1, 120, 2)
        labels[v : v + h, u : u + w] = number
    xyz = view.surface.xyz * rng.uniform(0.5, 2.0, (480, 640, 1)).astype(np.float32) ** int(
        rng.integers(0, 2)
    )
    xyz[rng.random((480, 640)) < rng.uniform(0, 1)] = np.nan
    wild = replace(
        view, surface=replace(view.surface, xyz=xyz), ore_map=replace(view.ore_map, labels=labels)
    )
    found = solids(wild.surface, wild.ore_map, wild.grizzly, SolidConfig())
    for solid, plan in zip(
        found, plans(wild.surface, wild.ore_map, found, wild.grizzly, SITE, CONFIG), strict=True
    ):
        assert plan.strikes or plan.reasons
        assert all(
            np.isfinite([*strike.point, *strike.direction, strike.score]).all()
            for strike in plan.strikes
        )
        if solid is not None:
            assert np.isfinite(
                [*solid.centre_of_gravity, *solid.sigma_m, *solid.size_m, *solid.volume_bounds_m3]
            ).all()


def test_a_face_whose_depths_scatter_more_than_they_may_is_not_struck() -> None:
    """Seen at large_8300: a strike 0.1 m off, where the residual was 2.3 % of the distance, and
    twice the foretold noise 3 %."""
    view = look_down([FLAT_TOP])
    z = view.surface.xyz[..., 2]
    sigma = np.full_like(view.surface.sigma_z, 0.015 * float(np.nanmedian(z)))
    bumps = np.random.default_rng(1).normal(size=z.shape).astype(np.float32)

    def scattered(share: float) -> View:
        xyz = view.surface.xyz * (1 + share * bumps)[..., None]
        return replace(view, surface=replace(view.surface, xyz=xyz, sigma_z=sigma))

    assert plan(scattered(0.012)).strikes
    assert code(plan(scattered(0.026))) == "TOO_SMALL_PATCH"
