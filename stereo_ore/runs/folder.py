"""The folder of a run: records in order, timings, inputs, and what is needed to repeat it.

While a run lasts its lines grow in ``*.part`` files; at the end they get their final names. So a
reader never takes an unfinished run for a finished one, and a killed run is continued from its last
whole line.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

from stereo_ore.draw.overlay import Outlines
from stereo_ore.errors import OutputError
from stereo_ore.io.atomic import (
    guarded,
    make_folder,
    remove_leftovers,
    write_bytes_where_new,
    write_lines,
    write_text,
)
from stereo_ore.io.lock import FolderLock
from stereo_ore.io.ore_table import ores_csv
from stereo_ore.io.segments import FOLDER
from stereo_ore.record import to_line

LINES = ("frames.jsonl", "timings.jsonl", "inputs.jsonl")
FRAME_FOLDERS = ("clouds", "arm_clouds", "overlays", "stages", "pictures")
FRAME_SUFFIXES = (".ply", ".png", ".npz")
WRITTEN = (*LINES, *(f"{name}.part" for name in LINES), *FRAME_FOLDERS, "run.json", FOLDER)
"""What a run makes in its folder and writes into or removes from."""


@dataclass(frozen=True)
class FrameLines:
    """What one frame adds to the run's files: JSON objects a line each; and where its lumps are to
    be drawn, None for a frame without an image.
    """

    record: str
    timing: str
    inputs: str
    outlines: Outlines | None = None

    def thinned(self) -> FrameLines:
        """The same without ores, and a reason that says so."""
        record = json.loads(self.record)
        reason = {"code": "THINNED", "detail": "the disk was full: the record is without its ores"}
        less = {"ores": [], "targets": [], "reasons": [*record["reasons"], reason]}
        return replace(self, record=to_line(record | less))


class RunFolder:
    """Open folder of a run; a context manager that keeps `LINES` in step.

    Parameters
    ----------
    folder : Path
        Made when it does not exist.
    description : mapping
        What the run is made from (versions, configuration, names of frames …): written to
        ``run.json``; its digest tells whether a folder holds the same run.
    resume : bool
        Continue after the last whole frame of an unfinished run.
    overwrite : bool
        Replace a different run.
    lock : bool
        Keep other processes out; False where the caller does so.
    """

    def __init__(
        self,
        folder: Path,
        description: Mapping[str, Any],
        *,
        resume: bool,
        overwrite: bool,
        lock: bool = True,
    ) -> None:
        self.folder = folder
        self.description = dict(description, digest=digest(description))
        check_links(folder)
        earlier = self._check_earlier(resume, overwrite)
        make_folder(folder)
        self._lock = FolderLock(folder) if lock else None
        if earlier and not resume:
            self._remove_results()
        self.done = self._trim() if resume else 0
        text = json.dumps(self.description, indent=1, ensure_ascii=False) + "\n"
        # On a full disk a run goes on only where nothing is written that is there already.
        write_bytes_where_new(folder / "run.json", text.encode(errors="backslashreplace"))
        self._files: dict[str, BinaryIO] = {}

    def __enter__(self) -> RunFolder:
        def open_all() -> None:
            for name in LINES:
                self._files[name] = self._part(name).open("ab", buffering=0)

        guarded(self.folder, open_all)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the line files, and let go of the folder."""
        for file in self._files.values():
            file.close()
        if self._lock:
            self._lock.close()

    def earlier(self) -> Iterator[FrameLines]:
        """The lines of the frames that are done already."""
        files = [whole_lines(self._part(name)) for name in LINES]
        return (
            FrameLines(*(line.decode("utf-8", "replace") for line in lines))
            for lines in zip(*files, strict=True)
        )

    def add(self, lines: FrameLines) -> None:
        """Append one frame, at once, so that a kill loses no more than the frame in work.

        Raises
        ------
        OutputError
            When it can't be written; the files are then as they were before.
        """
        sizes = {name: os.fstat(file.fileno()).st_size for name, file in self._files.items()}
        try:
            for name, line in zip(LINES, (lines.record, lines.timing, lines.inputs), strict=True):
                guarded(self._part(name), lambda name=name, line=line: self._append(name, line))  # type: ignore[misc]
        except OutputError:
            for name, size in sizes.items():
                self._files[name].truncate(size)
            raise

    def _append(self, name: str, line: str) -> None:
        left = memoryview(line.encode("utf-8", "backslashreplace") + b"\n")
        while left:
            left = left[self._files[name].write(left) :]

    @property
    def is_there(self) -> bool:
        """Whether lines that are added are found under the names of their files."""
        try:
            return all(
                os.path.samestat(os.fstat(file.fileno()), os.stat(self._part(name)))
                for name, file in self._files.items()
            )
        except (OSError, ValueError):
            return False

    def finish(self) -> None:
        """Give the line files their final names, and write what is made from all of them."""
        for file in self._files.values():
            file.close()
        frames = self._part("frames.jsonl")
        write_lines(self.folder / "ores.csv", ores_csv(frames))
        inputs = [
            json.loads(line)
            for line in self._part("inputs.jsonl").read_text(encoding="utf-8").splitlines()
        ]
        finished = {**self.description, "inputs": inputs, "finished": True}
        for name in ("timings.jsonl", "frames.jsonl"):
            part, final = self._part(name), self.folder / name
            guarded(final, lambda part=part, final=final: part.replace(final))  # type: ignore[misc]
        write_text(
            self.folder / "run.json", json.dumps(finished, indent=1, ensure_ascii=False) + "\n"
        )
        self._part("inputs.jsonl").unlink()
        for child in ("", *FRAME_FOLDERS):
            remove_leftovers(self.folder / child)

    def _part(self, name: str) -> Path:
        return self.folder / f"{name}.part"

    def _check_earlier(self, resume: bool, overwrite: bool) -> bool:
        """Whether the folder holds a run that this one may continue or replace."""
        earlier = self.folder / "run.json"
        if not earlier.is_file():
            return False
        try:
            same = (
                json.loads(earlier.read_text(encoding="utf-8")).get("digest")
                == self.description["digest"]
            )
        except (ValueError, AttributeError):
            same = False
        if not same and (resume or not overwrite):
            problem = "holds a run with other inputs, parameters or version"
            remedy = "Name another --out, or give --overwrite to replace it"
            raise OutputError(problem, file=self.folder, remedy=remedy)
        if not resume and not overwrite:
            problem = "holds this run already, or a part of it"
            remedy = "Give --resume to go on with it, or --overwrite to begin anew"
            raise OutputError(problem, file=self.folder, remedy=remedy)
        return True

    def _trim(self) -> int:
        """Cut every line file back to the frames that all of them hold whole; their number."""
        self._reopen()
        parts = [self._part(name) for name in LINES]
        count = min(sum(1 for _ in whole_lines(part)) for part in parts)
        for part in parts:
            size = sum(len(line) for line in islice(whole_lines(part), count))
            if part.exists() and part.stat().st_size > size:
                guarded(part, lambda part=part, size=size: os.truncate(part, size))  # type: ignore[misc]
        return count

    def _reopen(self) -> None:
        """Lines that have their final names already, of a run that has ended or was killed while
        ending, grow again.
        """
        for name in ("timings.jsonl", "frames.jsonl"):
            part, final = self._part(name), self.folder / name
            if final.is_file() and not part.exists():
                guarded(final, lambda part=part, final=final: final.replace(part))  # type: ignore[misc]
        if not self._part("inputs.jsonl").exists() and (self.folder / "run.json").is_file():
            run = json.loads((self.folder / "run.json").read_text(encoding="utf-8"))
            write_text(
                self._part("inputs.jsonl"),
                "".join(json.dumps(entry) + "\n" for entry in run.get("inputs", [])),
            )

    def _remove_results(self) -> None:
        derived = ("ores.csv", "report.html", "calibration_check.json")
        for name in (*LINES, *(f"{name}.part" for name in LINES), *derived):
            (self.folder / name).unlink(missing_ok=True)
        for child in FRAME_FOLDERS:
            for file in (self.folder / child).glob("*"):
                if file.suffix in FRAME_SUFFIXES and file.is_file():
                    file.unlink()


def check_links(folder: Path) -> None:
    """Refuse a link in the place of what is written: what it points to belongs to somebody else.

    Raises
    ------
    OutputError
        Where there is one.
    """
    for name in WRITTEN:
        if (folder / name).is_symlink():
            remedy = "Remove it, or name another --out; --out itself may be a link"
            raise OutputError("is a link, and links in a folder of results aren't followed",
                              file=folder / name, remedy=remedy)  # fmt: skip


def whole_lines(path: Path) -> Iterator[bytes]:
    """Lines that end; in bytes, for text knows more ends of a line than JSON lines have."""
    if path.exists():
        with path.open("rb") as lines:
            yield from (line for line in lines if line.endswith(b"\n"))


def digest(description: Mapping[str, Any]) -> str:
    """SHA-256 of a JSON-able description."""
    return hashlib.sha256(json.dumps(description, sort_keys=True).encode()).hexdigest()
