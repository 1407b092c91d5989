"""`doctor` finds what is known to go wrong; `example` writes what the program can be tried with."""

import importlib.metadata
import json
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import pytest
from live import free_port
from typer.testing import CliRunner

from stereo_ore import installation
from stereo_ore.cli import app, launch, load_verbs
from stereo_ore.io.lock import FolderLock
from stereo_ore.plant import doctor
from stereo_ore.plant.doctor import Plan, examine

EXAMPLE = Path(doctor.__file__).parents[1] / "example"


@pytest.fixture
def plan(tmp_path: Path) -> dict[str, Any]:
    """A plan that is in order."""
    inbox = tmp_path / "in"
    inbox.mkdir()
    for name in ("left.jpg", "right.jpg"):
        shutil.copy(EXAMPLE / name, inbox)
    for name in ("calibration.yaml", "site.yaml"):
        shutil.copy(EXAMPLE / name, tmp_path)
    return {
        "calib": tmp_path / "calibration.yaml",
        "site": tmp_path / "site.yaml",
        "watch": inbox,
        "out": tmp_path / "live",
        "ports": (("tcp", free_port()),),
    }


def test_a_machine_that_is_in_order(plan: dict[str, Any]) -> None:
    findings = list(examine(Plan(**plan)))
    assert [each for each in findings if each.verdict == "fault"] == []
    assert {each.check for each in findings} == set(doctor.CHECKS) - {"parameters"}
    assert not plan["out"].exists()


# --- planted faults


def wheels(plan: dict[str, Any], patch: pytest.MonkeyPatch) -> str:
    real = importlib.metadata.distribution
    others = {"opencv-python": "numpy"}
    patch.setattr(installation, "distribution", lambda name: real(others.get(name, name)))
    return "installation: opencv-python and opencv-contrib-python-headless overwrite each other"


def package(plan: dict[str, Any], patch: pytest.MonkeyPatch) -> str:
    patch.setitem(sys.modules, "open3d", None)
    return "installation: open3d: "


def clock(plan: dict[str, Any], patch: pytest.MonkeyPatch) -> str:
    patch.setattr(time, "time", lambda: 1000.0)
    return "clock: says "


def disk(plan: dict[str, Any], patch: pytest.MonkeyPatch) -> str:
    patch.setattr(doctor, "free_bytes", lambda folder: 10**6)
    return "results: "


def results_file(plan: dict[str, Any], patch: pytest.MonkeyPatch) -> str:
    plan["out"].write_text("")
    return "nothing can be written there"


def results_in_use(plan: dict[str, Any], patch: pytest.MonkeyPatch) -> str:
    plan["out"].mkdir()
    plan["lock"] = FolderLock(plan["out"])
    return "is in use by another"


def inbox(plan: dict[str, Any], patch: pytest.MonkeyPatch) -> str:
    plan["watch"] = plan["watch"] / "none"
    return "inbox: "


def calibration(plan: dict[str, Any], patch: pytest.MonkeyPatch) -> str:
    plan["calib"].write_text(plan["calib"].read_text().replace("529.6", "-529.6"))
    return "calibration: "


def another_size(plan: dict[str, Any], patch: pytest.MonkeyPatch) -> str:
    for file in plan["watch"].iterdir():
        cv2.imwrite(str(file), cv2.resize(cv2.imread(str(file)), (640, 360)))
    return "the inbox holds images of 640 × 360 px"


def site(plan: dict[str, Any], patch: pytest.MonkeyPatch) -> str:
    plan["site"].write_text("format: stereo_ore/site\nversion: 1\nopening: 3\n")
    return "site: "


def parameters(plan: dict[str, Any], patch: pytest.MonkeyPatch) -> str:
    plan["config"] = plan["calib"].with_name("parameters.yaml")
    plan["config"].write_text("health: {min_sharpnes: 1}\n")
    return "parameters: "


def port(plan: dict[str, Any], patch: pytest.MonkeyPatch) -> str:
    plan["server"] = socket.create_server(("127.0.0.1", plan["ports"][0][1]))
    return "is another program listening there?"


def extra(plan: dict[str, Any], patch: pytest.MonkeyPatch) -> str:
    plan["ports"] = (("opcua", free_port()),)
    for name in [name for name in sys.modules if name.partition(".")[0] == "asyncua"]:
        patch.delitem(sys.modules, name)
    for name in ("opcua", "opcua_access", "opcua_model", "opcua_nodeset"):
        patch.delitem(sys.modules, f"stereo_ore.plant.sinks.{name}", raising=False)
    patch.setitem(sys.modules, "asyncua", None)
    return "consumers: "


