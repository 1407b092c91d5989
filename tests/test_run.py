"""The installed command `stereo-ore run`: layouts, results, resumption, and faults that must not
pass in silence."""

import csv
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from runs import quarter_scene, smaller_scene

from stereo_ore.cli import launch
from stereo_ore.io import clouds
from stereo_ore.io.calibration import dump, load
from stereo_ore.io.site import load_site

ROOT = Path(__file__).parents[1]
SCENE = ROOT / "data" / "paper_03"
SCHEMA = ROOT / "stereo_ore" / "schema" / "frame-2.json"
COMPARED = ("frames.jsonl", "ores.csv")


def stereo_ore(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["stereo-ore", *map(str, arguments)], capture_output=True, text=True, timeout=120
    )


def failure(done: subprocess.CompletedProcess[str], code: int = 1) -> str:
    """The one error line of a command that failed as it should."""
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    return [line for line in done.stderr.splitlines() if line][-1]


@pytest.fixture(scope="module")
def half(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo scene at half its size, so that a run takes a second: left.png, right.png,
    calibration and site."""
    folder = tmp_path_factory.mktemp("half")
    smaller_scene(folder, 2)
    return folder


@pytest.fixture(scope="module")
def recording(half: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four frames in ZED export layout; frame 2 lacks its right image."""
    folder = tmp_path_factory.mktemp("recording")
    for index in range(4):
        for eye in ("left", "right"):
            if (index, eye) != (2, "right"):
                shutil.copy(half / f"{eye}.png", folder / f"{eye}{index:06d}.png")
    return folder


def files(half: Path) -> tuple[object, ...]:
    copies = "--set", "health.refuse_frozen=false"
    return "--calib", half / "calibration.yaml", "--site", half / "site.yaml", *copies


@pytest.fixture(scope="module")
def finished(
    half: Path, recording: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, subprocess.CompletedProcess[str]]:
    out = tmp_path_factory.mktemp("finished") / "out"
    return out, stereo_ore("run", recording, *files(half), "--out", out, "--save-stages")


def records(out: Path) -> list[dict]:
    return [json.loads(line) for line in (out / "frames.jsonl").read_text().splitlines()]


def test_every_file_of_the_design_is_written(
    finished: tuple[Path, subprocess.CompletedProcess[str]],
) -> None:
    out, done = finished
    assert done.returncode == 0, done.stderr
    for name in ("000000", "000001", "000003"):
        for file in (f"clouds/{name}.ply", f"overlays/{name}.png", f"stages/{name}.npz"):
            assert (out / file).is_file(), file
    for file in (
        "frames.jsonl",
        "ores.csv",
        "timings.jsonl",
        "run.json",
        "config.yaml",
        "calibration.yaml",
        "site.yaml",
    ):
        assert (out / file).is_file(), file
    assert not list(out.rglob("*.part")) + list(out.rglob("*.tmp"))


def test_every_record_validates_against_the_schema(
    finished: tuple[Path, subprocess.CompletedProcess[str]],
) -> None:
    import jsonschema

    validator = jsonschema.Draft202012Validator(json.loads(SCHEMA.read_text()))
    for record in records(finished[0]):
        validator.validate(record)


def test_ores_and_targets_are_found_in_camera_and_arm_frame(
    finished: tuple[Path, subprocess.CompletedProcess[str]], half: Path
) -> None:
    record = records(finished[0])[0]
    T = load_site(half / "site.yaml").T_arm_camera
    assert record["status"] == "ok"
    assert len(record["ores"]) >= 4
    assert record["targets"]
    for ore in record["ores"]:
        centre = ore["centre_of_gravity"]
        np.testing.assert_allclose((T @ [*centre["camera"], 1])[:3], centre["arm"], atol=2e-6)


def test_an_unpaired_frame_fails_alone_and_by_name(
    finished: tuple[Path, subprocess.CompletedProcess[str]],
) -> None:
    out, done = finished
    assert [record["status"] for record in records(out)] == ["ok", "ok", "failed", "ok"]
    failed = records(out)[2]
    assert failed["reasons"][0]["code"] == "UNPAIRED"
    assert "left000002.png" in failed["reasons"][0]["detail"]
    assert failed["targets"] == []
    assert "000002" in done.stderr


def test_equal_frames_give_equal_ores(
    finished: tuple[Path, subprocess.CompletedProcess[str]],
) -> None:
    first, second, _, _ = records(finished[0])
    for frames, record in enumerate((first, second), 1):
        assert {ore.pop("track")["frames"] for ore in record["ores"]} == {frames}
    assert first["ores"] == second["ores"]
    assert first["targets"] == second["targets"]


def test_the_table_has_a_row_an_ore(
    finished: tuple[Path, subprocess.CompletedProcess[str]],
) -> None:
    out, _ = finished
    with (out / "ores.csv").open() as file:
        rows = list(csv.DictReader(file))
    ores = [(record["frame"], ore) for record in records(out) for ore in record["ores"]]
    assert [(row["frame"], int(row["id"])) for row in rows] == [
        (frame, ore["id"]) for frame, ore in ores
    ]
    assert float(rows[0]["cog_arm_z_m"]) == ores[0][1]["centre_of_gravity"]["arm"][2]


def test_stage_arrays_have_the_shapes_of_the_design(
    finished: tuple[Path, subprocess.CompletedProcess[str]],
) -> None:
    stages = np.load(finished[0] / "stages" / "000000.npz")
    m = len(stages["voxel_xyz"])
    expected = {
        "disparity": ((360, 640), "float32"),
        "voxel_xyz": ((m, 3), "float32"),
        "keep": ((m,), "bool"),
    }
    expected |= {
        "score": ((m,), "float32"),
        "ore_id": ((m,), "int32"),
        "ore_map": ((360, 640), "int16"),
    }
    assert {
        name: (stages[name].shape, str(stages[name].dtype)) for name in stages.files
    } == expected
    counts = records(finished[0])[0]["counts"]
    assert (counts["voxels"], counts["kept"]) == (m, stages["keep"].sum())


def test_the_cloud_is_readable_and_holds_the_kept_voxels(
    finished: tuple[Path, subprocess.CompletedProcess[str]],
) -> None:
    import open3d as o3d

    cloud = o3d.t.io.read_point_cloud(str(finished[0] / "clouds" / "000000.ply"))
    stages = np.load(finished[0] / "stages" / "000000.npz")
    np.testing.assert_array_equal(
        cloud.point.positions.numpy(), stages["voxel_xyz"][stages["keep"]]
    )
    np.testing.assert_array_equal(
        cloud.point.ore_id.numpy().ravel(), stages["ore_id"][stages["keep"]]
    )


def test_clouds_may_be_in_the_arm_s_frame_too(tmp_path: Path) -> None:
    known, out = quarter_scene(tmp_path / "scene"), tmp_path / "out"
    words = [tmp_path / "scene", *known, "--out", out, "--no-report", "--arm-clouds"]
    assert stereo_ore("run", *words).returncode == 0
    plain, arm = (clouds.read(out / name / "scene.ply") for name in ("clouds", "arm_clouds"))
    T = load_site(tmp_path / "scene" / "site.yaml").T_arm_camera
    assert T is not None
    np.testing.assert_allclose(
        clouds.xyz(arm), clouds.xyz(plain).astype(float) @ T[:3, :3].T + T[:3, 3], atol=1e-6
    )
    for name in set(plain.dtype.names) - set("xyz"):
        np.testing.assert_array_equal(arm[name], plain[name])
    assert b"comment stereo_ore: metres, arm frame" in (out / "arm_clouds/scene.ply").read_bytes()
    assert stereo_ore("run", *words, "--overwrite", "--no-clouds").returncode == 0
    assert [path.parent.name for path in out.rglob("*.ply")] == ["arm_clouds"]
    nowhere = stereo_ore("run", *words[:3], "--out", tmp_path / "x", "--arm-clouds")
    assert nowhere.returncode == 1
    assert "arm_from_camera: is not known" in nowhere.stderr


@pytest.mark.parametrize("how", ["workers", "again", "resumed"])
def test_the_bytes_are_the_same_however_it_was_run(
    finished: tuple[Path, subprocess.CompletedProcess[str]],
    half: Path,
    recording: Path,
    tmp_path: Path,
    how: str,
) -> None:
    reference, out = finished[0], tmp_path / "out"
    if how == "resumed":
        # A killed run: whole lines of one frame, a torn second one.
        shutil.copytree(reference, out)
        (out / "ores.csv").unlink()
        for name in ("frames.jsonl", "timings.jsonl"):
            lines = (out / name).read_text().splitlines(keepends=True)
            (out / f"{name}.part").write_text(lines[0] + lines[1][:40])
            (out / name).unlink()
        entry = json.loads((out / "run.json").read_text())["inputs"][0]
        (out / "inputs.jsonl.part").write_text(json.dumps(entry) + "\n")
    extra = {"workers": ["--workers", "2"], "again": [], "resumed": ["--resume"]}[how]
    done = stereo_ore("run", recording, *files(half), "--out", out, "--save-stages", *extra)
    assert done.returncode == 0, done.stderr
    names = [
        *COMPARED,
        *(
            str(file.relative_to(reference))
            for kind in ("clouds", "overlays")
            for file in (reference / kind).iterdir()
        ),
    ]
    assert [
        name for name in names if (out / name).read_bytes() != (reference / name).read_bytes()
    ] == []


def test_workers_end_with_a_run_that_is_killed(half: Path, recording: Path, tmp_path: Path) -> None:
    command = [
        "stereo-ore",
        "run",
        recording,
        *files(half),
        "--out",
        tmp_path / "out",
        "--workers",
        "2",
    ]
    with subprocess.Popen([str(word) for word in command], stderr=subprocess.PIPE) as run:
        time.sleep(3)
        run.kill()
        # The workers hold the pipe: it ends when the last of them does.
        run.communicate(timeout=20)


def test_start_stop_every_select_frames(half: Path, recording: Path, tmp_path: Path) -> None:
    done = stereo_ore(
        "run", recording, *files(half), "--out", tmp_path, "--start", 1, "--stop", 4, "--every", 2
    )
    assert done.returncode == 0, done.stderr
    assert [(record["frame"], record["index"]) for record in records(tmp_path)] == [
        ("000001", 1),
        ("000003", 3),
    ]


def test_strict_stops_at_the_first_failed_frame(
    half: Path, recording: Path, tmp_path: Path
) -> None:
    line = failure(stereo_ore("run", recording, *files(half), "--out", tmp_path, "--strict"))
    assert "000002" in line
    assert not (tmp_path / "frames.jsonl").exists()


def test_two_files_and_no_site(half: Path, tmp_path: Path) -> None:
    done = stereo_ore(
        "run", "--left", half / "left.png", "--right", half / "right.png",
        "--calib", half / "calibration.yaml", "--out", tmp_path,
    )  # fmt: skip
    record = records(tmp_path)[0]
    assert done.returncode == (0 if record["status"] == "ok" else 3), done.stderr
    assert record["frame"] == half.name
    assert record["counts"]["kept"] > 1000
    assert record["arm_frame"] is None
    assert all(ore["surface_centroid"]["arm"] is None for ore in record["ores"])
    assert "arm_from_camera is not in the site file" in done.stderr


def test_a_configured_run_repeats_from_its_own_folder(half: Path, tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    setting = ["--set", "strike.alternates=1", "--set", "filter.method=statistical"]
    assert stereo_ore("run", half, *files(half), "--out", first, *setting).returncode == 0
    repeat = [
        "--calib",
        first / "calibration.yaml",
        "--site",
        first / "site.yaml",
        "--config",
        first / "config.yaml",
    ]
    assert stereo_ore("run", half, *repeat, "--out", second).returncode == 0
    for name in COMPARED:
        assert (first / name).read_bytes() == (second / name).read_bytes()


def test_a_run_that_is_there_already_is_not_begun_anew_unasked(half: Path, tmp_path: Path) -> None:
    command = ["run", half, *files(half), "--out", tmp_path, "--no-report"]
    assert stereo_ore(*command).returncode == 0
    before = (tmp_path / "frames.jsonl").read_bytes()
    assert "Give --resume to go on with it, or --overwrite to begin anew" in failure(
        stereo_ore(*command)
    )
    assert (tmp_path / "frames.jsonl").read_bytes() == before
    for option in ("--resume", "--overwrite"):
        assert stereo_ore(*command, option).returncode == 0
        assert (tmp_path / "frames.jsonl").read_bytes() == before


def test_another_run_is_not_overwritten_unasked(half: Path, tmp_path: Path) -> None:
    assert stereo_ore("run", half, *files(half), "--out", tmp_path).returncode == 0
    before = (tmp_path / "frames.jsonl").read_bytes()
    other = ["run", half, "--calib", half / "calibration.yaml", "--out", tmp_path]
    line = failure(stereo_ore(*other))
    assert "--overwrite" in line
    assert (tmp_path / "frames.jsonl").read_bytes() == before
    assert "--overwrite" in failure(stereo_ore(*other, "--resume"))
    assert stereo_ore(*other, "--overwrite").returncode in (
        0,
        3,
    ), "without a site no screen may be found"
    assert (tmp_path / "frames.jsonl").read_bytes() != before


def test_images_of_another_size_than_the_calibration_name_both_sizes(
    half: Path, tmp_path: Path
) -> None:
    line = failure(stereo_ore("run", SCENE, *files(half), "--out", tmp_path / "out"), 3)
    assert line.startswith("error: no frame is usable; the first: ")
    assert "1280" in line
    assert "640" in line


def test_a_first_frame_of_another_size_fails_alone(half: Path, tmp_path: Path) -> None:
    for eye in ("left", "right"):
        (tmp_path / eye).mkdir()
        cv2.imwrite(str(tmp_path / eye / "a.png"), np.zeros((90, 160, 3), np.uint8))
        shutil.copy(half / f"{eye}.png", tmp_path / eye / "b.png")
    done = stereo_ore("run", tmp_path, *files(half), "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert [r["status"] for r in records(tmp_path / "out")] == ["failed", "ok"]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["absent", "--calib", "calibration.yaml", "--out", "out"], "absent"),
        ([".", "--calib", "absent.yaml", "--out", "out"], "absent.yaml"),
        ([".", "--calib", "calibration.yaml", "--site", "absent.yaml", "--out", "out"],
        "absent.yaml"),
        ([".", "--calib", "calibration.yaml", "--set", "strike.alternate=1", "--out", "out"],
        "mean alternates?"),
        ([".", "--calib", "calibration.yaml", "--set", "filter.method=adaptve", "--out", "out"],
        "adaptive"),
        ([".", "--calib", "calibration.yaml", "--start", "5", "--out", "out"],
        "none of them selected"),
        ([".", "--calib", "calibration.yaml", "--out", "calibration.yaml"], "calibration.yaml"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line_and_exit_code_1(
    half: Path, arguments: list[str], says: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    shutil.copytree(half, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    assert says in failure(stereo_ore("run", *arguments))


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["run"],
        ["run", ".", "--calib", "c.yaml"],
        ["nonsense"],
        ["run", "--left", "a.png", "--calib", "c", "--out", "o"],
    ],
)
def test_wrong_usage_is_exit_code_2(arguments: list[str]) -> None:
    done = stereo_ore(*arguments)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr


def test_a_scene_that_looks_elsewhere_is_empty_or_refused_never_a_target(
    half: Path, tmp_path: Path
) -> None:
    text = (half / "site.yaml").read_text()
    assert "working_volume:" in text
    before, _, after = text.partition("working_volume:")
    _, _, rest = after.partition("grizzly:")
    away = "\n  frame: camera\n  min_m: [50, 50, 1]\n  max_m: [51, 51, 2]\n"
    (tmp_path / "site.yaml").write_text(f"{before}working_volume:{away}grizzly:{rest}")
    site = ["--site", tmp_path / "site.yaml", "--out", tmp_path / "out"]
    assert "working" in failure(
        stereo_ore("run", half, "--calib", half / "calibration.yaml", *site)
    )


def test_the_written_calibration_is_the_one_that_was_read(
    finished: tuple[Path, subprocess.CompletedProcess[str]], half: Path
) -> None:
    assert dump(load(finished[0] / "calibration.yaml")) == dump(load(half / "calibration.yaml"))


def test_clouds_and_overlays_can_be_left_out(half: Path, tmp_path: Path) -> None:
    done = stereo_ore(
        "run", half, *files(half), "--out", tmp_path, "--no-clouds", "--no-overlays", "--no-report"
    )
    assert done.returncode == 0, done.stderr
    assert (
        sorted(path.suffix for path in tmp_path.rglob("*") if path.suffix in (".ply", ".png")) == []
    )
    assert records(tmp_path)[0]["targets"]


def test_pictures_are_written_when_asked_for(half: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    done = stereo_ore(
        "run", half, *files(half), "--out", tmp_path / "out", "--pictures", "--no-report"
    )
    assert done.returncode == 0, done.stderr
    (picture,) = (tmp_path / "out" / "pictures").iterdir()
    assert picture.stem == records(tmp_path / "out")[0]["frame"]
    assert np.ptp(cv2.imread(str(picture))) > 200


def test_pictures_without_matplotlib_are_refused_before_the_run(
    half: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(SystemExit) as stop:
        launch(
            [
                str(word)
                for word in ("run", half, *files(half), "--out", tmp_path / "out", "--pictures")
            ]
        )
    assert stop.value.code == 1
    assert "stereo-ore[pictures]" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
