"""``bench filter``: rows, means, tables, README markers."""

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from stereo_ore.cli import app, load_verbs
from stereo_ore.errors import CloudError, OutputError, SourceError
from stereo_ore.lab.bench import filters as bench
from stereo_ore.lab.bench import tables
from stereo_ore.lab.bench.baselines import Contender
from stereo_ore.lab.bench.labelled import (
    LabelledCloud,
    bare_cloud,
    labelled_file,
    paper_clouds,
    scene_stereo,
)
from stereo_ore.lab.bench.real_stereo import WAYS, altered, real_cloud
from stereo_ore.lab.bench.stereo_sets import StereoSet
from stereo_ore.types import RectifiedPair, Region, Rig


def plane_with_outliers() -> LabelledCloud:
    rng = np.random.default_rng(0)
    plane = np.column_stack([rng.uniform(0, 1, (900, 2)), np.zeros(900)])
    far = rng.uniform([0, 0, 1], [1, 1, 2], (30, 3))
    noise = np.arange(930) >= 900
    return LabelledCloud(
        "plane", "cell", bare_cloud(np.concatenate([plane, far])), noise, on_bar=~noise
    )


def test_a_tuned_contender_shows_its_best_setting() -> None:
    labelled = plane_with_outliers()
    contender = Contender("statistical", "statistical", ({"k": 10}, {"k": 20}), (0.01, 1.0, 50.0))
    row = bench.judge_filter(labelled, contender)
    assert row.f1 > 0.95
    assert "1.0" in row.setting
    assert row.noise_share == pytest.approx(30 / 930)
    assert row.bars_kept == pytest.approx(row.retention)
    assert row.noise_left <= 0.005
    assert len(contender.removed(labelled.voxels)) == 6


def test_means_and_summary() -> None:
    rows = bench.judge_filters(
        [plane_with_outliers()] * 2,
        [Contender("statistical", "statistical", thresholds=(1.0,)), Contender("adaptive", "none")],
    )
    cells = bench.means(rows)
    assert [(c["filter"], c["clouds"]) for c in cells] == [("statistical", 2), ("adaptive", 2)]
    summary = bench.summary(cells)
    assert summary["best_tuned_baseline_f1"] == summary["f1"]["statistical"] > 0.9
    assert summary["f1"]["adaptive"] == 0


def test_paper_clouds_are_nine_cells_of_the_published_size() -> None:
    cells = [next(paper_clouds(range(3, 4)))]
    assert len(cells[0].voxels) == 18_809
    assert cells[0].is_noise.mean() == pytest.approx(0.099, abs=1e-3)


def test_a_scene_without_yaml_files_gives_the_same_cloud(
    synth_folder: Path, tmp_path: Path
) -> None:
    for name in ("left.png", "right.png", "calib.json", "gt.json", "gt.npz"):
        (tmp_path / name).symlink_to(synth_folder / name)
    with_files, without = scene_stereo(synth_folder), scene_stereo(tmp_path)
    assert len(without.voxels) == pytest.approx(len(with_files.voxels), rel=0.25)
    assert 0 < without.is_noise.mean() < 0.6
    assert without.on_bar is not None
    assert without.on_bar.any()


def test_speed_has_all_three_times() -> None:
    times = bench.speed(plane_with_outliers().voxels, repeats=1)
    assert {"open3d_statistical", "adaptive", "paper"} <= set(times)
    assert all(value > 0 for value in times.values())


def test_clean_clouds_are_judged_by_what_is_lost() -> None:
    rng = np.random.default_rng(0)
    plane = bare_cloud(np.column_stack([rng.uniform(0, 1, (900, 2)), np.zeros(900)]))
    labelled = LabelledCloud("plane", "plane", plane, np.zeros(900, bool))
    (row,) = bench.judge_clean([labelled, labelled])
    assert set(row) == {"cell", *bench.SHIPPED}
    assert row["adaptive"] <= 0.01 < 0.3 < row["paper"]
    assert "| plane |" in tables._clean([row])


def test_points_that_can_not_be_judged_count_for_nothing() -> None:
    labelled = plane_with_outliers()
    contender = Contender("statistical", "statistical", ({"k": 10},), (1.0,))
    spoilt = dataclasses.replace(
        labelled, is_noise=labelled.is_noise ^ (np.arange(930) < 300), judged=np.arange(930) >= 300
    )
    row = bench.judge_filter(spoilt, contender)
    assert row.points == 630
    assert row.f1 > 0.95


