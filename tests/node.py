"""Other programs' own JavaScript packages, where they are installed (npm install -g PACKAGE)."""

import json
import os
import shutil
import subprocess
from functools import cache
from pathlib import Path
from typing import Any

import pytest


@cache
def modules() -> Path | None:
    """Where node finds packages; None where there is no node or npm."""
    npm = shutil.which("npm")
    if not npm or not shutil.which("node"):
        return None
    known = os.environ.get("NODE_PATH")
    root = (
        known
        or subprocess.run([npm, "root", "-g"], capture_output=True, text=True, timeout=60).stdout
    )
    return Path(root.strip())


def run(script: str, *arguments: str, packages: tuple[str, ...]) -> list[dict[str, Any]]:
    """The lines of JSON that a script beside this file prints; the test is skipped without its
    packages."""
    root = modules()
    if root is None or not all((root / package).is_dir() for package in packages):
        pytest.skip(f"npm install -g {' '.join(packages)}")
    command = ["node", str(Path(__file__).with_name(script)), *arguments]
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        timeout=120,
        env=os.environ | {"NODE_PATH": str(root)},
    )
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
