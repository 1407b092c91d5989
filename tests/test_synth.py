"""Made-up measurements: is their truth true, and are they the same every time?"""

import json
import os
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest
from conftest import PlanePair, small_spec
from scipy.spatial import ConvexHull
from typer.testing import CliRunner

from stereo_ore import cli
from stereo_ore.errors import ConfigError
from stereo_ore.io.calibration import load
from stereo_ore.io.site import load_site
from stereo_ore.lab import synth
from stereo_ore.lab.synth import mesh, placing, rig, rocks, screen
from stereo_ore.lab.synth.eye import Eye, depth_and_instance
from stereo_ore.lab.synth.model import Model, Part, vertex_normals
from stereo_ore.transforms import inverse, transform_points
from stereo_ore.types import CameraModel


def points_of(scene: synth.Scene) -> np.ndarray:
    """True surface points (H, W, 3) of the rectified left view in the screen frame."""
    K, (h, w) = scene.rectified.K, scene.depth_m.shape
    u, v = np.meshgrid(np.arange(w), np.arange(h))
    z = scene.depth_m.astype(float)
    xyz = np.stack([(u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z, z], -1)
    T_screen_camera = inverse(scene.spec.T_world_screen) @ scene.spec.camera.T_world_left
    return transform_points(T_screen_camera @ scene.rectified.T_left_rectified, xyz)


# --- meshes ---------------------------------------------------------------------------------------


def test_volume_and_centre_of_a_box() -> None:
    volume, centre = mesh.volume_and_centre(mesh.box((1, 2, 3), (2, 4, 6), cell=0.4))
    assert volume == pytest.approx(6)
    assert centre == pytest.approx([1.5, 3, 4.5])


def test_volume_of_a_sphere_converges() -> None:
    exact = 4 / 3 * np.pi
    errors = [abs(mesh.volume_and_centre(mesh.icosphere(n))[0] - exact) for n in (2, 3, 4)]
    assert errors[2] < 0.003 * exact
    assert errors[0] > 3.5 * errors[1] > 12 * errors[2]


def test_callipers_of_a_turned_box() -> None:
    box = mesh.box((0, 0, 0), (0.5, 0.3, 0.2), 1.0)
    turned = box.moved(rocks.random_rotation(np.random.default_rng(2)), np.array([1.0, 2, 3]))
    dims, longest, shortest = mesh.callipers(turned)
    assert dims == pytest.approx([0.5, 0.3, 0.2], rel=0.02)
    assert longest == pytest.approx(np.sqrt(0.25 + 0.09 + 0.04))
    assert shortest == pytest.approx(0.2, rel=1e-6)


@pytest.mark.parametrize("shape", rocks.PROPORTIONS)
def test_a_rock_is_closed_nearly_convex_and_centred(shape: str) -> None:
    rock = rocks.rock(np.random.default_rng(5), shape, 0.4)
    edges = np.sort(rock.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    volume, centre = mesh.volume_and_centre(rock)
    assert centre == pytest.approx(np.zeros(3), abs=1e-9)
    assert 0.85 < volume / ConvexHull(rock.vertices).volume < 1
    assert np.ptp(rock.vertices, axis=0).max() == pytest.approx(0.4)


@pytest.mark.parametrize("shape", rocks.PROPORTIONS)
def test_an_angular_rock_fills_less_of_its_box(shape: str) -> None:
    """Path-traced lumps fill 0.43 to 0.48 of theirs."""

    def filled(angular: bool) -> float:
        made = [
            rocks.rock(np.random.default_rng(seed), shape, 1.0, 3, angular) for seed in range(8)
        ]
        return float(
            np.mean([mesh.volume_and_centre(m)[0] / mesh.callipers(m)[0].prod() for m in made])
        )

    assert 0.42 < filled(angular=True) < 0.52
    assert filled(angular=False) > 0.55


def test_a_lump_falls_onto_the_floor_and_is_supported() -> None:
    field = placing.HeightField.over((0.5, 0.5), 0.01)
    field.add(mesh.box((-0.5, -0.5, -0.2), (0.5, 0.5, 0.1), 0.5))
    rock = rocks.rock(np.random.default_rng(1), "slab", 0.3)
    rng = np.random.default_rng(0)
    R, t = placing.settle(rock, field, np.eye(3)[[2, 0, 1]], np.zeros(2), rng)
    assert (rock.vertices @ R.T + t)[:, 2].min() == pytest.approx(0.1, abs=1e-6)
    assert placing.supported(rock, field, R, t)
    assert not placing.supported(rock, field, R, t + np.array([0, 0, 0.05]))


def test_lumps_sink_neither_into_bars_nor_into_each_other() -> None:
    made = screen.Screen(0.25, 0.08, 0.16, (2.06, 2.0), 0.1, 1, 1.0)
    steel = mesh.merge([screen.bars(made), screen.frame(made)])
    field = placing.HeightField.over((1.15, 1.1), 0.008)
    field.add(steel)
    rng = np.random.default_rng(3)
    stones = [
        rocks.rock(rng, shape, 0.45, 4) for shape in ("block", "slab", "chunk", "long", "chunk")
    ]
    poses = placing.pile(stones, field, (0.6, 0.6), rng, sink_m=-0.08)
    bodies = [steel] + [stones[k].moved(R, t) for k, R, t in poses]
    assert len(bodies) > 3
    for i, body in enumerate(bodies[1:], 1):
        others = mesh.merge(bodies[:i])
        up = np.concatenate([body.vertices, np.tile([0.0, 0.0, 1.0], (len(body.vertices), 1))], 1)
        down = np.concatenate(
            [body.vertices, np.tile([0.0, 0.0, -1.0], (len(body.vertices), 1))], 1
        )
        above, below = (mesh.cast(mesh.ray_caster(others), rays) for rays in (up, down))
        # A vertex inside a body leaves it through a face that points along the ray.
        inside = (
            (above["primitive_normals"][:, 2] > 0)
            & np.isfinite(above["t_hit"])
            & np.isfinite(below["t_hit"])
        )
        assert above["t_hit"][inside].max(initial=0) < 0.015 * 0.45


# --- camera ---------------------------------------------------------------------------------------


def plane_model() -> Model:
    """A square of 4 m in the plane z = 0 of the screen frame."""
    square = mesh.rectangle(
        np.array([-2.0, -2, 0]), np.array([4.0, 0, 0]), np.array([0, 4.0, 0]), 0.5
    )
    part = Part(square, "steel", 1, np.eye(3), np.zeros(3))
    zeros = np.zeros(len(square.triangles), np.int32)
    sky = np.ones(len(square.vertices), np.float32)
    vertices = square.vertices.astype(np.float32)
    return Model((part,), (), vertices, square.triangles, zeros, sky, mesh.ray_caster(square))


def test_depth_of_a_plane_is_exact() -> None:
    camera = synth.Camera(1.5, float(np.radians(65)), yaw=0.3, roll=0.05)
    eye = Eye(CameraModel((300.0, 301.0), (160.0, 90.0)), (320, 180), camera.T_world_left)
    depth, instance = depth_and_instance(plane_model(), eye)
    u, v = np.meshgrid(np.arange(320), np.arange(180))
    rays = (
        np.stack([(u - 160) / 300, (v - 90) / 301, np.ones_like(u)], -1)
        @ camera.T_world_left[:3, :3].T
    )
    exact = -camera.T_world_left[2, 3] / rays[..., 2]
    assert (instance == 1).all()
    assert np.abs(depth / exact - 1).max() < 1e-5


def test_the_camera_looks_at_its_target_from_its_height() -> None:
    camera = synth.Camera(2.0, float(np.radians(50)), yaw=1.0, roll=0.2, target=(0.3, -0.4))
    T = camera.T_world_left
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
    assert T[2, 3] == pytest.approx(2)
    assert transform_points(inverse(T), [0.3, -0.4, 0]) == pytest.approx([0, 0, camera.distance])


def test_rays_of_a_distorted_eye_are_those_its_lens_model_projects_back() -> None:
    spec = synth.sample_spec(3, "raw", "VGA")
    calibration = rig.raw_rig(spec)
    left, right, _ = rig.eyes(
        calibration, rig.reference_rectification(calibration), spec.camera.T_world_left
    )
    for eye in (left, right):
        rays = eye.rays(range(10, 360, 50)).reshape(-1, 6)
        xyz = transform_points(
            inverse(eye.T_screen_eye), rays[:, :3] + 2.0 * rays[:, 3:].astype(float)
        )
        pixels = cv2.projectPoints(
            xyz, np.zeros(3), np.zeros(3), eye.camera.K, np.array(eye.camera.distortion)
        )[0].reshape(-1, 2)
        u, v = np.meshgrid(np.arange(672), np.arange(10, 360, 50))
        assert np.abs(pixels - np.stack([u, v], -1).reshape(-1, 2)).max() < 0.01


def test_the_right_eye_is_where_the_calibration_says() -> None:
    spec = synth.sample_spec(3, "raw", "VGA")
    calibration = rig.raw_rig(spec)
    left, right, straight = rig.eyes(
        calibration, rig.reference_rectification(calibration), np.eye(4)
    )
    point = np.array([0.1, -0.2, 1.5])
    expected = (
        calibration.R_right_left @ transform_points(inverse(left.T_screen_eye), point)
        + calibration.t_right_left
    )
    assert transform_points(inverse(right.T_screen_eye), point) == pytest.approx(expected)
    assert np.linalg.norm(transform_points(inverse(straight.T_screen_eye), point)) == pytest.approx(
        np.linalg.norm(point)
    )


# --- scenes ---------------------------------------------------------------------------------------


def test_the_same_specification_gives_the_same_bytes_on_one_core(
    synth_scene: synth.Scene, synth_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    again = synth.write(synth.scene(synth_scene.spec), tmp_path / synth_folder.name)
    names = sorted(path.name for path in synth_folder.iterdir())
    assert names == [
        "calib.json", "calibration.yaml", "gt.json", "gt.npz", "left.png", "right.png", "site.yaml",
    ]  # fmt: skip
    for name in names:
        assert (again / name).read_bytes() == (synth_folder / name).read_bytes(), name


def test_other_seeds_give_other_scenes() -> None:
    specs = [synth.sample_spec(seed, "large") for seed in range(20)]
    assert len({spec.camera.height for spec in specs}) == 20
    assert len({spec.screen.opening for spec in specs}) > 5


def test_bar_tops_lie_in_the_plane_of_the_screen(empty_scene: synth.Scene) -> None:
    points, spec = points_of(empty_scene)[empty_scene.instance == 1], empty_scene.spec
    assert points[:, 2].max() == pytest.approx(spec.screen.rise, abs=2e-4)
    on_bars = points[np.abs(points[:, 2]) < 5e-4]
    inside = on_bars[(np.abs(on_bars[:, :2]) < np.array(spec.screen.size) / 2 - 1e-3).all(1)]
    nearest = np.abs(inside[:, :1] - spec.screen.bar_centres).min(1)
    assert len(inside) > 1000
    assert nearest.max() < spec.screen.bar_width / 2 + 1e-3


def test_bars_and_openings_fill_the_screen() -> None:
    made = screen.Screen(0.3, 0.08, 0.16, (0.3 * 6 + 0.08 * 5, 3.0), 0.1, 2, 1.0)
    assert len(made.bar_centres) == 5
    assert made.bar_centres[0] - 0.04 + made.size[0] / 2 == pytest.approx(0.3)


def test_the_right_image_shows_what_the_disparity_says(synth_scene: synth.Scene) -> None:
    left, right = (
        cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), (0, 0), 1.0).astype(np.float32)
        for image in (synth_scene.pair.left, synth_scene.pair.right)
    )
    h, w = left.shape
    u, v = np.meshgrid(np.arange(w, dtype=np.float32), np.arange(h, dtype=np.float32))
    ore = cv2.erode((synth_scene.instance >= 2).astype(np.uint8), np.ones((5, 5))) > 0

    def difference(shift: float) -> float:
        warped = cv2.remap(right, u - synth_scene.disparity_px - shift, v, cv2.INTER_LINEAR)
        return float(np.median(np.abs(warped - left)[ore]))

    at = {shift: difference(shift) for shift in (-1.0, -0.3, 0.0, 0.3, 1.0)}
    assert min(at, key=lambda shift: at[shift]) == 0.0
    assert at[0.0] < 0.6 * min(at[-1.0], at[1.0])


def test_lumps_are_where_their_truth_says(synth_scene: synth.Scene) -> None:
    points = points_of(synth_scene)
    assert len(synth_scene.lumps) >= 2
    for lump in synth_scene.lumps:
        seen = points[synth_scene.instance == lump.id]
        centre = transform_points(inverse(synth_scene.spec.T_world_screen), lump.com_world)
        assert len(seen) == lump.visible_pixels == lump.visible_pixels_rectified
        assert np.linalg.norm(seen - centre, axis=1).max() < lump.max_calliper
        assert np.linalg.norm(seen - centre, axis=1).min() > 0.2 * lump.min_calliper
        assert transform_points(
            synth_scene.spec.camera.T_world_left, lump.com_left
        ) == pytest.approx(lump.com_world)
        assert lump.volume_m3 < np.prod(lump.box_dims)
        assert lump.visible_pixels <= lump.unoccluded_pixels
        assert lump.oversize == (lump.box_dims[1] > synth_scene.spec.screen.opening)


def test_touching_is_mutual(synth_scene: synth.Scene) -> None:
    touches = {lump.id: set(lump.touches) for lump in synth_scene.lumps}
    assert all(a in touches[b] for a, others in touches.items() for b in others)


def test_an_empty_scene_has_no_lump(empty_scene: synth.Scene) -> None:
    assert empty_scene.lumps == ()
    assert set(np.unique(empty_scene.instance)) == {0, 1}


def test_families() -> None:
    assert synth.sample_spec(1, "empty").lumps == 0
    assert synth.sample_spec(1, "raw").raw
    assert synth.sample_spec(1, "paper").table
    dark, dust, wet = (synth.sample_spec(seed, "hard") for seed in (3, 4, 5))
    assert dark.sensor.full_well < 1000
    assert dust.haze_per_m > 0
    assert wet.wet == 1


def test_low_light_is_noisier() -> None:
    radiance = np.full((64, 64, 3), 0.3, np.float32)
    from stereo_ore.lab.synth.sensor import expose

    bright, dark = (
        expose(synth.Sensor(full_well=well), radiance, 1.0, np.random.default_rng(0)).std()
        for well in (8000, 500)
    )
    assert dark > 2 * bright


def test_unknown_families_and_sizes_are_named() -> None:
    with pytest.raises(ConfigError, match=r"family.*'huge'.*large, paper, hard, raw, empty"):
        synth.sample_spec(0, "huge")
    with pytest.raises(ConfigError, match=r"size.*'4K'.*VGA"):
        synth.sample_spec(0, "large", "4K")


def test_normals_of_a_sphere_point_outwards() -> None:
    sphere = mesh.icosphere(3)
    assert np.einsum("ij,ij->i", vertex_normals(sphere), sphere.vertices).min() > 0.99


# --- files ----------------------------------------------------------------------------------------


def test_a_scene_folder_is_read_back_by_the_program(
    synth_scene: synth.Scene, synth_folder: Path
) -> None:
    calibration, site = (
        load(synth_folder / "calibration.yaml"),
        load_site(synth_folder / "site.yaml"),
    )
    assert calibration.image_size == (672, 376)
    assert pytest.approx(synth_scene.rectified.K) == calibration.left.K
    assert site.opening_m == synth_scene.spec.screen.opening
    assert site.plane is not None
    assert site.volume is not None
    truth = json.loads((synth_folder / "gt.json").read_text())["screen_plane_left"]
    assert site.plane.normal == pytest.approx(np.array(truth["normal"]))
    assert site.plane.offset * 1000 == pytest.approx(truth["offset_mm"])
    for lump in synth_scene.lumps:
        assert site.volume.contains(lump.com_left)
        assert abs(site.plane.height(lump.com_left)) < lump.max_calliper + 0.3


@pytest.mark.parametrize("raw", [False, True])
def test_the_scoring_tool_reads_a_scene_folder(
    score_tool: ModuleType, synth_scene: synth.Scene, tmp_path: Path, raw: bool
) -> None:
    scene = (
        synth_scene if not raw else synth.scene(replace(small_spec(2), raw=True, supersampling=1))
    )
    folder = synth.write(scene, tmp_path / "scene")
    calib, site = score_tool.write_inputs(folder, tmp_path / "work", False)
    ours, theirs = load(folder / "calibration.yaml"), load(calib)
    assert ours.R_right_left == pytest.approx(theirs.R_right_left)
    assert ours.t_right_left == pytest.approx(theirs.t_right_left)
    assert ours.left.distortion == theirs.left.distortion
    here, there = load_site(folder / "site.yaml"), load_site(site)
    assert here.T_arm_camera == pytest.approx(there.T_arm_camera, abs=1e-7)
    assert here.plane.normal == pytest.approx(there.plane.normal, abs=1e-7)
    assert here.plane.offset == pytest.approx(there.plane.offset, abs=1e-6)
    depth, instance, K, focal_baseline = score_tool.true_view(
        folder, json.loads((folder / "calib.json").read_text())
    )
    assert pytest.approx(scene.rectified.K) == K
    assert focal_baseline == pytest.approx(scene.rectified.focal_baseline)
    assert (instance == scene.instance).all()
    assert np.abs(depth - np.nan_to_num(scene.depth_m)).max() < 1e-4


def test_the_command_makes_scenes(tmp_path: Path) -> None:
    cli.load_verbs()
    arguments = [
        "synth",
        str(tmp_path),
        "--family",
        "paper",
        "--lumps",
        "0",
        "--size",
        "VGA",
        "--seed",
        "2",
    ]
    done = CliRunner().invoke(cli.app, arguments)
    assert done.exit_code == 0, done.output
    assert done.stdout.split() == [str(tmp_path / "paper_0002")]
    assert json.loads((tmp_path / "paper_0002" / "gt.json").read_text())["n_lumps"] == 0


def test_the_command_names_a_bad_family(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.launch(["synth", str(tmp_path), "--family", "moon"])
    assert stop.value.code == 1
    assert "'moon' is no family" in capsys.readouterr().err


# --- the published experiment's cloud -------------------------------------------------------------


@pytest.mark.parametrize("direction", ["isotropic", "normal", "ray"])
def test_paper_cloud_is_what_the_paper_describes(direction: synth.Direction) -> None:
    clean, none = synth.paper_cloud(0, direction, 0.0)
    xyz, noise = synth.paper_cloud(0, direction, 0.148)
    assert xyz.shape == (18809, 3)
    assert not none.any()
    assert np.ptp(clean, axis=0) == pytest.approx([0.62883, 0.90148, 0.19665], rel=1e-3)
    assert noise.sum() == round(0.148 * 18809)
    assert (xyz[~noise] == clean[~noise]).all()
    offset = np.linalg.norm(xyz - clean, axis=1)[noise]
    assert offset.min() > 0
    assert offset.max() <= 0.04812
    assert offset.mean() == pytest.approx(0.0164, abs=0.0005)
    assert offset.std() == pytest.approx(0.0077, abs=0.0004)


def test_paper_cloud_is_seeded_and_can_be_separable() -> None:
    assert (synth.paper_cloud(0, "normal")[0] == synth.paper_cloud(0, "normal")[0]).all()
    assert (synth.paper_cloud(0, "normal")[0] != synth.paper_cloud(1, "normal")[0]).any()
    xyz, noise = synth.paper_cloud(0, "normal", 0.148, min_offset_m=0.012)
    clean, _ = synth.paper_cloud(0, "normal", 0.0)
    assert np.linalg.norm(xyz - clean, axis=1)[noise].min() > 0.012


@pytest.mark.parametrize(
    ("arguments", "message"), [(("up", 0.1), "direction.*'up'"), (("ray", 1.5), "noise_share.*1.5")]
)
def test_paper_cloud_refuses_what_has_no_meaning(arguments: tuple, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        synth.paper_cloud(0, *arguments)


def test_the_plane_fixture_is_consistent(flat_plane_pair: PlanePair) -> None:
    rig_ = flat_plane_pair.pair.rig
    u, v = np.meshgrid(np.arange(rig_.width), np.arange(rig_.height))
    xyz = rig_.back_project(u, v, flat_plane_pair.depth)
    assert np.abs(xyz @ flat_plane_pair.normal - flat_plane_pair.offset).max() < 1e-9
