"""Long runs: memory does not grow with the number of frames."""

import os
import re
import subprocess
import time
from pathlib import Path

import pytest
from runs import quarter_scene

FRAMES, EARLY = 2000, 50


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory is read from /proc")
def test_memory_after_two_thousand_frames_is_that_after_fifty(tmp_path: Path) -> None:
    files = quarter_scene(tmp_path / "scene")
    recording, out = tmp_path / "recording", tmp_path / "out"
    recording.mkdir()
    for index in range(FRAMES):
        for eye in ("left", "right"):
            os.link(tmp_path / "scene" / f"{eye}.png", recording / f"{eye}{index:06d}.png")
    command = ["stereo-ore", "-q", "run", str(recording), *files, "--out", str(out), "--no-report"]
    early = late = 0
    with subprocess.Popen(command) as run:
        while run.poll() is None:
            late = peak_kb(run.pid) or late
            part = out / "frames.jsonl.part"
            if not early and part.exists() and part.read_bytes().count(b"\n") >= EARLY:
                early = late
            time.sleep(0.05)
    assert run.returncode == 0
    assert len((out / "frames.jsonl").read_text().splitlines()) == FRAMES
    assert 0 < early <= late <= 1.1 * early


def peak_kb(pid: int) -> int | None:
    """The largest resident set so far; None for a process that is gone."""
    try:
        found = re.search(r"VmHWM:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text())
    except OSError:
        return None
    return int(found[1]) if found else None
