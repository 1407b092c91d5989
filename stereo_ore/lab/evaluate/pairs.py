"""Which result belongs to which truth."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy.typing as npt

from stereo_ore.errors import SourceError
from stereo_ore.io.npz_io import load_arrays
from stereo_ore.io.results import Results


@dataclass(frozen=True)
class TruthPair:
    """A scene folder and the run folder and frame that are its result."""

    scene: Path
    run: Path
    frame: str

    def record(self) -> dict[str, Any]:
        """The frame's line of frames.jsonl."""
        return _records(self.run)[self.frame]

    def stages(self) -> dict[str, npt.NDArray[Any]]:
        """The frame's arrays, written by ``run --save-stages``."""
        path = self.run / "stages" / f"{self.frame}.npz"
        if not path.is_file():
            raise SourceError("no such file", file=path, remedy="Run with --save-stages")
        return load_arrays(path, SourceError)

    def total_ms(self) -> float | None:
        """Time the frame took, where timings were written."""
        timing = Results(self.run).timings.get(self.frame)
        return float(timing["total_ms"]) if timing else None


def find_pairs(results: Path, truth: Path) -> list[TruthPair]:
    """Pairs of the scenes in `truth` and the frames in `results`, sorted by scene.

    `truth` is a scene folder or a folder of them. `results` is one run folder, whose frames carry
    the names of the scenes (a run of one frame fits one scene, whatever its name), or a folder with
    a run folder a scene, at ``<scene>`` or ``<scene>/out``.

    Raises
    ------
    SourceError
        When there is no scene, or no result for one of them.
    """
    scenes = (
        [truth]
        if (truth / "calib.json").is_file()
        else sorted(p.parent for p in truth.glob("*/calib.json"))
    )
    if not scenes:
        raise SourceError(
            "holds no scene with truth",
            file=truth,
            remedy="A scene folder has calib.json and gt.json",
        )
    if (results / "frames.jsonl").is_file():
        return [
            TruthPair(scene, results, _frame(results, scene, len(scenes) == 1)) for scene in scenes
        ]
    return [_own_run(results, scene) for scene in scenes]


def _own_run(results: Path, scene: Path) -> TruthPair:
    for run in (results / scene.name, results / scene.name / "out"):
        if (run / "frames.jsonl").is_file():
            return TruthPair(scene, run, _frame(run, scene, alone=True))
    raise SourceError(
        f"holds no run of scene {scene.name}",
        file=results,
        remedy=f"Expected {scene.name}/frames.jsonl",
    )


def _frame(run: Path, scene: Path, alone: bool) -> str:
    frames = list(_records(run))
    if scene.name in frames:
        return scene.name
    if alone and len(frames) == 1:
        return frames[0]
    raise SourceError(f"has no frame named {scene.name}", file=run / "frames.jsonl")


def _records(run: Path) -> dict[str, dict[str, Any]]:
    path = run / "frames.jsonl"
    try:
        records = [json.loads(line) for line in path.read_bytes().splitlines()]
        return {record["frame"]: record for record in records}
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as fault:
        raise SourceError(f"can't be read: {fault!r}", file=path) from None
