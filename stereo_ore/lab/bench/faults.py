"""Faults planted in scenes with truth: what the record says, and whether a wrong target is left for
an arm.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

from stereo_ore.chain import Chain
from stereo_ore.config import Config
from stereo_ore.errors import StereoOreError
from stereo_ore.lab.bench import fault_images, fault_setup
from stereo_ore.lab.bench.fault_scenes import Case, Planted, exposed
from stereo_ore.runs.driver import frame_lines
from stereo_ore.runs.history import Watch
from stereo_ore.types import Json

SOUND = "none"
"""The name of no fault."""


@dataclass
class FaultRow:
    """What became of a fault over all scenes; `wrong` are targets on no lump, `wrong_ok_frames` the
    frames with any.
    """

    fault: str
    frames: int = 0
    statuses: Counter[str] = field(default_factory=Counter)
    codes: Counter[str] = field(default_factory=Counter)
    with_targets: int = 0
    targets: int = 0
    wrong: int = 0
    wrong_ok_frames: int = 0
    failed: bool = False

    def add(self, record: Json | None, wrong: int) -> str | None:
        """Add a frame; what is wrong with it: a wrong target, or a sound frame that was refused."""
        status = "refused" if record is None else record["status"]
        reasons = [] if record is None else sorted({reason["code"] for reason in record["reasons"]})
        targets = 0 if record is None else len(record["targets"])
        self.frames += 1
        self.statuses[status] += 1
        self.codes.update(reasons)
        self.with_targets += targets > 0
        self.targets += targets
        self.wrong += wrong
        self.wrong_ok_frames += wrong > 0
        lost = self.fault == SOUND and status not in ("ok", "empty")
        self.failed |= bool(wrong) or lost
        if wrong or lost:
            return f"{status} {', '.join(reasons)}, {wrong} of {targets} targets wrong"
        return None


def judge(case: Case, config: Config) -> Json | None:
    """The record of the last frame; None where the run is refused before the first."""
    try:
        chain = Chain(case.calibration, case.site, config)
    except StereoOreError:
        return None
    watch = Watch(config, case.site)
    record: Json | None = None
    for index, pair in enumerate(case.frames):
        lines = frame_lines(chain(replace(pair, index=index)), case.site, [])
        record = json.loads(watch.judge(lines).record)
    return record


def plant_fault(
    planted: Planted, config: Config, only: str = "", seed: int = 0
) -> Iterator[tuple[str, Json | None]]:
    """Each fault whose name `only` is found in, with the record that comes of it in a scene."""
    for name, case in _cases(planted, seed):
        if re.search(only, name):
            yield name, judge(case(), config)


def _cases(planted: Planted, seed: int) -> Iterator[tuple[str, Callable[[], Case]]]:
    sound = planted.case
    noisy = replace(sound, frames=(exposed(sound.frames[-1], seed),)) if seed else sound
    yield SOUND, lambda: noisy
    raw = sound.calibration.images == "raw"
    setup = fault_setup.RAW_FAULTS if raw else fault_setup.FAULTS | fault_setup.SMALL_FAULTS
    for name, fault in setup.items():
        yield name, partial(fault, noisy)
    for name, edit in {} if raw else fault_images.EDITS.items():
        yield name, partial(fault_images.plant_in_images, edit, planted, seed)


def faults_markdown(rows: Sequence[FaultRow]) -> str:
    """A line a fault."""
    statuses = ("ok", "degraded", "empty", "failed", "refused")
    heads = (
        "fault",
        "frames",
        *statuses,
        "frames with targets",
        "targets",
        "wrong",
        "wrong_ok_frames",
        "told by",
    )
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for row in rows:
        told = ", ".join(f"{code} {times}" for code, times in row.codes.most_common())
        counts = (row.with_targets, row.targets, row.wrong, row.wrong_ok_frames)
        cells = (
            row.fault,
            row.frames,
            *(row.statuses[name] or "" for name in statuses),
            *counts,
            told,
        )
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines) + "\n"
