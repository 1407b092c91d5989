from dataclasses import replace

import numpy as np
import pytest
from analytic import Ellipsoid, View, look_down
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stereo_ore.config.models import SolidConfig
from stereo_ore.planes import fit_planes
from stereo_ore.stages.solid import (
    is_oversize,
    looks,
    over_hole,
    prior,
    solids,
    unknown_within,
)
from stereo_ore.stages.solid.cues import gather_cues
from stereo_ore.stages.solid.measure import (
    IN_PLANE_TURNS,
    convex_body,
    longest_calliper,
    smallest_box,
)
from stereo_ore.stages.solid.sight import look_at_lumps
from stereo_ore.types import OreMap, Rig, Solid

CONFIG = SolidConfig()
BOULDER = Ellipsoid((0.10, 0.08, 0.06), (0.02, 0.01, 0.06))
PAIR = [BOULDER, Ellipsoid((0.06, 0.05, 0.04), (-0.18, 0.05, 0.04))]


def solve(view: View, config: SolidConfig = CONFIG) -> list[Solid]:
    found = solids(view.surface, view.ore_map, view.grizzly, config)
    assert all(solid is not None for solid in found)
    return [solid for solid in found if solid is not None]


@pytest.mark.parametrize("pitch", [45.0, 60.0, 75.0, 89.0])
@pytest.mark.parametrize("bars", [False, True])
def test_a_resting_ellipsoid_is_completed(pitch: float, bars: bool) -> None:
    view = look_down([BOULDER], pitch, bars=bars)
    solid = solve(view)[0]
    error = np.linalg.norm(solid.centre_of_gravity - view.to_camera(BOULDER.centre))
    volume = 4 / 3 * np.pi * np.prod(BOULDER.radii)
    visible = view.surface.xyz[view.ore_map.labels == 1].mean(0)
    assert error < 0.08 * 0.2
    assert error < 0.5 * np.linalg.norm(visible - view.to_camera(BOULDER.centre))
    assert solid.volume_bounds_m3[0] < volume < solid.volume_bounds_m3[1]
    np.testing.assert_allclose(solid.size_m, [0.2, 0.16, 0.12], rtol=0.25)


