"""The folder of a run: records in order, timings, inputs, and what is needed to repeat it.

While a run lasts its lines grow in ``*.part`` files; at the end they get their final names. So a
reader never takes an unfinished run for a finished one, and a killed run is continued from its last
whole line.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, Any

from stereo_ore.errors import OutputError
from stereo_ore.io.atomic import (
    guarded,
    make_folder,
    remove_leftovers,
    write_bytes,
    write_lines,
    write_text,
)
from stereo_ore.io.ore_table import ores_csv

LINES = ("frames.jsonl", "timings.jsonl", "inputs.jsonl")
FRAME_FOLDERS = ("clouds", "arm_clouds", "overlays", "stages", "pictures")
FRAME_SUFFIXES = (".ply", ".png", ".npz")
WRITTEN = (*LINES, *(f"{name}.part" for name in LINES), *FRAME_FOLDERS, "run.json")
"""What a run makes in its folder and writes into or removes from."""


@dataclass(frozen=True)
class FrameLines:
    """What one frame adds to the run's files: JSON objects a line each."""

    record: str
    timing: str
    inputs: str


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
    """

    def __init__(
        self, folder: Path, description: Mapping[str, Any], *, resume: bool, overwrite: bool
    ) -> None:
        self.folder = folder
        self.description = dict(description, digest=digest(description))
        self._check_links()
        earlier = self._check_earlier(resume, overwrite)
        make_folder(folder)
        if earlier and not resume:
            self._remove_results()
        self.done = self._trim() if resume else 0
        write_text(
            folder / "run.json", json.dumps(self.description, indent=1, ensure_ascii=False) + "\n"
        )
        self._files: dict[str, IO[str]] = {}

    def __enter__(self) -> RunFolder:
        def open_all() -> None:
            for name in LINES:
                self._files[name] = self._part(name).open(
                    "a", encoding="utf-8", errors="backslashreplace", newline="\n"
                )

        guarded(self.folder, open_all)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for file in self._files.values():
            file.close()

    def earlier(self) -> Iterator[FrameLines]:
        """The lines of the frames that are done already."""
        files = [iter(_whole_lines(self._part(name))) for name in LINES]
        return (
            FrameLines(*(line.decode("utf-8", "replace") for line in lines))
            for lines in zip(*files, strict=True)
        )

    def add(self, lines: FrameLines) -> None:
        """Append one frame, flushed so that a kill loses no more than the frame in work."""
        for name, line in zip(LINES, (lines.record, lines.timing, lines.inputs), strict=True):
            file = self._files[name]

            def write(file: IO[str] = file, line: str = line) -> None:
                file.write(line + "\n")
                file.flush()

            guarded(self._part(name), write)

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

    def _check_links(self) -> None:
        """Refuse a link in the place of what is written: what it points to belongs to somebody
        else.
        """
        for name in WRITTEN:
            if (self.folder / name).is_symlink():
                remedy = "Remove it, or name another --out; --out itself may be a link"
                raise OutputError("is a link, and links in a folder of results aren't followed",
                                  file=self.folder / name, remedy=remedy)  # fmt: skip

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
        texts = {name: _whole_lines(self._part(name)) for name in LINES}
        count = min(len(lines) for lines in texts.values())
        for name, lines in texts.items():
            if self._part(name).exists():
                write_bytes(self._part(name), b"".join(lines[:count]))
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


def _whole_lines(path: Path) -> list[bytes]:
    """Lines that end; in bytes, for text knows more ends of a line than JSON lines have."""
    data = path.read_bytes() if path.exists() else b""
    return data[: data.rfind(b"\n") + 1].splitlines(keepends=True)


def digest(description: Mapping[str, Any]) -> str:
    """SHA-256 of a JSON-able description."""
    return hashlib.sha256(json.dumps(description, sort_keys=True).encode()).hexdigest()
