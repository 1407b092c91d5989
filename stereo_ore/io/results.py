"""The folder that a run has written, read back: records, timings, clouds, overlays, stages,
inputs.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy.typing as npt

from stereo_ore.config import Config
from stereo_ore.errors import SourceError
from stereo_ore.io import calibration, clouds
from stereo_ore.io.npz_io import load_arrays
from stereo_ore.io.parameters import load_config
from stereo_ore.io.record_check import SCHEMAS, record_fault
from stereo_ore.io.segments import line_files
from stereo_ore.io.site import load_site
from stereo_ore.record import SCHEMA
from stereo_ore.stages.rectify import make_rectifier
from stereo_ore.types import Json, Rig, Site

CLOUD_COLUMNS = ("x", "y", "z", "red", "green", "blue", "ore_id", "score")
STAGE_KINDS = {
    "disparity": "f",
    "voxel_xyz": "f",
    "keep": "b",
    "score": "f",
    "ore_id": "i",
    "ore_map": "i",
}
"""Arrays of a frame's stages, and their kinds of NumPy types."""
HALF_PAIR = re.compile(r"\\u[dD][89a-fA-F]")
"""Beginning or end of a surrogate pair in JSON."""


@dataclass(frozen=True)
class Results:
    """A run's folder; an unfinished run is read as far as it goes, one of many days in all its
    segments, and what a frame does not have is None.
    """

    folder: Path

    @cached_property
    def records(self) -> tuple[Json, ...]:
        """The records of all frames; as `each_record`."""
        return tuple(self.each_record())

    def each_record(self) -> Iterator[Json]:
        """The records one after the other: a long run need not fit into memory.

        Raises
        ------
        SourceError
            When there are none, or a line is no record.
        """
        files = line_files(self.folder, "frames")
        if not files:
            raise SourceError(
                "holds no frames.jsonl", file=self.folder, remedy="Name the --out folder of a run"
            )
        for file in files:
            for number, record in enumerate(_objects(file), 1):
                yield _checked(record, file, number)

    def inputs(self) -> Iterator[Json]:
        """Files and their SHA-256 of each frame, as far as the run noted them."""
        for file in line_files(self.folder, "inputs"):
            yield from _objects(file)
        if not (self.folder / "inputs.jsonl.part").is_file():
            yield from self.run.get("inputs", ())

    @cached_property
    def timings(self) -> Mapping[str, Json]:
        """Milliseconds of each frame's stages, by the frame's name."""
        files = line_files(self.folder, "timings")
        return {
            entry["frame"]: entry for file in files for entry in _objects(file) if _is_timing(entry)
        }

    @cached_property
    def run(self) -> Json:
        """What ``run.json`` says; empty without one."""
        return self._object("run.json") or {}

    @cached_property
    def calibration_check(self) -> Json | None:
        """The verdict on the calibration by the run's own images."""
        return self._object("calibration_check.json")

    @property
    def finished(self) -> bool:
        """Whether the run came to its end."""
        return bool(self.run.get("finished"))

    @cached_property
    def site(self) -> Site:
        """The site that the run was made with."""
        file = self.folder / "site.yaml"
        return load_site(file) if file.is_file() else Site()

    @cached_property
    def config(self) -> Config:
        """The resolved parameters."""
        file = self.folder / "config.yaml"
        return load_config(file if file.is_file() else None, ())

    @cached_property
    def camera(self) -> str | None:
        """What the calibration calls the camera."""
        file = self.folder / "calibration.yaml"
        return calibration.load(file).camera if file.is_file() else None

    @cached_property
    def rig(self) -> Rig | None:
        """Geometry of the rectified images."""
        file = self.folder / "calibration.yaml"
        return make_rectifier(calibration.load(file)).rig if file.is_file() else None

    def text(self, name: str) -> str | None:
        """A text file of the folder."""
        file = self.folder / name
        return file.read_text(encoding="utf-8", errors="replace") if file.is_file() else None

    def overlay(self, frame: str) -> Path | None:
        """The overlay of a frame."""
        return _existing(self.folder / "overlays" / f"{frame}.png")

    def cloud(self, frame: str) -> clouds.Records | None:
        """The filtered cloud of a frame: x y z [m], red green blue, ore_id, score."""
        file = _existing(self.folder / "clouds" / f"{frame}.ply")
        cloud = clouds.read(file) if file else None
        if cloud is not None and (missing := set(CLOUD_COLUMNS) - set(cloud.dtype.names or ())):
            raise SourceError(f"has no column {min(missing)}", file=file, remedy="Repeat the run")
        return cloud

    def stages(self, frame: str) -> Mapping[str, npt.NDArray[Any]] | None:
        """The arrays that `run --save-stages` keeps of a frame."""
        file = _existing(self.folder / "stages" / f"{frame}.npz")
        if file is None:
            return None
        arrays = load_arrays(file, SourceError)
        if not _are_stages(arrays):
            raise SourceError(
                "holds other arrays than a run's stages", file=file, remedy="Repeat the run"
            )
        return arrays

    def _object(self, name: str) -> Json | None:
        file = _existing(self.folder / name)
        return (
            _object(file.read_text(encoding="utf-8", errors="replace"), file, 1) if file else None
        )