def test_numbers_are_consistent_with_each_other() -> None:
    for solid in solve(look_down(PAIR)):
        low, high = solid.volume_bounds_m3
        assert 0 < low < solid.volume_m3 < high
        assert (np.diff(solid.size_m) <= 0).all()
        assert (solid.sigma_m > 0).all()
        np.testing.assert_allclose(solid.axes @ solid.axes.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(solid.axes) == pytest.approx(1.0)
        hull = convex_body(solid.vertices.astype(float))
        assert hull is not None
        assert hull.volume == pytest.approx(solid.volume_m3, rel=1e-3)
        np.testing.assert_allclose(hull.centroid, solid.centre_of_gravity, atol=1e-4)


@given(scale=st.floats(0.2, 20.0))
@settings(deadline=None, max_examples=6)
def test_lengths_scale(scale: float) -> None:
    one, other = solve(look_down([BOULDER]))[0], solve(look_down([BOULDER], scale=scale))[0]
    np.testing.assert_allclose(other.centre_of_gravity, scale * one.centre_of_gravity, rtol=1e-3)
    np.testing.assert_allclose(other.size_m, scale * one.size_m, rtol=1e-3)
    assert other.volume_m3 == pytest.approx(scale**3 * one.volume_m3, rel=5e-3)


def test_a_crop_gives_the_same_as_the_whole_image() -> None:
    view = look_down(PAIR)
    rows, columns = slice(60, 440), slice(80, 600)
    crop = replace(
        view.surface, xyz=view.surface.xyz[rows, columns], bgr=view.surface.bgr[rows, columns],
        sigma_z=view.surface.sigma_z[rows, columns], x0=80, y0=60,
    )  # fmt: skip
    for one, other in zip(solve(view), solve(replace(view, surface=crop)), strict=True):
        np.testing.assert_allclose(one.centre_of_gravity, other.centre_of_gravity, atol=1e-6)
        assert one.volume_m3 == pytest.approx(other.volume_m3)


def test_a_lump_that_rests_on_another_is_not_grown_down_to_the_screen() -> None:
    base = Ellipsoid((0.16, 0.16, 0.05), (0.0, 0.0, 0.05))
    top = Ellipsoid((0.06, 0.05, 0.04), (0.0, -0.02, 0.135))
    view = look_down([base, top], 65.0)
    solid = solve(view)[1]
    height = view.grizzly.plane.height(solid.centre_of_gravity)
    assert 0.11 < height < 0.15
    assert solid.volume_m3 == pytest.approx(4 / 3 * np.pi * np.prod(top.radii), rel=0.5)


def test_what_can_not_be_made_is_none_and_keeps_its_place() -> None:
    view = look_down(PAIR)
    labels = view.ore_map.labels.copy()
    labels[labels == 1] = 0
    labels[10:13, 10:13] = 1
    found = solids(view.surface, OreMap(labels), view.grizzly, CONFIG)
    assert found[0] is None
    assert found[1] is not None
    blind = view.surface.xyz.copy()
    blind[view.ore_map.labels == 2] = np.nan
    found = solids(replace(view.surface, xyz=blind), view.ore_map, view.grizzly, CONFIG)
    assert found[0] is not None
    assert found[1] is None
    assert solids(view.surface, OreMap(np.zeros_like(labels)), view.grizzly, CONFIG) == ()


def test_holes_and_wild_points_change_little() -> None:
    view = look_down([BOULDER])
    rng = np.random.default_rng(0)
    xyz = view.surface.xyz.copy()
    xyz[rng.random(xyz.shape[:2]) < 0.3] = np.nan
    wild = rng.random(xyz.shape[:2]) < 0.003
    xyz[wild] *= rng.uniform(0.9, 1.1, (int(wild.sum()), 1)).astype(np.float32)
    one, other = solve(view)[0], solve(replace(view, surface=replace(view.surface, xyz=xyz)))[0]
    assert np.linalg.norm(one.centre_of_gravity - other.centre_of_gravity) < 0.01
    assert other.volume_m3 == pytest.approx(one.volume_m3, rel=0.3)


@pytest.mark.parametrize(
    ("factor", "expected"), [(0.7, True), (1.3, False), (1.0, None), (None, None)]
)
def test_oversize_has_a_margin(factor: float | None, expected: bool | None) -> None:
    view = look_down([BOULDER])
    opening = None if factor is None else factor * float(solve(view)[0].size_m[1])
    middle = solve(replace(view, grizzly=replace(view.grizzly, opening_m=opening)))[0]
    assert middle.oversize is expected


def test_a_cut_lump_is_uncertain_and_never_called_small() -> None:
    view = look_down([BOULDER])
    whole = solve(view)[0]
    cut = solve(replace(view, ore_map=replace(view.ore_map, cut=frozenset({1}))))[0]
    assert (cut.sigma_m > 1.5 * whole.sigma_m).all()
    assert [reason.code for reason in cut.reasons] == ["CUT_BY_IMAGE"]
    wide = replace(
        view,
        grizzly=replace(view.grizzly, opening_m=1.0),
        ore_map=replace(view.ore_map, cut=frozenset({1})),
    )
    assert solve(wide)[0].oversize is None


def test_equal_input_gives_equal_bytes_and_stays_as_it_was() -> None:
    view = look_down(PAIR, bars=True)
    before = view.surface.xyz.copy()
    one, other = solve(view), solve(view)
    for a, b in zip(one, other, strict=True):
        assert a.centre_of_gravity.tobytes() == b.centre_of_gravity.tobytes()
        assert a.vertices.tobytes() == b.vertices.tobytes()
    np.testing.assert_array_equal(before, view.surface.xyz)


@given(seed=st.integers(0, 10_000))
@settings(deadline=None, max_examples=20)
def test_a_turned_cuboid_is_measured(seed: int) -> None:
    rng = np.random.default_rng(seed)
    dims = np.sort(rng.uniform(0.1, 1.0, 3))[::-1]
    corners = (np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), -1).reshape(-1, 3) - 0.5) * dims
    shift = rng.normal(size=3)
    body = convex_body(corners @ Rotation.random(random_state=seed).as_matrix().T + shift)
    assert body is not None
    box = smallest_box(body)
    centre, axes, extent = box.centre, box.axes, box.extent
    assert body.volume == pytest.approx(dims.prod())
    np.testing.assert_allclose(body.centroid, shift, atol=1e-9)
    np.testing.assert_allclose(centre, shift, atol=1e-2)
    # The box is searched in steps of angle: half a step off, a side of length b grows by a·sin, one
    # of a by b·sin.
    off, ratio = np.pi / (4 * IN_PLANE_TURNS), dims[0] / dims[2]
    worst = (np.cos(off) + ratio * np.sin(off)) * (np.cos(off) + np.sin(off) / ratio)
    assert dims.prod() * (1 - 1e-9) <= extent.prod() <= dims.prod() * worst
    assert np.linalg.det(axes) == pytest.approx(1.0)
    assert longest_calliper(body.vertices) == pytest.approx(np.linalg.norm(dims))


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((0, 3)),
        np.zeros((9, 3)),
        np.eye(3),
        np.random.default_rng(0).random((9, 3)) * [1, 1, 0],
    ],
)
def test_points_without_volume_are_no_body(points: np.ndarray) -> None:
    assert convex_body(points) is None


