"""The folder of a run that goes on for a year: a part a day, and no fault of the disk is the end.

The part that grows is a run's folder (`RunFolder`). With a new day, after many frames, with other
parameters or another version it is closed: its files move below ``segments``, and the next begins.
What can't be written waits in memory.
"""

from __future__ import annotations

import json
import logging
import math
import os
import shutil
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from stereo_ore.errors import OutputError
from stereo_ore.io import segments
from stereo_ore.io.atomic import guarded, make_folder
from stereo_ore.io.lock import FolderLock
from stereo_ore.io.results import parse_record
from stereo_ore.plant.clock import SYSTEM, Clock
from stereo_ore.plant.frames import LiveFrame, Position
from stereo_ore.runs.folder import (
    LINES,
    FrameLines,
    RunFolder,
    check_links,
    digest,
    whole_lines,
)

_log = logging.getLogger(__name__)

MOST_FRAMES = 100_000
"""Frames of a part: a bound on what a restart reads and on the names that are remembered."""
MOST_WAITING_BYTES, MOST_WAITING = 64_000_000, 100_000
"""Records that wait for room on the disk: above so many bytes without their ores, above so many
frames no longer at all."""
_ADDED = ("digest", "inputs", "finished")
"""Keys of ``run.json`` that are not of the description."""
COPIED = ("config.yaml", "calibration.yaml", "site.yaml", "run.json")
"""Files that tell how a part was made."""


