"""The rerun recording of a run, read back by rerun's own tool; no display anywhere."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from runs import make_run, ore, record

from stereo_ore.draw.view import save_view
from stereo_ore.errors import OutputError, SourceError
from stereo_ore.io.results import Results

HEADLESS = {
    key: value for key, value in os.environ.items() if key not in ("DISPLAY", "WAYLAND_DISPLAY")
}


def run(*command: object) -> subprocess.CompletedProcess[str]:
    parts = [str(part) for part in command]
    return subprocess.run(parts, capture_output=True, text=True, timeout=60, env=HEADLESS)


def rerun_tool() -> str:
    pytest.importorskip("rerun", reason="the extra [view] is not installed")
    tool = shutil.which("rerun")
    assert tool
    return tool


def entities(path: Path) -> dict[str, int]:
    """Entity paths in a recording and how many chunks each has."""
    done = run(rerun_tool(), "rrd", "stats", path)
    return {
        name: int(count)
        for name, count in re.findall(r"^(/\S+): (\d+)$", done.stdout, re.MULTILINE)
    }


def test_recording_holds_everything_and_is_sound(tmp_path: Path) -> None:
    tool = rerun_tool()
    folder = make_run(tmp_path / "run")
    done = run("stereo-ore", "view", folder, "--save", tmp_path / "deep" / "run.rrd")
    assert done.returncode == 0, done.stderr
    path = Path(done.stdout.strip())
    assert path == tmp_path / "deep" / "run.rrd"
    assert run(tool, "rrd", "verify", path).returncode == 0
    found = entities(path)
    frame = ("cloud", "removed", "ores", "centres", "targets")
    wanted = {f"/world/frame/{name}" for name in frame} | {
        f"/camera/{n}" for n in ("overlay", "disparity", "ore_map")
    }
    wanted |= {"/world", "/world/camera", "/status", "/counts/pixels", "/counts/targets"}
    assert wanted <= found.keys()
    printed = run(tool, "rrd", "print", "-vvv", "--transposed", "true", path).stdout
    assert "1: 300 × 200 × 100 mm" in printed
    assert "target 1" in printed
    assert "UNPAIRED: left2.png: has no right partner" in printed


def test_without_stages_and_ores_there_is_less_but_no_failure(tmp_path: Path) -> None:
    rerun_tool()
    records = [record(0, [], stamp_ns=None), record(1, [ore(1, strike=False)], stamp_ns=None)]
    folder = make_run(tmp_path / "run", records, stages=False)
    (folder / "calibration.yaml").unlink()
    found = entities(save_view(Results(folder), tmp_path / "run.rrd"))
    assert {"/world/frame/cloud", "/world/frame/ores"} <= found.keys()
    assert (
        not {"/world/frame/removed", "/camera/disparity", "/world/frame/targets", "/world/camera"}
        & found.keys()
    )


def test_bad_places(tmp_path: Path) -> None:
    rerun_tool()
    with pytest.raises(SourceError, match=r"holds no frames\.jsonl"):
        save_view(Results(tmp_path), tmp_path / "x.rrd")
    assert not (tmp_path / "x.rrd").exists()
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="can't be written"):
        save_view(Results(make_run(tmp_path / "run")), tmp_path / "file" / "x.rrd")


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a window always opens")
def test_no_display_says_what_to_do(tmp_path: Path) -> None:
    done = run("stereo-ore", "view", make_run(tmp_path / "run"))
    assert done.returncode == 1
    assert (
        done.stderr
        == "error: there is no display. Give --save FILE.rrd, and open that where there is one\n"
    )


def test_missing_extra_is_one_line(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "run")
    code = (
        "import sys; sys.modules['rerun'] = None\nfrom stereo_ore.cli import launch;"
        f" launch(['view', {str(folder)!r}, '--save', {str(tmp_path / 'x.rrd')!r}])"
    )
    done = run(sys.executable, "-c", code)
    assert done.returncode == 1
    assert (
        done.stderr == "error: the optional package rerun-sdk is not installed. pip install"
        ' "stereo-ore[view]"\n'
    )
    assert not (tmp_path / "x.rrd").exists()