@given(a=st.floats(-0.5, 0.5), b=st.floats(-0.5, 0.5), z=st.floats(0.5, 5.0))
@settings(deadline=None, max_examples=20)
def test_plane_fields_are_exact_on_planes(a: float, b: float, z: float) -> None:
    rig = Rig(60, 40, 300.0, 310.0, 25.0, 18.0, 0.12)
    normal = np.array([a, b, -1.0]) / np.linalg.norm([a, b, -1.0])
    v, u = np.mgrid[:40, :60]
    rays = rig.back_project(u, v, np.ones(u.shape))
    depth = -z / (rays @ normal)
    weight, everywhere = np.ones(u.shape, np.float32), np.ones(u.shape, bool)
    weight[5:9, 7:9] = 0
    field = fit_planes(np.where(weight > 0, depth, np.nan).astype(np.float32), weight, 7, rig)
    np.testing.assert_allclose(field.depth(everywhere), depth.ravel(), rtol=1e-5)
    np.testing.assert_allclose(
        field.normal(everywhere), np.broadcast_to(normal, (u.size, 3)), atol=2e-3
    )
    assert field.rms.max() < 2e-4 * z


def test_the_shipped_coefficients_fit_the_cues() -> None:
    view = look_down([BOULDER], bars=True)
    box = (slice(100, 400), slice(150, 500))
    sight = look_at_lumps(view.surface, view.ore_map.labels, box, 1, view.grizzly.plane, 30)
    assert sight is not None
    cues = gather_cues(sight, view.grizzly.bars, view.grizzly.opening_m)
    assert cues is not None
    shipped = prior.load_prior()
    assert set(shipped.even) == set(cues.even)
    assert set(shipped.odd) == set(cues.odd)
    assert np.isfinite(shipped(np.zeros((1, len(shipped.mean))))).all()
    assert (shipped.scale > 0.001).all()


def test_a_mirrored_lump_gives_a_mirrored_answer() -> None:
    """The view of an upright camera, its columns but the first turned round: the principal point is
    in the middle."""
    view = look_down(PAIR)
    assert view.surface.rig.cx == view.surface.rig.width / 2
    flipped = np.ascontiguousarray(view.surface.xyz[:, :0:-1] * np.array([-1, 1, 1], np.float32))
    sigma_z = np.ascontiguousarray(view.surface.sigma_z[:, :0:-1])
    surface = replace(view.surface, xyz=flipped, sigma_z=sigma_z, bgr=view.surface.bgr[:, 1:], x0=1)
    labels = view.ore_map.labels.copy()
    labels[:, 1:] = labels[:, :0:-1].copy()
    for one, other in zip(
        solve(view), solve(replace(view, surface=surface, ore_map=OreMap(labels))), strict=True
    ):
        np.testing.assert_allclose(
            other.centre_of_gravity, one.centre_of_gravity * [-1, 1, 1], atol=2e-3
        )
        assert other.volume_m3 == pytest.approx(one.volume_m3, rel=0.03)


def test_a_bar_in_the_silhouette_changes_little() -> None:
    """A strip as wide as a bar, at the height of the screen, that the segmentation left on a
    lump."""
    view = look_down([BOULDER])
    labels = view.ore_map.labels.copy()
    rows, columns = np.nonzero(labels == 1)
    middle, width = int(np.median(columns)), max(2, round(0.08 * np.sqrt(len(rows))))
    labels[
        rows.max() - 3 : rows.max() + round(0.4 * np.sqrt(len(rows))), middle : middle + width
    ] = 1
    assert (labels == 1).sum() > 1.02 * len(rows)
    one, other = solve(view)[0], solve(replace(view, ore_map=OreMap(labels)))[0]
    assert np.linalg.norm(one.centre_of_gravity - other.centre_of_gravity) < 0.005
    assert other.volume_m3 == pytest.approx(one.volume_m3, rel=0.05)


