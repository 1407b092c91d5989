"""Hashes of everything that a run writes, so that a change of shape can prove that it changed no
result.

``python tests/golden.py`` writes golden.json anew, for the versions that it runs with; the commit
that does so says which results changed, and why. Bytes depend on OpenCV's and NumPy's own kernels,
so hashes are kept for one combination of them and are not judged on another. Scenes are rendered by
a ray caster that rounds otherwise on other processors: where the pictures have other hashes, what
follows from them is not judged."""

import contextlib
import hashlib
import json
import platform
import shutil
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
from threadpoolctl import threadpool_info

from stereo_ore.cli import launch
from stereo_ore.lab import synth

ROOT = Path(__file__).parents[1]
FILE = Path(__file__).with_name("golden.json")
RECORDED = ("paper_03", "large_02")
SYNTHETIC = {  # name of a scene: family, seed, lumps, whether the site is given
    "paper": ("paper", 21, 5, True),
    "large": ("large", 22, 7, True),
    "hard": ("hard", 23, 6, True),
    "raw": ("raw", 24, 5, True),
    "empty": ("empty", 25, 0, True),
    "no_site": ("large", 22, 7, False),
}
SCENES = (*RECORDED, *SYNTHETIC)
LINES = ("frames.jsonl", "ores.csv")
FOLDERS = ("clouds", "overlays", "stages")

Hashes = dict[str, str]


def environment() -> str:
    """What bytes may depend on beside the program."""
    widths = {"AVX2", "AVX512-SKX", "NEON"}
    wide = sorted(widths & set(cv2.getCPUFeaturesLine().replace("*", "").split()))
    packages = {name: version(name) for name in ("numpy", "onnxruntime", "scipy")}
    # Of OpenBLAS: the processor's, or what OPENBLAS_CORETYPE asks for.
    kernels = {
        str(each["architecture"])
        for each in threadpool_info()
        if each["internal_api"] == "openblas"
    }
    return " ".join(
        [
            platform.machine(),
            *wide,
            *sorted(kernels),
            f"opencv {cv2.__version__}",
            *(f"{k} {v}" for k, v in packages.items()),
        ]
    )


@cache
def scene(name: str, parent: Path) -> Path:
    """Folder of a scene: left.png, right.png, calibration.yaml and, where it is given,
    site.yaml."""
    if name in RECORDED:
        return ROOT / "data" / name
    family, seed, lumps, with_site = SYNTHETIC[name]
    spec = synth.sample_spec(seed, family, "VGA")
    folder = synth.write(synth.scene(replace(spec, lumps=lumps, supersampling=1)), parent / name)
    if not with_site:
        (folder / "site.yaml").unlink()
    return folder


def run(source: Path, folder: Path, out: Path, *options: str) -> Hashes:
    """What the command writes for `source`, with calibration and site of the scene in `folder`."""
    site = folder / "site.yaml"
    arguments = [
        "-q",
        "run",
        source.name,
        "--calib",
        str(folder / "calibration.yaml"),
        "--out",
        str(out),
    ]
    # Times of files are not those of another checkout.
    arguments += ["--start-time", "2026-01-01T00:00:00Z", "--fps", "1"]
    arguments += [
        "--save-stages",
        "--no-report",
        *(("--site", str(site)) if site.is_file() else ()),
        *options,
    ]
    with (
        contextlib.chdir(source.parent),
        contextlib.suppress(SystemExit),
        contextlib.redirect_stdout(None),
    ):
        launch(arguments)
    return hashes(out)


def pictures(folder: Path) -> Hashes:
    """Hash of each eye's picture of a scene."""
    return {
        eye: hashlib.sha256(content(folder / f"{eye}.png")).hexdigest()[:16]
        for eye in ("left", "right")
    }


def hashes(out: Path) -> Hashes:
    """Hash of each result file; of pictures and archives that of their arrays, since packing them
    is not ours."""
    files = [out / name for name in LINES] + sorted(
        file for name in FOLDERS for file in (out / name).glob("*")
    )
    return {
        file.relative_to(out).as_posix(): hashlib.sha256(content(file)).hexdigest()[:16]
        for file in files
    }


def content(file: Path) -> bytes:
    if file.suffix == ".png":
        return np.asarray(cv2.imread(str(file), cv2.IMREAD_UNCHANGED)).tobytes()
    if file.suffix == ".npz":
        with np.load(file) as arrays:
            return b"".join(name.encode() + arrays[name].tobytes() for name in sorted(arrays.files))
    return file.read_bytes()


def recording(scene_folder: Path, folder: Path) -> Path:
    """Four frames: the scene, brighter and darker copies, and one whose right image is missing."""
    folder.mkdir()
    for index, gain in enumerate((1.0, 0.9, 0.8, 0.7)):
        for eye in ("left", "right"):
            image = cv2.imread(str(scene_folder / f"{eye}.png"))
            cv2.imwrite(
                str(folder / f"{eye}{index:06d}.png"), np.rint(image * gain).astype(np.uint8)
            )
    (folder / "right000002.png").unlink()
    return folder


@contextlib.contextmanager
def threads(count: int) -> Iterator[None]:
    earlier = cv2.getNumThreads()
    cv2.setNumThreads(count)
    try:
        yield
    finally:
        cv2.setNumThreads(earlier)


def main() -> None:
    with tempfile.TemporaryDirectory() as temporary, threads(1):
        parent = Path(temporary)
        found, seen = {}, {}
        for name in SCENES:
            folder = scene(name, parent)
            seen[name] = pictures(folder)
            found[name] = run(folder, folder, parent / "out" / name)
        folder = scene("paper", parent)
        found["recording"] = run(
            recording(folder, parent / "recording"), folder, parent / "out" / "recording"
        )
        shutil.rmtree(parent / "out")
    FILE.write_text(
        json.dumps({"environment": environment(), "pictures": seen, "hashes": found}, indent=1)
        + "\n",
        encoding="utf-8",
    )
    sys.stdout.write(f"{FILE}: {sum(map(len, found.values()))} hashes, {environment()}\n")


if __name__ == "__main__":
    main()
