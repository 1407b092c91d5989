"""Faults of calibration, site and configuration, of the disk and the folder, planted in the real
command."""

import json
import os
import resource
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from runs import ROOT, quarter_scene

from stereo_ore.plant.sinks.message import Origin, message

Document = dict[str, Any]
Change = Callable[[Document], None]


def scaled(key: str, factor: float) -> Change:
    def change(document: Document) -> None:
        for eye in ("left", "right"):
            document[eye][key] = [factor * value for value in document[eye][key]]

    return change


def column(shift_px: float) -> Change:
    def change(document: Document) -> None:
        document["right"]["principal_point_px"][0] += shift_px

    return change


def baseline(factor: float) -> Change:
    def change(document: Document) -> None:
        shift = document["right_from_left"]["translation_m"]
        document["right_from_left"]["translation_m"] = [factor * value for value in shift]

    return change


def turned(
    x_deg: float, y_deg: float, z_deg: float, x: float = 0.0, y: float = 0.0, z: float = 0.0
) -> Change:
    """The camera was turned and moved [m] after the site was measured: the file is that of its old
    pose."""

    def change(document: Document) -> None:
        T_old_new = np.eye(4)
        T_old_new[:3, :3] = cv2.Rodrigues(np.radians([x_deg, y_deg, z_deg]))[0]
        T_old_new[:3, 3] = x, y, z
        document["arm_from_camera"] = (np.array(document["arm_from_camera"]) @ T_old_new).tolist()
        plane = document["grizzly"]["plane"]
        plane["offset_m"] -= float(np.dot(plane["normal"], T_old_new[:3, 3]))
        plane["normal"] = (T_old_new[:3, :3].T @ plane["normal"]).tolist()

    return change


def as_raw(rotation_deg: tuple[float, float, float]) -> Change:
    """Aligned images taken for raw ones of eyes that stand askew."""

    def change(document: Document) -> None:
        document["images"] = "raw"
        document["right_from_left"]["rotation_vector_rad"] = np.radians(rotation_deg).tolist()

    return change


WRONG_CALIBRATIONS: dict[str, tuple[Change, str]] = {
    "rotation that is not there": (as_raw((0.4, 0.0, 0.0)), "ROWS_DISAGREE"),
    "rotation ignored or transposed, roll": (as_raw((0.0, 0.0, 0.6)), "ROWS_DISAGREE"),
    "convergence wrong": (as_raw((0.0, 0.8, 0.0)), "SCREEN_MOVED"),
    "principal column off": (column(1.5), "SCREEN_MOVED"),
    "sign of doffs": (column(-4.0), "SCREEN_MOVED"),
    "disparity offset": (lambda d: d.update(disparity_offset_px=2.0), "SCREEN_MOVED"),
    "baseline of another camera": (baseline(0.063 / 0.12), "SCREEN_MOVED"),
    "baseline 5 % long": (baseline(1.05), "SCREEN_MOVED"),
    "baseline 3 % short": (baseline(0.97), "SCREEN_MOVED"),
    "disparity offset of a third of a pixel": (
        lambda d: d.update(disparity_offset_px=0.35),
        "SCREEN_MOVED",
    ),
    "focal length by the width": (scaled("focal_px", 2208 / 1920), "SCREEN_MOVED"),
}
REFUSED_CALIBRATIONS: dict[str, tuple[Change, str]] = {
    "baseline in millimetres": (baseline(1000.0), "metres"),
    "eyes exchanged": (baseline(-1.0), "right_from_left"),
    "focal length zero": (scaled("focal_px", 0.0), "focal_px"),
    "of another resolution": (lambda d: d.update(image_size=[640, 360]), "640"),
}
MOVED_SITES: dict[str, Change] = {
    "camera pitched": turned(4, 0, 0),
    "camera yawed": turned(0, 4, 0),
    "camera nearer": turned(0, 0, 0, z=0.06),
    "camera farther": turned(0, 0, 0, z=-0.06),
    "screen lowered": lambda d: d["grizzly"]["plane"].update(offset_m=-0.69),
}  # fmt: skip


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    quarter_scene(tmp_path / "scene")
    return tmp_path / "scene"


def edit(file: Path, change: Change) -> None:
    document = yaml.safe_load(file.read_text())
    change(document)
    file.write_text(yaml.safe_dump(document))


def run(scene: Path, *more: object, **options: Any) -> subprocess.CompletedProcess[str]:
    files = ["--calib", scene / "calibration.yaml", "--site", scene / "site.yaml", "--no-report"]
    every = ["--set", "order.include=all"]  # so small a picture shows none that is surely too large
    command = ["stereo-ore", "run", scene, *files, *every, "--out", scene.parent / "out", *more]
    done = subprocess.run(
        [str(word) for word in command], capture_output=True, text=True, timeout=120, **options
    )
    assert "Traceback" not in done.stderr
    return done


def refusal(done: subprocess.CompletedProcess[str]) -> str:
    """The one line of a command that refused, or whose only frame failed."""
    assert done.returncode == (3 if "no frame is usable" in done.stderr else 1), done.stderr
    return [line for line in done.stderr.splitlines() if line][-1]


