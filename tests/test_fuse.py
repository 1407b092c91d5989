"""`run --fuse N`: groups of frames measured as one; a scene that moves is refused."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereo_ore.cli import launch

FRAMES = 3


@pytest.fixture
def recording(synth_folder: Path, tmp_path: Path) -> Path:
    """Two groups of three frames: a still one with fresh noise, and one in which every frame is
    shifted."""
    folder = tmp_path / "recording"
    rng = np.random.default_rng(0)
    for eye in ("left", "right"):
        (folder / eye).mkdir(parents=True)
        image = cv2.imread(str(synth_folder / f"{eye}.png"))
        for i in range(2 * FRAMES):
            shaken = image if i < FRAMES else np.roll(image, (7 * i, 11 * i), (0, 1))
            noisy = np.clip(shaken + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8)
            cv2.imwrite(str(folder / eye / f"{i:03}.png"), noisy)
    return folder


def test_still_frames_are_one_record_and_moving_ones_a_reason(
    recording: Path, synth_folder: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    inputs = [
        "--calib",
        str(synth_folder / "calibration.yaml"),
        "--site",
        str(synth_folder / "site.yaml"),
    ]
    with pytest.raises(SystemExit):
        launch(
            [
                "run",
                str(recording),
                *inputs,
                "--out",
                str(out),
                "--fuse",
                str(FRAMES),
                "--no-report",
            ]
        )
    records = [json.loads(line) for line in (out / "frames.jsonl").read_text().splitlines()]
    assert [record["frame"] for record in records] == ["000", "003"]
    still, moving = records
    assert still["status"] == "ok"
    assert len(still["ores"]) >= 2
    assert moving["status"] == "failed"
    assert moving["reasons"][-1]["code"] == "MOVING_SCENE"
    description = json.loads((out / "run.json").read_text())
    assert description["parameters"]["matching"]["fuse"] == FRAMES
    assert 0 < description["search"]["saved_share"] < 1