def parse_record(text: str, file: Path, number: int) -> Json:
    """The record in line `number` of a file.

    Raises
    ------
    SourceError
        When it is none.
    """
    return _checked(_object(text, file, number), file, number)


def _finite(text: str) -> float:
    """A number of JSON, which knows neither NaN nor infinity."""
    if not math.isfinite(value := float(text)):
        raise ValueError(f"{text} is no number")
    return value


def _checked(record: Json, file: Path, number: int) -> Json:
    if record.get("schema") not in SCHEMAS:
        raise SourceError(
            f"line {number} is no record of {SCHEMA}", file=file, remedy="Repeat the run"
        )
    if fault := record_fault(record):
        raise SourceError(
            f"line {number} is no record: {fault}", file=file, remedy="Repeat the run"
        )
    return record


def _is_timing(entry: Json) -> bool:
    stages, total = entry.get("stages_ms"), entry.get("total_ms")
    values = [total, *stages.values()] if isinstance(stages, dict) else [None]
    return isinstance(entry.get("frame"), str) and all(
        isinstance(value, int | float) for value in values
    )


def _are_stages(arrays: Mapping[str, npt.NDArray[Any]]) -> bool:
    """Whether arrays are those of `sinks.frame_files.stages_npz`, and fit each other."""
    if {name: array.dtype.kind for name, array in arrays.items()} != STAGE_KINDS:
        return False
    count = len(arrays["keep"].ravel())
    shapes = dict.fromkeys(("keep", "score", "ore_id"), (count,)) | {"voxel_xyz": (count, 3)}
    return all(arrays[name].shape == shape for name, shape in shapes.items()) and (
        arrays["disparity"].ndim == 2 and arrays["disparity"].shape == arrays["ore_map"].shape
    )


def _existing(file: Path) -> Path | None:
    return file if file.is_file() else None


def _objects(file: Path) -> Iterator[Json]:
    """The JSON objects of a file, one a line; a last line that is cut off is left out."""
    with file.open(encoding="utf-8", errors="replace", newline="\n") as lines:
        for number, line in enumerate(lines, 1):
            if line.endswith("\n"):
                yield _object(line, file, number)


def _object(text: str, file: Path, number: int) -> Json:
    try:
        value = json.loads(text, parse_float=_finite, parse_constant=_finite)
        if HALF_PAIR.search(text):
            # Names that are no UTF-8 are halves of surrogate pairs in JSON; no table could hold
            # them.
            value = json.loads(json.dumps(value, ensure_ascii=False).encode(errors="replace"))
    except (ValueError, RecursionError):
        value = None
    if not isinstance(value, dict):
        raise SourceError(f"line {number} is no JSON object", file=file, remedy="Repeat the run")
    return value