def told(scene: Path) -> list[str]:
    """Codes of the one frame, whose record and message have no target."""
    (record,) = [
        json.loads(line)
        for line in (scene.parent / "out" / "frames.jsonl").read_text().splitlines()
    ]
    assert record["status"] == "degraded", record["reasons"]
    assert record["targets"] == []
    assert not message(record, 1, Origin(), age_s=0.0, valid_for_s=60.0).valid
    return [reason["code"] for reason in record["reasons"]]


def test_the_scene_as_it_is_has_targets(scene: Path) -> None:
    assert run(scene).returncode == 0
    record = json.loads((scene.parent / "out" / "frames.jsonl").read_text())
    assert (record["status"], bool(record["targets"])) == ("ok", True)
    assert message(record, 1, Origin(), age_s=0.0, valid_for_s=60.0).valid


@pytest.mark.parametrize("name", WRONG_CALIBRATIONS)
def test_a_wrong_calibration_is_told_and_gives_no_target(name: str, scene: Path) -> None:
    change, code = WRONG_CALIBRATIONS[name]
    edit(scene / "calibration.yaml", change)
    assert run(scene).returncode == 3, "the only frame is not usable"
    assert code in told(scene)


@pytest.mark.parametrize("name", REFUSED_CALIBRATIONS)
def test_an_impossible_calibration_is_refused(name: str, scene: Path) -> None:
    change, word = REFUSED_CALIBRATIONS[name]
    edit(scene / "calibration.yaml", change)
    assert word in refusal(run(scene))


@pytest.mark.parametrize("name", MOVED_SITES)
def test_a_camera_that_was_moved_is_told_and_gives_no_target(name: str, scene: Path) -> None:
    edit(scene / "site.yaml", MOVED_SITES[name])
    assert run(scene).returncode == 3, "the only frame is not usable"
    assert "SCREEN_MOVED" in told(scene)


@pytest.mark.parametrize("slid_m", [0.0, 0.06, -0.06])
def test_a_camera_that_slid_across_a_known_bar_is_told(slid_m: float, tmp_path: Path) -> None:
    scene = tmp_path / "scene"
    shutil.copytree(ROOT / "data" / "large_02", scene)
    document = yaml.safe_load((scene / "site.yaml").read_text())
    grizzly = document["grizzly"]
    across = np.cross(grizzly["plane"]["normal"], grizzly["bar"]["direction"])
    grizzly["bar"]["point_m"] = (grizzly["bar"]["point_m"] + slid_m * across).tolist()
    (scene / "site.yaml").write_text(yaml.safe_dump(document))
    assert run(scene).returncode == (3 if slid_m else 0)
    record = json.loads((tmp_path / "out" / "frames.jsonl").read_text())
    assert record["grizzly"]["registration"]["slide_m"] == pytest.approx(-slid_m, abs=0.006)
    if slid_m:
        assert "SCREEN_MOVED" in told(scene)


@pytest.mark.parametrize(
    "setting",
    [
        "matching.num_disparities=8",
        "filter.params.k=-1",
        "health.max_screen_offset=0",
        "health.min_of_usual=2",
        "voxel.size_m=.nan",
    ],
)
def test_a_parameter_out_of_range_is_refused_by_name(setting: str, scene: Path) -> None:
    line = refusal(run(scene, "--set", setting))
    assert setting.split("=")[0].split(".")[1] in line


def test_a_filter_that_keeps_nothing_gives_no_target(scene: Path) -> None:
    done = run(
        scene,
        "--set",
        "filter.method=radius",
        "--set",
        "filter.params={radius: 1e-6, min_points: 50}",
    )
    lines = (
        (scene.parent / "out" / "frames.jsonl").read_text() if done.returncode in (0, 3) else "{}"
    )
    assert done.returncode == 1 or json.loads(lines)["targets"] == []


def test_without_a_plane_of_bars_there_is_no_target(scene: Path) -> None:
    """The screen is not in view, and the site leaves its plane to be found."""
    edit(scene / "site.yaml", lambda d: d["grizzly"].update(plane="auto"))
    for eye in ("left", "right"):
        image = cv2.imread(str(scene / f"{eye}.png"))
        rng = np.random.default_rng(1)
        floor = cv2.GaussianBlur(
            rng.normal(0, 1, (image.shape[0], image.shape[1] + 60, 3)), (0, 0), 1.2
        )
        shift = 18 if eye == "right" else 0
        floor = 128 + 40 * floor[:, shift : shift + image.shape[1]] / floor.std()
        cv2.imwrite(str(scene / f"{eye}.png"), np.clip(floor, 0, 255).astype(np.uint8))
    run(scene)
    record = json.loads((scene.parent / "out" / "frames.jsonl").read_text())
    assert record["status"] in ("degraded", "failed")
    assert record["targets"] == []


def test_a_disk_that_is_full_ends_the_run_in_one_line(scene: Path) -> None:
    """No file may grow beyond 20 kB: writing a cloud fails as on a full disk."""
    line = refusal(
        run(scene, preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000)))
    )
    assert "can't be written" in line
    assert not (scene.parent / "out" / "frames.jsonl").exists()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_permission_is_refused_before_the_work(scene: Path) -> None:
    scene.parent.chmod(0o555)
    try:
        line = refusal(run(scene))
    finally:
        scene.parent.chmod(0o755)
    assert "ermission" in line
