"""No guess becomes a target: what the site does not give is named, wherever targets are missed."""

import json
import subprocess
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

import stereo_ore as so
from stereo_ore.chain import Chain
from stereo_ore.draw.overlay import draw_ground, draw_overlay
from stereo_ore.io import calibration
from stereo_ore.io.site import load_site
from stereo_ore.plant.sinks.message import Origin, message
from stereo_ore.stages.health import missing_in_site
from stereo_ore.types import Site

SCENE = Path(__file__).parents[1] / "data" / "paper_03"
LACKING = {
    "arm_from_camera": "NO_ARM_FRAME",
    "working_volume": "NO_VOLUME_GIVEN",
    "plane": "NO_PLANE_GIVEN",
}


def lacking(keys: set[str], folder: Path) -> Path:
    """The demo's site file without some of its keys; what is left stays in the camera's frame."""
    site = load_site(SCENE / "site.yaml")
    document = yaml.safe_load((SCENE / "site.yaml").read_text())
    assert site.T_arm_camera is not None
    if "arm_from_camera" in keys:
        del document["arm_from_camera"]
        assert site.volume is not None
        corners = site.volume.corners
        document["working_volume"] = {
            "frame": "camera",
            "min_m": corners.min(0).tolist(),
            "max_m": corners.max(0).tolist(),
        }
    if "working_volume" in keys:
        del document["working_volume"]
    if "plane" in keys:
        document["grizzly"]["plane"] = "auto"
    path = folder / "site.yaml"
    path.write_text(yaml.safe_dump(document))
    return path


@pytest.mark.parametrize(
    "keys",
    [{"arm_from_camera"}, {"working_volume"}, {"plane"}, {"working_volume", "plane"}],
    ids=lambda keys: "+".join(sorted(keys)),
)
def test_ores_are_found_and_no_target_is_given_where_a_key_is_missing(
    keys: set[str], tmp_path: Path
) -> None:
    detector = so.Detector.load(SCENE / "calibration.yaml", lacking(keys, tmp_path))
    (pair,) = so.open_recording(SCENE)
    result = detector(pair)
    # Without plane and volume no screen is found in this scene at all.
    assert bool(result.ores) == (len(keys) == 1)
    assert (result.targets, result.counts["targets"]) == ((), 0)
    assert {reason.code for reason in result.reasons} >= {LACKING[key] for key in keys}
    named = " ".join(reason.detail for reason in result.reasons)
    assert all(key in named for key in keys)
    sent = message(result.to_dict(), 1, Origin(), age_s=0.0, valid_for_s=5.0)
    assert (sent.valid, sent.targets) == (False, ())
    assert set(sent.reasons) >= {LACKING[key] for key in keys}


def test_a_background_stands_for_the_plane() -> None:
    site = load_site(SCENE / "site.yaml")
    chain = Chain(calibration.load(SCENE / "calibration.yaml"), site)
    assert chain.withheld == ()
    other = replace(site, plane=None, background=Path("empty.npz"))
    assert list(missing_in_site(other)) == []
    assert [reason.code for reason in missing_in_site(Site())] == list(LACKING.values())


def test_without_a_volume_frame_and_floor_are_no_ore() -> None:
    scene = SCENE.parent / "large_02"
    (pair,) = so.open_recording(scene)
    frame = so.Detector(calibration.load(scene / "calibration.yaml"))(pair).frame
    with np.load(scene / "gt.npz") as truth:
        lump = truth["instance_left"] >= 2
    assert frame.ore_map is not None
    labels = frame.ore_map.labels
    assert len(frame.ores) >= 9
    assert [ore.id for ore in frame.ores if lump[labels == ore.id].mean() < 0.5] == []


def test_the_demo_without_a_site_gives_ores_and_names_all_keys(tmp_path: Path) -> None:
    scene = SCENE.parent / "large_02"
    done = subprocess.run(
        [
            *("stereo-ore", "run", scene, "--calib", scene / "calibration.yaml"),
            *("--no-report", "--out", tmp_path / "out"),
        ],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    (record,) = map(json.loads, (tmp_path / "out" / "frames.jsonl").read_text().splitlines())
    assert (record["status"], record["targets"]) == ("ok", [])
    assert record["ores"]
    closing = done.stdout.splitlines()[-1]
    for key in ("arm_from_camera", "working_volume", "grizzly.plane or background"):
        assert key in closing
        assert key in done.stderr


def test_what_would_be_a_target_is_hatched(tmp_path: Path) -> None:
    detector = so.Detector.load(SCENE / "calibration.yaml", lacking({"arm_from_camera"}, tmp_path))
    (pair,) = so.open_recording(SCENE)
    frame = detector.chain(pair)
    assert frame.withheld == ("NO_ARM_FRAME",)
    assert frame.ore_map is not None
    hatched, plain = draw_ground(frame), draw_ground(replace(frame, withheld=()))
    changed = (hatched != plain).any(-1)
    for ore in frame.ores:
        wanted = ore.oversize is not False and ore.strike is not None
        assert changed[frame.ore_map.labels == ore.id].any() == wanted


def test_the_overlay_shows_the_targets_that_the_frames_before_leave(tmp_path: Path) -> None:
    files, settings = (SCENE / "calibration.yaml", SCENE / "site.yaml"), ["order.confirm=2 of 2"]
    detector = so.Detector.load(*files, settings=settings)
    so.run(SCENE, detector, tmp_path / "out", clouds=False, report=False)
    (record,) = map(json.loads, (tmp_path / "out" / "frames.jsonl").read_text().splitlines())
    (pair,) = so.open_recording(SCENE)
    result = detector(pair)
    assert result.targets
    assert record["targets"] == []
    shown = cv2.imread(str(tmp_path / "out" / "overlays" / f"{record['frame']}.png"))
    np.testing.assert_array_equal(shown, draw_overlay(result.frame, record))
    assert (shown != result.overlay().image).any()
