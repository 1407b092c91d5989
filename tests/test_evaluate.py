"""`evaluate`: the truth scores perfectly, a known fault shows as itself, figures are those of the
scoring tool."""

import copy
import json
import shutil
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from stereo_ore import cli
from stereo_ore.errors import SourceError
from stereo_ore.lab import evaluate, synth

Edit = Callable[[dict[str, Any], dict[str, np.ndarray]], None]


def truth_as_result(scene: synth.Scene) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Record and stages of a program that knows the truth; some noise far above the surface, all of
    it removed."""
    ids = {lump.id: k for k, lump in enumerate(scene.lumps, 1)}
    ore_map = np.zeros(scene.instance.shape, np.int16)
    for lump, k in ids.items():
        ore_map[scene.instance == lump] = k
    K, z = scene.rectified.K, scene.depth_m.astype(float)
    u, v = np.meshgrid(np.arange(z.shape[1]), np.arange(z.shape[0]))
    xyz = np.stack([(u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z, z], -1)
    some = xyz[::9, ::9].reshape(-1, 3)
    voxels = np.concatenate([some, some[::7] * 0.5]).astype(np.float32)
    stages = {
        "disparity": scene.disparity_px, "ore_map": ore_map, "voxel_xyz": voxels,
        "keep": np.arange(len(voxels)) < len(some),
    }  # fmt: skip
    ores = [
        _ore(scene, lump, k, xyz[scene.instance == lump.id])
        for lump, k in zip(scene.lumps, ids.values(), strict=True)
    ]
    return {"frame": "it", "status": "ok", "ores": ores}, stages


def _ore(scene: synth.Scene, lump: synth.LumpTruth, k: int, surface: np.ndarray) -> dict[str, Any]:
    point = surface[np.linalg.norm(surface - surface.mean(0), axis=1).argmin()]
    centre = {
        "arm": lump.com_world.tolist(),
        "camera": lump.com_rectified.tolist(),
        "sigma_m": [0.001] * 3,
    }
    return {
        "id": k, "centre_of_gravity": centre, "volume_m3": lump.volume_m3,
        "volume_bounds_m3": [0.9 * lump.volume_m3, 1.1 * lump.volume_m3],
        "size_m": [lump.max_calliper, 0.1, 0.1],
        "oversize": lump.oversize, "strike": {"point": {"camera": point.tolist()},
            "direction": {"camera": [0, 0, 1]}},
    }  # fmt: skip


@pytest.fixture
def results(synth_scene: synth.Scene, tmp_path: Path) -> Callable[..., Path]:
    """Makes a run folder from the truth, after `edit` had its way with record and stages."""

    def make(edit: Edit = lambda record, stages: None, name: str = "run") -> Path:
        record, stages = truth_as_result(synth_scene)
        edit(record, stages)
        folder = tmp_path / name
        (folder / "stages").mkdir(parents=True)
        (folder / "frames.jsonl").write_text(json.dumps(record) + "\n")
        (folder / "timings.jsonl").write_text(
            json.dumps({"frame": "it", "stages_ms": {}, "total_ms": 12.5}) + "\n"
        )
        np.savez(folder / "stages" / "it.npz", **stages)
        return folder

    return make


def judged(
    run: Path, scene: Path, baselines: bool = False
) -> tuple[dict[str, Any], dict[str, float]]:
    (pair,) = evaluate.find_pairs(run, scene)
    row = evaluate.score(pair.record(), pair.stages(), evaluate.load_truth(scene), baselines) | {
        "ms": pair.total_ms()
    }
    return row, evaluate.pool_scenes([row])


def test_a_perfect_result_scores_perfectly(
    results: Callable[..., Path], synth_folder: Path
) -> None:
    row, total = judged(results(), synth_folder)
    assert row["ores"]["wanted"] >= 2
    for one in (
        "match_valid",
        "filter_f1",
        "iou",
        "recall50",
        "precision50",
        "oversize_flag",
        "cog_inside_2_sigma",
    ):
        assert total[one] == pytest.approx(1, abs=1e-6), one
    for zero in (
        "match_bad1",
        "noise_left",
        "cog_xy_mm",
        "cog_z_mm",
        "volume_rel",
        "size_rel",
        "strike_mm",
    ):
        assert total[zero] == pytest.approx(0, abs=0.02), zero
    assert total["ms"] == 12.5


def test_a_shifted_centre_is_split_into_plane_and_height(
    results: Callable[..., Path], synth_folder: Path, synth_scene: synth.Scene
) -> None:
    axes = synth_scene.spec.T_world_screen[:3, :3]

    def shift(record: dict[str, Any], _: dict[str, np.ndarray]) -> None:
        for ore in record["ores"]:
            moved = np.array(ore["centre_of_gravity"]["arm"]) + axes @ [0.003, 0.004, -0.012]
            ore["centre_of_gravity"]["arm"] = moved.tolist()

    _, total = judged(results(shift), synth_folder)
    assert total["cog_xy_mm"] == pytest.approx(5, abs=1e-3)
    assert total["cog_z_mm"] == pytest.approx(12, abs=1e-3)


def test_a_missed_and_an_invented_ore_are_counted(
    results: Callable[..., Path], synth_folder: Path
) -> None:
    def swap(record: dict[str, Any], stages: dict[str, np.ndarray]) -> None:
        stages["ore_map"][stages["ore_map"] == 1] = 0
        stages["ore_map"][:20, :30] = 1

    row, _ = judged(results(swap), synth_folder)
    perfect, _ = judged(results(name="perfect"), synth_folder)
    assert row["ores"]["hit"] == perfect["ores"]["hit"] - 1
    assert row["ores"]["false"] == 1


def test_an_empty_result_of_an_empty_scene(empty_scene: synth.Scene, tmp_path: Path) -> None:
    folder = synth.write(empty_scene, tmp_path / "empty")
    record, stages = truth_as_result(empty_scene)
    total = evaluate.pool_scenes(
        [evaluate.score(record, stages, evaluate.load_truth(folder), baselines=False)]
    )
    assert total["precision50"] == 1
    assert np.isnan(total["cog_xy_mm"])


def test_unknown_values_are_left_out(results: Callable[..., Path], synth_folder: Path) -> None:
    def forget(record: dict[str, Any], _: dict[str, np.ndarray]) -> None:
        for ore in record["ores"]:
            ore |= {
                "centre_of_gravity": None,
                "volume_m3": None,
                "size_m": None,
                "oversize": None,
                "strike": None,
            }

    _, total = judged(results(forget), synth_folder)
    assert total["recall50"] == 1
    assert np.isnan(
        [total["cog_xy_mm"], total["volume_rel"], total["size_rel"], total["strike_mm"]]
    ).all()


def worsen(record: dict[str, Any], stages: dict[str, np.ndarray]) -> None:
    """Every stage wrong in its own way."""
    rng = np.random.default_rng(0)
    stages["disparity"] = (
        stages["disparity"] + rng.normal(0, 0.7, stages["disparity"].shape)
    ).astype(np.float32)
    stages["disparity"][::5] = np.nan
    stages["keep"] = stages["keep"] ^ (rng.random(len(stages["keep"])) < 0.2)
    stages["ore_map"] = np.roll(stages["ore_map"], (5, 7), (0, 1))
    for ore in record["ores"]:
        ore["centre_of_gravity"]["arm"] = (
            np.array(ore["centre_of_gravity"]["arm"]) + rng.normal(0, 0.02, 3)
        ).tolist()
        ore["volume_m3"] *= 1.3
        ore["strike"]["point"]["camera"] = (
            np.array(ore["strike"]["point"]["camera"]) * 0.99
        ).tolist()


def test_figures_are_those_of_the_scoring_tool(
    results: Callable[..., Path],
    synth_folder: Path,
    score_tool: ModuleType,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    run = results(worsen)
    shutil.copytree(run, tmp_path / "work" / "out")
    theirs = score_tool.score(synth_folder, tmp_path / "work")
    their_total = score_tool.report([theirs])
    ours, our_total = judged(run, synth_folder, baselines=True)
    assert not [key for key in theirs if not same(theirs[key], ours[key])]
    assert {k: v for k, v in their_total.items() if k != "failed"} == pytest.approx(
        {k: our_total[k] for k in their_total if k != "failed"}, rel=1e-9, nan_ok=True
    )
    assert 0.1 < our_total["filter_f1"] < 0.95
    capsys.readouterr()


def same(a: Any, b: Any) -> bool:
    if isinstance(a, dict):
        return all(same(a[key], b[key]) for key in a)
    if isinstance(a, str):
        return bool(a == b)
    return bool(a == pytest.approx(b, rel=1e-9))


# --- files and command line -----------------------------------------------------------------------


def test_a_folder_of_runs_fits_a_folder_of_scenes(
    results: Callable[..., Path], synth_folder: Path, tmp_path: Path
) -> None:
    shutil.copytree(results(), tmp_path / "all" / synth_folder.name / "out")
    (pair,) = evaluate.find_pairs(tmp_path / "all", synth_folder.parent)
    assert (pair.scene, pair.frame) == (synth_folder, "it")


def test_what_is_missing_is_named(
    results: Callable[..., Path], synth_folder: Path, tmp_path: Path
) -> None:
    run = results()
    with pytest.raises(SourceError, match="no scene with truth"):
        evaluate.find_pairs(run, tmp_path)
    with pytest.raises(SourceError, match=f"no run of scene {synth_folder.name}"):
        evaluate.find_pairs(tmp_path, synth_folder)
    (run / "stages" / "it.npz").unlink()
    (pair,) = evaluate.find_pairs(run, synth_folder)
    with pytest.raises(SourceError, match="--save-stages"):
        pair.stages()
    scene = shutil.copytree(synth_folder, tmp_path / "scene")
    truth = json.loads((scene / "gt.json").read_text())
    del truth["clear_opening_mm"]
    (scene / "gt.json").write_text(json.dumps(truth))
    with pytest.raises(SourceError, match="clear_opening_mm"):
        evaluate.load_truth(scene)
    (scene / "gt.json").write_text("{")
    with pytest.raises(SourceError, match="can't be read"):
        evaluate.load_truth(scene)


def test_a_lump_without_a_key_is_named(synth_folder: Path, tmp_path: Path) -> None:
    scene = shutil.copytree(synth_folder, tmp_path / "scene")
    whole = json.loads((scene / "gt.json").read_text())
    for key in ("visible_pixels", "volume_mm3"):
        document = copy.deepcopy(whole)
        for lump in document["lumps"]:
            del lump[key]
        (scene / "gt.json").write_text(json.dumps(document))
        with pytest.raises(SourceError, match=key):
            evaluate.load_truth(scene)


def test_truth_of_another_shape_is_an_error(
    results: Callable[..., Path], synth_folder: Path, tmp_path: Path
) -> None:
    scene = shutil.copytree(synth_folder, tmp_path / "scene")
    with np.load(scene / "gt.npz") as file:
        arrays = {name: array[:-8] for name, array in file.items()}
    np.savez(scene / "gt.npz", **arrays)
    with pytest.raises(SourceError, match="pixels"):
        judged(results(), scene)
    np.savez(
        scene / "gt.npz",
        **{name: array[: 9 if "depth" in name else 8] for name, array in arrays.items()},
    )
    with pytest.raises(SourceError, match="shapes"):
        evaluate.load_truth(scene)


def launch(*arguments: object) -> int:
    with pytest.raises(SystemExit) as stop:
        cli.launch([str(argument) for argument in arguments])
    return int(stop.value.code or 0)


def test_the_command_prints_writes_and_judges(
    results: Callable[..., Path],
    synth_folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    run, out = results(), tmp_path / "judged"
    assert launch("evaluate", run, synth_folder, "--out", out, "--at-least", "iou=0.9") == 0
    assert synth_folder.name in capsys.readouterr().out
    assert json.loads((out / "evaluation.json").read_text())["total"]["iou"] == 1
    assert (out / "evaluation.png").is_file() == bool(find_spec("matplotlib"))
    assert launch("evaluate", run, synth_folder, "--at-most", "iou=0.5") == 3
    assert "gate failed: iou" in capsys.readouterr().err
    assert launch("evaluate", run, synth_folder, "--at-least", "beauty=1") == 2
    assert launch("evaluate", run, synth_folder, "--at-least", "iou") == 2
    assert launch("evaluate", run, tmp_path / "nowhere") == 1