def users(plan: dict[str, Any], patch: pytest.MonkeyPatch) -> str:
    folder = plan["calib"].parent
    (folder / "users").write_text("arm: secret\n")
    (folder / "users").chmod(0o644)
    text = {"format": "stereo_ore/sinks", "mqtt": {"host": "127.0.0.1", "users": "users"}}
    plan["sinks"], plan["ports"] = folder / "sinks.yaml", ()
    plan["sinks"].write_text(json.dumps(text))
    return "others may read it"


def frame(plan: dict[str, Any], patch: pytest.MonkeyPatch) -> str:
    patch.setattr(doctor, "Config", lambda: doctor.load_config(None, ["health.min_share=0.99"]))
    return "built-in frame: "


FAULTS = (wheels, package, clock, disk, results_file, results_in_use, inbox, calibration)
MORE = (another_size, site, parameters, port, extra, users, frame)


@pytest.mark.parametrize("fault", [*FAULTS, *MORE], ids=lambda fault: fault.__name__)
def test_a_planted_fault_is_found(
    fault: Callable[..., str], plan: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = fault(plan, monkeypatch)
    held = [plan.pop(name) for name in ("lock", "server") if name in plan]
    if fault is not frame:
        monkeypatch.delitem(doctor.CHECKS, "built-in frame")
    findings = [each for each in examine(Plan(**plan)) if each.verdict == "fault"]
    for each in held:
        each.close()
    texts = [f"{each.check}: {each.text}" for each in findings]
    assert len(texts) == 1, texts
    assert expected.lower() in texts[0].lower()


def test_what_is_missing_from_a_site_is_a_warning(plan: dict[str, Any]) -> None:
    plan["site"].write_text("format: stereo_ore/site\nversion: 1\n")
    findings = [each for each in examine(Plan(site=plan["site"])) if each.check == "site"]
    assert [each.verdict for each in findings] == ["warning"] * 3
    assert "no target is ever valid" in findings[0].text


def test_the_verb_ends_with_3_where_there_is_a_fault(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    load_verbs()
    monkeypatch.delitem(doctor.CHECKS, "built-in frame")
    done = CliRunner().invoke(app, ["doctor", "--watch", str(tmp_path / "none")])
    assert done.exit_code == 3
    assert "fault    inbox: " in done.output
    assert CliRunner().invoke(app, ["doctor", "--watch", str(tmp_path)]).exit_code == 0


def test_a_conflicting_opencv_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        installation, "conflicting_wheels", lambda: ["opencv-python", "opencv-contrib"]
    )

    def broken(*arguments: Any) -> None:
        raise AttributeError("module 'cv2' has no attribute 'ximgproc'")

    monkeypatch.setattr("stereo_ore.cli.load_verbs", broken)
    with pytest.raises(SystemExit) as end:
        launch([])
    assert end.value.code == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "pip uninstall -y opencv-python opencv-contrib && pip install" in said
    monkeypatch.setattr(installation, "conflicting_wheels", list)
    with pytest.raises(AttributeError):
        launch([])


def test_the_example_is_written_once_and_gives_targets(tmp_path: Path) -> None:
    load_verbs()
    folder = tmp_path / "demo"
    done = CliRunner().invoke(app, ["example", str(folder)])
    assert done.exit_code == 0
    assert sorted(file.name for file in folder.iterdir()) == [
        "calibration.yaml",
        "left.jpg",
        "right.jpg",
        "site.yaml",
    ]
    assert sum(file.stat().st_size for file in folder.iterdir()) < 10**6
    again = CliRunner().invoke(app, ["example", str(folder)])
    assert "is there already" in str(again.exception)
    words = done.output.split()
    ran = subprocess.run([sys.executable, "-m", "stereo_ore", *words[1:], "--no-report"],
                         capture_output=True, text=True, timeout=300)  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    record = json.loads((folder / "out" / "frames.jsonl").read_text())
    assert record["status"] == "ok"
    assert record["targets"]


def test_a_shell_can_complete_verbs() -> None:
    environment = {"_STEREO_ORE_COMPLETE": "complete_bash", "COMP_WORDS": "stereo-ore doc",
                   "COMP_CWORD": "1"}  # fmt: skip
    code = "import sys; sys.argv[0] = 'stereo-ore'; from stereo_ore.cli import launch; launch()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120,
                          env=os.environ | environment)  # fmt: skip
    assert done.stdout.split() == ["doctor"]
