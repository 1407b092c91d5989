"""The files of live frames: none that the disk has no room for, and no end when one can't be
written.
"""

from __future__ import annotations

import logging
import shutil
from dataclasses import dataclass, field
from pathlib import Path

from stereo_ore.errors import OutputError
from stereo_ore.runs.frame_files import FrameFiles
from stereo_ore.types import FrameResult

_log = logging.getLogger(__name__)

NO_DISK_BYTES = 2 * 10**8
"""Below this much room only records are written: a day of them."""


def free_bytes(folder: Path) -> int:
    """Room on the disk of a folder; 0 when the folder is gone."""
    try:
        return shutil.disk_usage(folder).free
    except OSError:
        return 0


@dataclass
class Room:
    """Whether files of frames are written; changes with each frame."""

    left_out: int = 0
    fault: str = ""


@dataclass(frozen=True)
class LiveFiles(FrameFiles):
    """Files of live frames; `room` tells how that goes."""

    room: Room = field(default_factory=Room)

    def write(self, result: FrameResult) -> None:
        """Write what is wanted where there is room for it."""
        fault = ""
        if self.clouds or self.overlays or self.pictures:
            free = free_bytes(self.folder)
            if free < NO_DISK_BYTES:
                fault = f"{self.folder}: {free // 10**6} MB left on the disk"
            else:
                try:
                    super().write(result)
                except OutputError as refused:
                    fault = str(refused)
        self.note(fault)

    def note(self, fault: str) -> None:
        """Remember what kept the files of a frame from being written; empty: nothing."""
        if fault and not self.room.fault:
            _log.error("%s; clouds and pictures are left out", fault)
        self.room.left_out += bool(fault)
        self.room.fault = fault
