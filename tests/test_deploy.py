"""The files in `deploy/`: the unit is one that systemd takes, and what they call exists."""

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from typer.main import get_command

from stereo_ore.cli import app, load_verbs

DEPLOY = Path(__file__).parents[1] / "deploy"


def options(words: list[str]) -> None:
    """Parse the words of `serve` as the command line would, without running it."""
    load_verbs()
    serve = get_command(app).commands["serve"]  # type: ignore[attr-defined]
    known = {name for parameter in serve.params for name in parameter.opts}
    place = words.index("serve")
    given = [word for word in words[place + 1 :] if word.startswith("--")]
    assert given
    assert set(given) <= known


def unit() -> str:
    return (DEPLOY / "stereo-ore.service").read_text()


def test_the_unit_is_taken_by_systemd(tmp_path: Path) -> None:
    if not shutil.which("systemd-analyze"):
        pytest.skip("systemd-analyze is not installed")
    file = tmp_path / "stereo-ore.service"
    file.write_text(unit().replace("/opt/stereo-ore/bin/stereo-ore", sys.executable))
    done = subprocess.run(["systemd-analyze", "verify", str(file)], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_the_unit_calls_serve_with_options_that_it_has() -> None:
    command = re.search(r"^ExecStart=((?:.*\\\n)*.*)$", unit(), re.MULTILINE)
    assert command
    options(shlex.split(command[1].replace("\\\n", " ")))
    assert "Restart=always" in unit()


def test_the_compose_file_calls_serve_and_gives_it_a_read_only_inbox() -> None:
    service = yaml.safe_load((DEPLOY / "compose.yaml").read_text())["services"]["stereo-ore"]
    options(service["command"])
    inbox = service["command"][service["command"].index("--watch") + 1]
    (mount,) = (v for v in service["volumes"] if isinstance(v, dict) and v["target"] == inbox)
    assert mount["read_only"]
    assert service["build"]["dockerfile"] == "deploy/Dockerfile"


def test_the_image_is_not_run_by_root_and_installs_what_there_is() -> None:
    text = (DEPLOY / "Dockerfile").read_text().replace("\\\n", " ")
    assert re.findall(r"^USER (.*)$", text, re.MULTILINE) == ["stereo-ore"]
    assert "cuda" not in text.lower()
    extras = re.search(r"/src\[([\w,]+)\]", text)
    assert extras
    project = (DEPLOY.parent / "pyproject.toml").read_text()
    for extra in extras[1].split(","):
        assert re.search(rf"^{extra} = \[", project, re.MULTILINE), extra
    assert (DEPLOY.parent / "constraints" / "newest.txt").is_file()