def flat_set() -> StereoSet:
    """A textured wall at 12 px in one half, with no truth in the other."""
    rng = np.random.default_rng(0)
    right = cv2.GaussianBlur(rng.integers(0, 255, (120, 200, 3)).astype(np.uint8), (0, 0), 1.2)
    left = np.roll(right, 12, axis=1)
    truth = np.full((120, 200), 12, np.float32)
    truth[:, :60] = np.nan
    pair = RectifiedPair(left, right, Rig(200, 120, 150.0, 150.0, 100.0, 60.0, 0.1))
    return StereoSet("wall", pair, truth, Region(0, 0, 200, 120, 0, 32))


def test_a_real_set_is_labelled_by_its_true_disparities() -> None:
    labelled = real_cloud(flat_set())
    assert labelled.judged is not None
    u = 100 + 150 * labelled.voxels.xyz[:, 0] / labelled.voxels.xyz[:, 2]
    assert not labelled.judged[u < 56].any()
    assert labelled.judged[(u > 64) & (u < 195)].all()
    assert labelled.is_noise[labelled.judged].mean() < 0.02


@pytest.mark.parametrize("way", WAYS)
def test_other_light_keeps_the_scene_and_its_truth(way: str) -> None:
    found = flat_set()
    worse = altered(found, way, np.random.default_rng(1))
    again = altered(found, way, np.random.default_rng(1))
    np.testing.assert_array_equal(worse.pair.right, again.pair.right)
    assert (worse.pair.right != found.pair.right).mean() > 0.3
    grey = [image[..., 1].ravel().astype(float) for image in (worse.pair.left, found.pair.left)]
    assert np.corrcoef(*grey)[0, 1] > 0.5
    assert worse.truth is found.truth


def test_readme_gets_the_tables_between_its_markers(tmp_path: Path) -> None:
    readme = tmp_path / "README.md"
    readme.write_text("a\n<!-- bench filter -->\nold\n<!-- /bench filter -->\nb\n")
    tables.insert(readme, "bench filter", "new\n")
    assert readme.read_text() == "a\n<!-- bench filter -->\nnew\n<!-- /bench filter -->\nb\n"
    readme.write_text("no markers")
    with pytest.raises(OutputError, match="lacks the lines"):
        tables.insert(readme, "bench filter", "new\n")
    with pytest.raises(OutputError, match="can't be used"):
        tables.insert(tmp_path / "none.md", "bench filter", "new\n")


def test_labels_come_from_a_column(tmp_path: Path) -> None:
    path = tmp_path / "cloud.csv"
    path.write_text("x,y,z,noise\n0,0,0,0\n1,0,0,1\n")
    np.testing.assert_array_equal(labelled_file(path).is_noise, [False, True])
    path.write_text("x,y,z\n0,0,0\n")
    with pytest.raises(CloudError, match="no column noise"):
        labelled_file(path)


@pytest.mark.slow
def test_the_command_writes_everything(tmp_path: Path) -> None:
    load_verbs()
    readme = tmp_path / "README.md"
    readme.write_text("<!-- bench filter -->\n<!-- /bench filter -->\n")
    out = tmp_path / "bench"
    arguments = [
        "bench",
        "filter",
        "--out",
        str(out),
        "--seeds",
        "1",
        "--stereo-seeds",
        "0",
        "--readme",
        str(readme),
    ]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    document = json.loads((out / "bench-filter.json").read_text())
    f1 = document["paper"]["summary"]["f1"]
    assert f1["adaptive"] >= 0.9
    assert f1["adaptive"] >= document["paper"]["summary"]["best_tuned_baseline_f1"] + 0.1
    assert "isotropic, 14.8 %" in readme.read_text()
    assert (out / "side-by-side.png").stat().st_size > 10_000


def test_a_folder_without_scenes_is_an_error(tmp_path: Path) -> None:
    load_verbs()
    arguments = [
        "bench",
        "filter",
        "--out",
        str(tmp_path),
        "--seeds",
        "1",
        "--scenes",
        str(tmp_path),
    ]
    fault = CliRunner().invoke(app, arguments).exception
    assert isinstance(fault, SourceError)
