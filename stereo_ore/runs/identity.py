"""What a run is made from: the same for the same inputs, so that a killed run may go on."""

from __future__ import annotations

import platform
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from stereo_ore.chain import Chain
from stereo_ore.io.atomic import write_bytes_where_new
from stereo_ore.io.calibration import dump
from stereo_ore.io.parameters import dump_config
from stereo_ore.runs.driver import sha256
from stereo_ore.version import __version__

_SCHEMA = "stereo_ore/run/1"
PACKAGES = (
    "numpy",
    "scipy",
    "scikit-learn",
    "opencv-contrib-python-headless",
    "onnxruntime",
    "open3d-cpu",
    "open3d",
    "pydantic",
)


@dataclass(frozen=True)
class InputFiles:
    """Files that a run was told to use, each where one was given."""

    calib: Path | None = None
    site: Path | None = None
    config: Path | None = None


def description(source: str, chain: Chain, files: InputFiles, **more: Any) -> dict[str, Any]:
    """Versions, parameters, and the SHA-256 of every file that the results depend on."""
    link = chain.site.posture
    given = {
        **vars(files),
        "background": chain.site.background,
        "posture": link.file if link else None,
    }
    hashes = {
        key: {"path": str(path), "sha256": sha256(path)} for key, path in given.items() if path
    }
    return {
        "schema": _SCHEMA,
        "versions": versions(),
        "source": source,
        "parameters": chain.config.model_dump(mode="json"),
        "files": hashes,
        "models": {"lumps": {"sha256": chain.lumps.card.sha256}},
        **more,
    }


def write_inputs(out: Path, chain: Chain, files: InputFiles) -> None:
    """Write what is needed to repeat the run beside its results."""
    write_bytes_where_new(out / "config.yaml", dump_config(chain.config).encode())
    write_bytes_where_new(out / "calibration.yaml", dump(chain.calibration).encode())
    if files.site:
        write_bytes_where_new(out / "site.yaml", files.site.read_bytes())


def versions() -> Mapping[str, str]:
    """Versions of this program and of the packages that its results depend on."""
    found = {
        "stereo-ore": __version__,
        "python": platform.python_version(),
        "platform": sys.platform,
    }
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found