def test_looks_are_those_of_the_solids() -> None:
    view = look_down(PAIR)
    for looked, solid in zip(
        looks(view.surface, view.ore_map, view.grizzly, CONFIG), solve(view), strict=True
    ):
        assert looked is not None
        sight, cues = looked
        mean = prior.load_prior().estimate(cues.even, cues.odd).mean
        centre = np.array([mean[axis] for axis in "xyz"]) * sight.size + [0.0, 0.0, cues.support]
        np.testing.assert_allclose(sight.to_camera(centre), solid.centre_of_gravity, atol=1e-9)


def test_cues_are_held_within_reach_and_a_mirrored_lump_gives_a_mirrored_answer() -> None:
    rng = np.random.default_rng(5)
    outputs = 2 * len(prior.TARGETS)
    network = prior.Prior(
        ("a", "b"), ("c",), np.array([1.0, 2.0, 0.0]), np.array([2.0, 1.0, 0.5]),
        *(rng.normal(size=shape) for shape in ((3, outputs), (3, 8), 8, (8, outputs), outputs)),
    )  # fmt: skip
    far, edge = ({"a": 1 + 2 * n, "b": 2.0 - n} for n in (99.0, prior.REACH))
    one, other = (network.estimate(even, {"c": 0.2}) for even in (far, edge))
    assert one == other
    mirrored = network.estimate(edge, {"c": -0.2})
    assert mirrored.sigma == pytest.approx(one.sigma)
    assert mirrored.mean == pytest.approx(one.mean | {"y": -one.mean["y"]})
    assert abs(one.mean["y"]) > 0.01


@pytest.mark.parametrize(("sigma", "expected"), [(0.01, 0.03), (0.4, np.expm1(0.1))])
def test_a_doubtful_size_leaves_more_unknown(sigma: float, expected: float) -> None:
    assert unknown_within(np.exp([-2 * sigma, 2 * sigma]), CONFIG) == pytest.approx(expected)
    assert unknown_within([0.0, 1.0], CONFIG) > 1


# --- what passes a hole


@pytest.mark.parametrize(
    ("size", "openings", "ratio"),
    [
        ((0.9, 0.3, 0.1), (0.3,), 1.0),
        ((0.9, 0.3, 0.3), (0.3, 0.3), 1.0),
        # On edge and turned by 45°, a flat lump passes a square that is smaller than it is wide.
        ((0.9, 0.4, 0.1), (0.3, 0.3), np.hypot(0.4, 0.1) / np.hypot(0.3, 0.3)),
        ((0.9, 0.4, 0.1), (0.4, 0.3), np.hypot(0.4, 0.1) / 0.5),
        ((0.9, 0.35, 0.32), (0.3, 0.6), 0.32 / 0.3),
        ((0.9, 0.35, 0.32), (0.6, 0.3), 0.32 / 0.3),
    ],
)
def test_a_hole_stops_what_no_turn_lets_through(
    size: tuple[float, ...], openings: tuple[float, ...], ratio: float
) -> None:
    assert over_hole(size, openings) == pytest.approx(ratio)
    larger = tuple(1.04 * ratio * side for side in openings)
    smaller = tuple(0.96 * ratio * side for side in openings)
    assert is_oversize(size, larger, False, 0.03) is False
    assert is_oversize(size, smaller, False, 0.03) is True
    assert is_oversize(size, larger, True, 0.03) is None
    assert is_oversize(size, None, False, 0.03) is None


@given(st.floats(0.05, 1), st.floats(0.05, 1), st.floats(0.1, 1), st.floats(0.1, 1))
@settings(deadline=None)
def test_an_ellipse_passes_a_rectangle_at_some_turn_or_not(
    one: float, other: float, a: float, b: float
) -> None:
    """The equation against all turns of the ellipse, one by one."""
    middle, shortest = max(one, other), min(one, other)
    turns = np.linspace(0, np.pi / 2, 2001)
    wide = np.hypot(middle * np.cos(turns), shortest * np.sin(turns))
    high = np.hypot(middle * np.sin(turns), shortest * np.cos(turns))
    fits = np.maximum(wide / max(a, b), high / min(a, b)).min()
    ratio = over_hole((1.0, middle, shortest), (a, b))
    if abs(fits - 1) > 0.01:
        assert (ratio > 1) == (fits > 1)