class LiveFolder:
    """Open folder of a live run; a context manager.

    Parameters
    ----------
    folder : Path
        Made when it does not exist.
    description : mapping
        What the run is made from. Another ``source`` than that of the run in the folder is refused;
        any other difference begins a new part.
    write_inputs : callable
        Writes what is needed to repeat the run beside its results.
    overwrite : bool
        Replace whatever run is there.

    Raises
    ------
    OutputError
        When the folder can't be made, is another run's, or is in use.
    """

    def __init__(
        self,
        folder: Path,
        description: Mapping[str, Any],
        write_inputs: Callable[[], None] = lambda: None,
        *,
        overwrite: bool = False,
        clock: Clock = SYSTEM,
    ) -> None:
        self.folder = folder
        self.lost_records = 0
        self._description, self._write_inputs, self._clock = description, write_inputs, clock
        self._waiting: deque[FrameLines] = deque()
        self._waiting_bytes = 0
        self._names: set[str] = set()
        self._part: RunFolder | None = None
        self._day, self._count, self._fault, self.gone = "", 0, "", False
        make_folder(folder)
        self._lock = FolderLock(folder)
        check_links(folder)
        if overwrite:
            self._remove_earlier()
        self._check_source()
        try:
            self._open()
        except OutputError as fault:
            self._tell(fault)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._leave()
        self._lock.close()

    # --- what a start needs to know

    def position(self) -> Position:
        """Where the run stands."""
        for file in reversed(segments.line_files(self.folder, "frames")):
            if last := deque(enumerate(whole_lines(file), 1), maxlen=1):
                number, line = last[0]
                record = parse_record(line.decode("utf-8", "replace"), file, number)
                return Position(record["index"] + 1, self._handled)
        return Position(0, self._handled)

    def recent(self, count: int) -> list[FrameLines]:
        """The lines of the last frames of the part that grows, at most `count`."""
        return list(deque(self._part.earlier(), maxlen=count)) if self._part else []

    def _handled(self, since_ns: int) -> Iterator[tuple[str, float]]:
        for file in reversed(segments.line_files(self.folder, "inputs")):
            if file.stat().st_mtime_ns < since_ns:
                return
            for line in whole_lines(file):
                entry = json.loads(line)
                for path in entry.get("files", ()):
                    yield path, entry.get("written_ns", math.inf)

    # --- frames

    def named(self, frame: LiveFrame) -> LiveFrame:
        """The frame under a name of its own: one that is used again gets its index behind it."""
        files = (self.folder / "overlays" / f"{frame.name}.png",
                 self.folder / "clouds" / f"{frame.name}.ply")  # fmt: skip
        taken = frame.name in self._names or any(map(os.path.lexists, files))
        return replace(frame, name=f"{frame.name}_{frame.index}") if taken else frame

    def add(self, name: str, lines: FrameLines) -> None:
        """Append the lines of the frame `name`; what can't be written now is kept for later."""
        self._names.add(name)
        self._keep(lines)
        try:
            self._find_again()
            if self._today() != self._day or self._count >= MOST_FRAMES:
                self._leave()
                self._open()
            self._write_waiting()
        except OutputError as fault:
            self._tell(fault)
        else:
            if self._fault:
                _log.warning("%s: records are written again", self.folder)
            self._fault = ""

    @property
    def waiting(self) -> int:
        """Records that wait in memory."""
        return len(self._waiting)

    @property
    def alarm(self) -> str:
        """What is wrong; empty while records are written."""
        lost = f", {self.lost_records} are lost" if self.lost_records else ""
        kept = f"{self.waiting} records wait in memory{lost}"
        if self.gone:
            return f"{self.folder} is gone: no targets, {kept}"
        return f"{self._fault}; {kept}" if self._fault else ""

    def finish(self) -> None:
        """Write what waits, and give the line files their final names.

        Raises
        ------
        OutputError
            When that can't be written.
        """
        self._find_again()
        self._write_waiting()
        if self._part:
            self._part.finish()

    # --- parts

    def _open(self) -> None:
        """Go on with the part that is there where it is of today and made in the same way; else
        close it and begin one.
        """
        self._close_other()
        part = RunFolder(self.folder, self._about(), resume=True, overwrite=False, lock=False)
        try:
            part.__enter__()
            self._write_inputs()
            self._names = {json.loads(lines.timing)["frame"] for lines in part.earlier()}
        except BaseException:
            part.close()
            raise
        self._part, self._day, self._count = part, self._today(), part.done

    def _leave(self) -> None:
        if self._part:
            self._part.close()
        self._part = None

    def _find_again(self) -> None:
        """Notice that the folder is not where it was, and go on in it once it is there again."""
        if self._part and self._part.is_there:
            return
        self._leave()
        if not self.folder.is_dir():
            self.gone = True
            raise OutputError("is gone", file=self.folder, remedy="Bring the folder back")
        self._lock.close()
        self._lock = FolderLock(self.folder)
        self._open()
        self.gone = False

    def _about(self) -> dict[str, Any]:
        return {**self._description, "day": self._today(), "segment": self._next_number()}

    def _check_source(self) -> None:
        earlier = described(self.folder)
        if earlier and earlier.get("source") != self._description.get("source"):
            problem = f"holds a run of {earlier.get('source')!r}"
            remedy = "Name another --out, or give --overwrite to replace it"
            raise OutputError(problem, file=self.folder, remedy=remedy)

    def _close_other(self) -> None:
        """Close a part that this run can't go on with: of another day, parameters or version, or
        with as many frames as a part has.
        """
        for hidden in (part for part in segments.closed(self.folder) if part.name[0] == "."):
            self._move(hidden)
        earlier = described(self.folder)
        if not earlier or (
            earlier.get("digest") == digest(self._about()) and self._count < MOST_FRAMES
        ):
            return
        # Opened once more as what it is, so that a part that was torn is made whole.
        known = {key: value for key, value in earlier.items() if key not in _ADDED}
        with RunFolder(self.folder, known, resume=True, overwrite=False, lock=False) as part:
            done = part.done
        self._count = 0
        if done:
            name = segments.name(self._next_number(), earlier.get("day") or self._today())
            self._move(self.folder / segments.FOLDER / f".{name}")
        else:
            (self.folder / "run.json").unlink()

    def _move(self, place: Path) -> None:
        """Move the lines of a part, or what is left of them, and show it under its name."""
        make_folder(place)
        for name in COPIED:
            file = self.folder / name
            if file.is_file() and not (place / name).exists():
                guarded(place, lambda file=file, name=name: shutil.copyfile(file, place / name))  # type: ignore[misc]
        for name in LINES:
            for file in (self.folder / name, self.folder / f"{name}.part"):
                if file.is_file() and not (place / name).exists():
                    guarded(place, lambda file=file, name=name: file.replace(place / name))  # type: ignore[misc]
        for made in ("ores.csv", "run.json"):
            (self.folder / made).unlink(missing_ok=True)
        guarded(place, lambda: place.replace(place.with_name(place.name[1:])))

    def _next_number(self) -> int:
        earlier = described(self.folder)
        if "segment" in earlier:
            return int(earlier["segment"])
        closed = segments.closed(self.folder)
        return segments.segment_number(closed[-1]) + 1 if closed else 0

    def _remove_earlier(self) -> None:
        for part in segments.closed(self.folder):
            shutil.rmtree(part)
        about = {**self._description, "overwrite": True}
        with RunFolder(self.folder, about, resume=False, overwrite=True, lock=False):
            (self.folder / "run.json").unlink()

    def _today(self) -> str:
        return f"{datetime.fromtimestamp(self._clock.time_ns() / 1e9, UTC):%Y-%m-%d}"

    # --- what waits

    def _keep(self, lines: FrameLines) -> None:
        if len(self._waiting) >= MOST_WAITING:
            self.lost_records += 1
            return
        kept = lines if self._waiting_bytes < MOST_WAITING_BYTES else lines.thinned()
        self._waiting.append(kept)
        self._waiting_bytes += _size(kept)

    def _write_waiting(self) -> None:
        assert self._part is not None, "found again before"
        while self._waiting:
            self._part.add(self._waiting[0])
            self._count += 1
            self._waiting_bytes -= _size(self._waiting.popleft())

    def _tell(self, fault: OutputError) -> None:
        if not self._fault:
            _log.error("%s; records wait in memory", fault)
        self._fault = str(fault)


def described(folder: Path) -> dict[str, Any]:
    """What ``run.json`` says of the part that grows; empty without one."""
    try:
        found = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _size(lines: FrameLines) -> int:
    return len(lines.record) + len(lines.timing) + len(lines.inputs)
