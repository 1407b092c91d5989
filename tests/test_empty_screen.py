"""`calibrate background`, and a run that knows the empty screen: no plane given, a moved camera
refused."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from stereo_ore.cli import launch
from stereo_ore.lab import synth
from stereo_ore.stages.matching import background


def call(*arguments: object) -> int:
    with pytest.raises(SystemExit) as done:
        launch([str(argument) for argument in arguments])
    return int(done.value.code or 0)


@pytest.fixture(scope="module")
def model(empty_scene: synth.Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the empty screen's recording, its model, and a site that names it instead of a
    plane."""
    folder = tmp_path_factory.mktemp("empty")
    recorded = synth.write(empty_scene, folder / "recorded")
    site = yaml.safe_load((recorded / "site.yaml").read_text())
    site["grizzly"]["plane"] = "auto"
    (folder / "auto.yaml").write_text(yaml.safe_dump(site))
    (folder / "site.yaml").write_text(yaml.safe_dump(site | {"background": "empty_screen.npz"}))
    out = folder / "empty_screen.npz"
    calib = recorded / "calibration.yaml"
    assert (
        call(
            "calibrate",
            "background",
            recorded,
            "--calib",
            calib,
            "--site",
            folder / "auto.yaml",
            "--out",
            out,
        )
        == 0
    )
    return folder


def record(out: Path) -> dict:
    return json.loads((out / "frames.jsonl").read_text().splitlines()[0])


def run(recording: Path, model: Path, out: Path) -> dict:
    call(
        "run",
        recording,
        "--calib",
        model / "recorded/calibration.yaml",
        "--site",
        model / "site.yaml",
        "--out",
        out,
    )
    return record(out)


def test_the_model_holds_most_of_the_screen(model: Path, empty_scene: synth.Scene) -> None:
    made = background.load_background(model / "empty_screen.npz")
    bars = empty_scene.instance == 1
    error = (made.disparity - empty_scene.disparity_px)[bars]
    assert np.isfinite(error).mean() > 0.8
    assert np.nanmedian(np.abs(error)) < 0.3


def test_ore_is_found_without_a_plane(
    model: Path, synth_folder: Path, synth_scene: synth.Scene, tmp_path: Path
) -> None:
    found = run(synth_folder, model, tmp_path / "out")
    assert found["status"] == "ok"
    assert found["grizzly"]["source"] == "background"
    normal = np.array(found["grizzly"]["normal"])
    site = yaml.safe_load((synth_folder / "site.yaml").read_text())
    assert normal @ site["grizzly"]["plane"]["normal"] > np.cos(np.radians(1.5))
    assert len(found["ores"]) >= 2


def test_the_empty_screen_itself_has_no_ore(model: Path, tmp_path: Path) -> None:
    assert run(model / "recorded", model, tmp_path / "out")["ores"] == []


def test_a_moved_camera_fails_the_frame_with_its_reason(
    model: Path, synth_folder: Path, tmp_path: Path
) -> None:
    moved = tmp_path / "moved"
    moved.mkdir()
    for name in ("left.png", "right.png"):
        image = cv2.imread(str(synth_folder / name))
        cv2.imwrite(str(moved / name), np.roll(image, (25, 40), (0, 1)))
    found = run(moved, model, tmp_path / "out")
    assert found["status"] == "failed"
    assert [reason["code"] for reason in found["reasons"]] == ["CAMERA_MOVED"]


def test_an_absent_model_is_named(model: Path, synth_folder: Path, tmp_path: Path, capsys) -> None:
    site = yaml.safe_load((model / "site.yaml").read_text()) | {"background": "nowhere.npz"}
    (tmp_path / "site.yaml").write_text(yaml.safe_dump(site))
    calib = synth_folder / "calibration.yaml"
    assert (
        call(
            "run",
            synth_folder,
            "--calib",
            calib,
            "--site",
            tmp_path / "site.yaml",
            "--out",
            tmp_path / "out",
        )
        == 1
    )
    assert "nowhere.npz" in capsys.readouterr().err
