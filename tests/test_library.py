"""The library's face: what README and docs/python.md show, in the shapes and words that they
promise."""

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import stereo_ore as so
from stereo_ore.record import to_line

ROOT = Path(__file__).parents[1]
SCENE = ROOT / "data" / "paper_03"
PAGES = ("README.md", "docs/python.md")


@pytest.fixture(scope="module")
def detector() -> so.Detector:
    return so.Detector.load(SCENE / "calibration.yaml", str(SCENE / "site.yaml"))


@pytest.fixture(scope="module")
def result(detector: so.Detector) -> so.Result:
    (pair,) = so.open_recording(str(SCENE))
    return detector(pair)


def blocks(page: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.parametrize("page", PAGES)
def test_every_python_line_of_a_page_runs(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a folder that holds what the lines name, one block after the other, in one namespace."""
    for name in ("calibration.yaml", "site.yaml"):
        (tmp_path / name).write_bytes((SCENE / name).read_bytes())
    (tmp_path / "recording").mkdir()
    for eye in ("left", "right"):
        (tmp_path / "recording" / f"{eye}.png").write_bytes((SCENE / f"{eye}.png").read_bytes())
    np.save(tmp_path / "scan.npy", np.random.default_rng(0).normal(size=(500, 3)))
    monkeypatch.chdir(tmp_path)
    code = "\n".join(blocks(page))
    assert code, f"{page} shows no Python"
    # A program of its own: worker processes must be able to import it.
    program = "if __name__ == '__main__':\n" + "".join(
        f"    {line}\n" for line in code.splitlines()
    )
    (tmp_path / "page.py").write_text(program)
    done = subprocess.run([sys.executable, "page.py"], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


def test_importing_the_library_imports_nothing_heavy() -> None:
    code = "import sys, stereo_ore; print({'numpy', 'cv2', 'pydantic', 'scipy'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def test_every_stable_name_is_there_and_documented() -> None:
    for name in so.__all__:
        assert getattr(so, name).__doc__, name
    with pytest.raises(AttributeError, match="nothing_here"):
        so.nothing_here  # noqa: B018 - asked for on purpose


def test_targets_are_ores_in_the_order_of_the_record(result: so.Result) -> None:
    data = result.to_dict()
    assert [ore.id for ore in result.targets] == data["targets"] != []
    assert json.loads(to_line(data)) == data
    assert result.status == "ok"


def test_the_arm_has_coordinates_of_every_point(result: so.Result) -> None:
    for ore, entry in zip(result.ores, result.to_dict()["ores"], strict=True):
        assert ore.arm is not None
        assert ore.solid is not None
        assert ore.solid.arm is not None
        np.testing.assert_allclose(
            ore.arm.surface_centroid, entry["surface_centroid"]["arm"], atol=1e-6
        )
        centre = entry["centre_of_gravity"]["arm"]
        np.testing.assert_allclose(ore.solid.arm.centre_of_gravity, centre, atol=1e-6)
        # The same body: a rigid motion keeps its vertices' distances from its centre of gravity.
        spread, moved = (
            np.linalg.norm(s.vertices - s.centre_of_gravity, axis=1)
            for s in (ore.solid, ore.solid.arm)
        )
        np.testing.assert_allclose(moved, spread, atol=1e-5)
        if ore.strike is not None:
            assert ore.strike.arm is not None
            np.testing.assert_allclose(
                ore.strike.arm.point, entry["strike"]["point"]["arm"], atol=1e-6
            )


def test_without_an_arm_there_are_no_coordinates_for_it(result: so.Result) -> None:
    calibration = so.Detector.load(SCENE / "calibration.yaml").chain.calibration
    (pair,) = so.open_recording(SCENE)
    for ore in so.Detector(calibration)(pair).ores:
        assert (ore.arm, ore.solid and ore.solid.arm, ore.strike and ore.strike.arm) == (None,) * 3


def test_a_result_prints_in_a_line_and_shows_as_a_table(
    result: so.Result, detector: so.Detector
) -> None:
    assert re.fullmatch(r"Result\('paper_03': ok, \d+ ores, \d+ targets\)", repr(result))
    html = result._repr_html_()
    assert html.count("<tr>") == len(result.ores) + 1
    assert "[m]" in html
    assert "1280×720 px" in repr(detector)
    assert "\n" not in repr(detector) + repr(so.open_recording(SCENE)) + repr(result.overlay())


def test_the_overlay_is_a_picture_of_the_image(result: so.Result, tmp_path: Path) -> None:
    file = result.overlay().save(tmp_path / "sub" / "overlay.png")
    np.testing.assert_array_equal(cv2.imread(str(file)), result.overlay().image)
    with pytest.raises(so.OutputError, match="PNG"):
        result.overlay().save(tmp_path / "overlay.jpg")


def test_a_cloud_for_numpy_and_for_open3d(result: so.Result) -> None:
    table = result.to_numpy()
    assert len(table) == result.counts["kept"]
    cloud = result.to_open3d()
    np.testing.assert_array_equal(np.asarray(cloud.points, np.float32)[:, 2], table["z"])
    assert np.asarray(cloud.colors).max() <= 1


def test_a_pair_from_arrays_that_does_not_fit_is_a_failed_frame(detector: so.Detector) -> None:
    grey = np.full((100, 120, 3), 90, np.uint8)
    result = detector(so.StereoPair(grey, grey))
    assert (result.status, [reason.code for reason in result.reasons]) == (
        "failed",
        ["SIZE_MISMATCH"],
    )
    assert result.to_numpy().size == 0
    with pytest.raises(so.OutputError, match="calibration is for 1280×720"):
        result.overlay()


def test_a_recording_leaves_out_what_cannot_be_read(tmp_path: Path, caplog: Any) -> None:
    for index in range(3):
        for eye in ("left", "right"):
            cv2.imwrite(str(tmp_path / f"{eye}{index}.png"), np.full((8, 8, 3), index, np.uint8))
    (tmp_path / "right1.png").unlink()
    recording = so.open_recording(tmp_path)
    assert [pair.index for pair in recording] == [0, 2]
    assert "left1.png" in caplog.text
    assert (len(recording), recording[-1].index) == (3, 2)
    with pytest.raises(so.FrameError):
        recording[1]
    with pytest.raises(IndexError):
        recording[3]


def test_a_run_is_that_of_the_command(detector: so.Detector, tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    results = so.run(
        SCENE, detector, tmp_path / "out", report=False, progress=lambda *at: seen.append(at)
    )
    command = [sys.executable, "-m", "stereo_ore", "-q", "run", SCENE, "--no-report"]
    files = ["--calib", SCENE / "calibration.yaml", "--site", SCENE / "site.yaml"]
    subprocess.run([*command, *files, "--out", tmp_path / "same"], check=True, capture_output=True)
    for name in ("frames.jsonl", "ores.csv", "config.yaml", "calibration.yaml", "site.yaml"):
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "same" / name).read_bytes(), (
            name
        )
    assert seen == [(0, 1), (1, 1)]
    assert results.records[0]["frame"] == "paper_03"
    with pytest.raises(TypeError, match="wokers"):
        so.run(SCENE, detector, tmp_path / "out", wokers=2)


def test_the_errors_are_those_of_the_command_line(tmp_path: Path) -> None:
    with pytest.raises(so.SourceError, match="no such file or folder"):
        so.open_recording(tmp_path / "nothing")
    with pytest.raises(so.CalibrationError, match=r"calibration\.yaml"):
        so.Detector.load(tmp_path / "calibration.yaml")
    with pytest.raises(so.ConfigError, match="slope"):
        so.Detector.load(SCENE / "calibration.yaml", settings=["strike.max_slop_rad=1"])


def test_the_filter_alone_keeps_the_plane_and_drops_what_floats() -> None:
    rng = np.random.default_rng(3)
    plane = np.c_[rng.uniform(0, 1, (4000, 2)), rng.normal(0, 0.0005, 4000)]
    noise = rng.uniform((0, 0, 0.05), (1, 1, 0.4), (60, 3))
    keep, score = so.filter_cloud(np.concatenate([plane, noise]), "statistical", k=8)
    assert keep[:4000].mean() > 0.95
    assert keep[4000:].mean() < 0.1
    assert score.shape == (4060,)
    with pytest.raises(so.CloudError, match=r"\(4, 2\)"):
        so.filter_cloud(np.zeros((4, 2)))
    with pytest.raises(so.ConfigError, match="adaptive"):
        so.filter_cloud(plane, "adaptve")
