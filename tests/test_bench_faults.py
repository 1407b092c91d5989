"""``bench faults``: what counts as a wrong target, what is planted, and that the planted is
told."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from stereo_ore.cli import app, load_verbs
from stereo_ore.config import Config
from stereo_ore.lab import synth
from stereo_ore.lab.bench import fault_images, fault_scenes, fault_setup, faults


@pytest.fixture(scope="module")
def planted(synth_scene: synth.Scene) -> fault_scenes.Planted:
    return fault_scenes.made_scenes(synth_scene)


def record_of(strike: np.ndarray, depth: float) -> dict[str, Any]:
    point = {"arm": strike.tolist(), "camera": [0.0, 0.0, depth]}
    ores = [{"id": 1, "strike": {"point": point}}]
    return {"status": "ok", "reasons": [], "targets": [1], "ores": ores}


@pytest.mark.parametrize(
    ("off", "depth", "wrong"), [(0.0, 1.0, 0), (0.02, 0.5, 0), (0.5, 2.0, 1), (0.05, 3.0, 0)]
)
def test_a_strike_off_each_lump_is_wrong(
    planted: fault_scenes.Planted, off: float, depth: float, wrong: int
) -> None:
    T = planted.case.site.T_arm_camera
    up = T[:3, :3] @ planted.case.site.plane.normal
    points = planted.lumps.data
    strike = points[np.argmax(points @ up)] + off * up
    assert planted.wrong_targets(record_of(strike, depth)) == wrong


def test_a_row_counts_frames_with_wrong_targets_and_sound_ones_that_are_lost() -> None:
    ok = {"status": "ok", "reasons": [], "targets": [1, 2]}
    row = faults.FaultRow("drop")
    assert row.add(ok, 0) is None
    assert "2 of 2" in (row.add(ok, 2) or "")
    assert (row.frames, row.targets, row.wrong, row.wrong_ok_frames, row.failed) == (
        2,
        4,
        2,
        1,
        True,
    )
    lost = faults.FaultRow(faults.SOUND)
    lost.add({"status": "degraded", "reasons": [{"code": "TOO_DARK"}], "targets": []}, 0)
    assert lost.failed
    assert "| drop | 2 | 2 |" in faults.faults_markdown([row])


@pytest.mark.parametrize("name", fault_images.EDITS)
def test_an_edit_changes_the_last_frame_only_and_always_alike(
    name: str, planted: fault_scenes.Planted
) -> None:
    one, again = (
        fault_images.plant_in_images(fault_images.EDITS[name], planted, 3) for _ in range(2)
    )
    assert np.array_equal(one.frames[1].left, again.frames[1].left)
    assert np.array_equal(one.frames[1].right, again.frames[1].right)
    sound = fault_scenes.exposed(planted.case.frames[-1], 300)
    assert np.array_equal(one.frames[0].right, sound.right)
    now = fault_scenes.exposed(planted.case.frames[-1], 301)
    assert not (
        np.array_equal(one.frames[1].left, now.left)
        and np.array_equal(one.frames[1].right, now.right)
    )


def test_a_small_error_of_the_site_moves_the_site_and_nothing_else(
    planted: fault_scenes.Planted,
) -> None:
    case = fault_setup.SMALL_FAULTS["camera +10 mm along z"](planted.case)
    assert case.calibration is planted.case.calibration
    before, after = planted.case.site.plane, case.site.plane
    assert abs(after.offset - before.offset) == pytest.approx(0.01 * abs(before.normal[2]))


def test_what_is_planted_in_a_made_up_scene_leaves_no_wrong_target(
    planted: fault_scenes.Planted,
) -> None:
    only = r"^none|baseline -2|offset \+0.4|band slipped -8|wobble 3"
    found = dict(faults.plant_fault(planted, Config(), only, seed=1))
    assert found["none"]["status"] == "ok"
    assert len(found["none"]["targets"]) > 0
    assert {name: planted.wrong_targets(record) for name, record in found.items()} == dict.fromkeys(
        found, 0
    )


def test_the_command_takes_folders_with_truth(shared_data: Path) -> None:
    folder = shared_data / "scenes_dev" / "large_02"
    if not folder.is_dir():
        pytest.skip("no path-traced scenes beside the repository")
    load_verbs()
    done = CliRunner().invoke(
        app, ["bench", "faults", "--scenes", str(folder), "--only", "^none|baseline -2.0|magnifies"]
    )
    assert done.exit_code == 0, done.output
    rows = [line.split(" | ") for line in done.output.splitlines() if line.startswith("| ")]
    assert [row[0].removeprefix("| ") for row in rows[1:]] == [
        "none",
        "baseline -2.0 %",
        "drop magnifies 6 %",
    ]
    assert [row[10] for row in rows[1:]] == ["0", "0", "0"]


def test_raw_images_are_not_edited(planted: fault_scenes.Planted) -> None:
    raw = replace(
        planted,
        case=replace(planted.case, calibration=replace(planted.case.calibration, images="raw")),
    )
    assert [name for name, _ in faults.plant_fault(raw, Config(), only="slipped|wobble")] == []
