"""Training of the network of lumps: examples, crops, the course from files to a model folder."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from stereo_ore.cli import app, load_verbs
from stereo_ore.config import SegmentConfig
from stereo_ore.errors import ConfigError
from stereo_ore.lab import synth
from stereo_ore.lab.synth.mesh import box, icosphere
from stereo_ore.lab.training.ore import course, crops, examples, judge, piles
from stereo_ore.lab.training.ore.tumble import tumble
from stereo_ore.stages import segment
from stereo_ore.stages.segment import model
from stereo_ore.stages.segment.channels import CHANNELS, UNIT

SIDES = 120, 150


def example(seed: int = 0) -> examples.Example:
    """Blocks on a plane: what stands out by more than half an opening is a lump."""
    rng = np.random.default_rng(seed)
    lump = np.zeros(SIDES, np.uint8)
    lump[20:60, 20:60], lump[20:60, 60:90], lump[80:100, 100:130] = 1, 2, 3
    x = np.zeros((len(CHANNELS), *SIDES), np.float32)
    x[0] = np.where(lump > 0, 0.6 + 0.2 * lump, 0) + rng.normal(0, 0.02, SIDES)
    x[4:6] = x[7] = 1
    return examples.Example(x.astype(np.float16), lump)


def test_targets_of_a_crop_point_at_the_middles_of_its_lumps() -> None:
    seen = crops.Seen(example())
    rng = np.random.default_rng(1)
    pointed = 0
    for _ in range(20):
        x, t = crops.training_crop(seen, rng)
        assert x.shape == (len(CHANNELS), crops.SIDE, crops.SIDE)
        assert t.shape == (7, crops.SIDE, crops.SIDE)
        assert np.isfinite(x).all()
        assert np.isfinite(t).all()
        ore = t[0] > 0
        v, u = np.nonzero(ore & (t[6] > 0))
        at = np.rint(np.stack([u, v]) + t[2:4, v, u] * UNIT).astype(int)
        there = ((at >= 0) & (at < crops.SIDE)).all(0)
        # Middles lie in their own lump, whichever way the crop was turned.
        assert ore[at[1, there], at[0, there]].mean() > 0.98 if there.any() else True
        pointed += int(there.sum())
    assert pointed > 1000


def test_normals_turn_with_the_crop() -> None:
    made = example()
    slope = np.zeros_like(made.x)
    slope[4] = slope[1] = 1
    turned = replace(made, x=slope)
    rng = np.random.default_rng(0)
    directions = set()
    for _ in range(30):
        x, t = crops.training_crop(crops.Seen(turned), rng)
        inside = (t[6] > 0) & (x[4] > 0)
        nx, ny = (np.median(x[k][inside]) for k in (1, 2))
        directions.add((int(np.round(nx)), int(np.round(ny))))
    assert directions == {(1, 0), (-1, 0), (0, 1), (0, -1)}


def test_examples_come_back_from_their_files(tmp_path: Path) -> None:
    made = example()
    examples.save_example(made, tmp_path / "a.npz")
    back = examples.load_example(tmp_path / "a.npz")
    np.testing.assert_array_equal(back.x, made.x)
    np.testing.assert_array_equal(back.lump, made.lump)
    assert [p.name for p in tmp_path.iterdir()] == ["a.npz"]


def test_the_example_of_a_scene_shows_its_lumps(synth_scene: synth.Scene) -> None:
    made = examples.example_of(
        synth_scene.pair, synth_scene.calibration, synth_scene.site, synth_scene.instance
    )
    assert made is not None
    assert made.x.shape[1:] == made.lump.shape
    height = made.x[0].astype(np.float32)
    assert height[made.lump > 0].mean() > height[made.lump == 0].mean() + 0.2


def test_a_perfect_network_is_judged_perfect() -> None:
    made, config = example(), SegmentConfig()

    def perfect(x: np.ndarray) -> np.ndarray:
        raw = np.zeros((5, *SIDES), np.float32)
        raw[0], raw[1] = np.where(made.lump > 0, 8, -8), -8
        v, u = np.mgrid[: SIDES[0], : SIDES[1]]
        for i in (1, 2, 3):
            mine = made.lump == i
            raw[2][mine] = (u[mine].mean() - u[mine]) / UNIT
            raw[3][mine] = (v[mine].mean() - v[mine]) / UNIT
            raw[4][mine] = np.log(np.sqrt(mine.sum()) / UNIT)
        return raw

    row = judge.named(perfect, made, config)
    assert row.good.all()
    found = judge.ore_quality([(made, row)], None, 0.5)
    assert (found["lumps"], found["recall"], found["false"]) == (3, 1.0, 0.0)
    assert found["overlap"] > 0.97
    assert found["recall by kind"]["alone"] == "2 of 2"


def test_lumps_come_to_rest_on_bars_and_fall_between_them() -> None:
    pytest.importorskip("mujoco")
    ball = icosphere(2)
    large, small = (ball.moved(np.eye(3) * r, np.zeros(3)) for r in (0.2, 0.04))
    bars = [
        (np.array([x - 0.05, -2.0, -0.2]), np.array([x + 0.05, 2.0, 0])) for x in (-0.3, 0, 0.3)
    ]
    poses = list(tumble([large, small], bars, (0.1, 0.3), np.random.default_rng(0), [1, 2]))
    assert [sorted(p) for p in poses] == [[0], [0]]
    height = poses[0][0][1][2]
    assert 0.05 < height < 0.25


def test_a_drawn_screen_is_the_same_each_time() -> None:
    pytest.importorskip("mujoco")
    first, again = (next(iter(piles.piles(1002))) for _ in range(2))
    np.testing.assert_array_equal(first.model.vertices, again.model.vertices)
    assert first.views == again.views
    assert len(first.model.parts) > 3


def test_fixed_things_are_closed_meshes() -> None:
    rng = np.random.default_rng(0)
    half = np.array([1.0, 1.5])
    for mesh in (
        piles._mud(0.3, half, rng)[0],
        piles._hammer(0.3, half, rng),
        box((0, 0, 0), (1, 1, 1), 0.5),
    ):
        assert mesh.triangles.max() < len(mesh.vertices)
        assert np.isfinite(mesh.vertices).all()


def test_the_course_goes_from_examples_to_a_model_folder(tmp_path: Path) -> None:
    for package in ("torch", "onnxscript", "mujoco"):
        pytest.importorskip(package)
    seeds = range(95, 97)
    made = course.Course(tmp_path, seeds, (), 0.05)
    made.cache.mkdir()
    for seed in seeds:
        examples.save_example(example(seed), made.cache / f"seed-{seed}-0.npz")
        (made.cache / f"seed-{seed}.done").touch()
    folder = course.train_ore(made)
    model = segment.load_lump_model(str(folder))
    assert model.card.about["made by"]["seeds"] == [95, 96]
    x = example().x.astype(np.float32)
    assert model(x).shape == (5, *SIDES)
    # A training that is over is not begun again.
    assert course.train_ore(made) == folder


def test_a_training_goes_on_from_the_model_that_it_is_given(tmp_path: Path) -> None:
    for package in ("torch", "onnxscript", "mujoco"):
        pytest.importorskip(package)
    import torch

    from stereo_ore.lab.training.ore import net

    shipped, rng = segment.load_lump_model(), np.random.default_rng(0)
    made = [crops.training_crop(crops.Seen(example(seed)), rng) for seed in range(24)]
    x, t = (torch.from_numpy(np.stack(column)) for column in zip(*made, strict=True))
    network = net.restored(shipped.onnx, x.split(12))
    with torch.no_grad():
        # Batch norms measured on other crops than they normalise, as in training.
        losses = [float(net.loss_of(network.train(mode)(x), t)) for mode in (True, False)]
        nothing = float(net.loss_of(net.LumpNet()(x), t))
    assert losses[0] < nothing / 3
    again = net.restored(shipped.onnx, x.split(12)).eval()
    given = x[0].numpy()
    # The file computes in eight bits.
    assert np.abs(net.outputs_of(again, given) - shipped(given)).mean() < 0.2
    course_ = course.Course(tmp_path, range(95, 96), (), 0.005, shipped)
    course_.cache.mkdir()
    examples.save_example(example(), course_.cache / "seed-95-0.npz")
    (course_.cache / "seed-95.done").touch()
    card = segment.load_lump_model(str(course.train_ore(course_))).card
    assert card.about["made by"]["started from"] == shipped.card.sha256
    # Nothing was left out to fit another.
    assert card.whole == shipped.whole


def test_a_network_of_fixed_sides_is_refused(tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx")
    network = onnx.load_from_string(segment.load_lump_model().onnx)
    network.graph.input[0].type.tensor_type.shape.dim[2].dim_value = 256
    model.write(tmp_path, network.SerializeToString(), {})
    with pytest.raises(ConfigError, match=r"models\.lumps.*\[1, 10, 256, None\].*tune"):
        segment.load_lump_model(str(tmp_path))


def test_without_the_extra_the_package_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.setattr(course, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"torch is not installed.*stereo-ore\[train\]"):
        course.train_ore(course.Course(tmp_path, range(0), (), 1.0))


def test_nothing_of_a_run_needs_the_extra() -> None:
    import subprocess

    code = (
        "import sys; sys.modules['torch'] = sys.modules['mujoco'] = sys.modules['onnx'] = None;"
        "from stereo_ore.stages import segment; import numpy as np;"
        "print(segment.load_lump_model()(np.zeros((10, 32, 48), np.float32)).shape)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "(5, 32, 48)"


def test_an_unknown_kind_of_training_names_the_known_ones(tmp_path: Path) -> None:
    load_verbs()
    done = CliRunner().invoke(app, ["tune", str(tmp_path), "--train", "segment"])
    assert isinstance(done.exception, ConfigError)
    assert "ore" in str(done.exception)
