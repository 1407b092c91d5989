"""One live frame through the chain: its record, timing and inputs as lines, its pictures and cloud as files."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, replace

from stereo_ore import pipeline
from stereo_ore.errors import FrameError
from stereo_ore.plant.frames import LiveFrame
from stereo_ore.runs.batch import frame_lines
from stereo_ore.runs.folder import FrameLines
from stereo_ore.runs.frame_files import FrameFiles
from stereo_ore.runs.history import Watch
from stereo_ore.types import FrameResult, Reason

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Processor:
    """Does for a live frame what `batch.Job` does for a recorded one."""

    context: pipeline.Context
    files: FrameFiles
    watch: Watch

    def __call__(self, frame: LiveFrame) -> FrameLines:
        """Process a frame and write its files; what can't be read is a failed frame."""
        result = self._result(frame)
        lines = frame_lines(result, self.context.site, frame.files)
        self.files.write(result)
        return self.watch.judge(lines)

    def _result(self, frame: LiveFrame) -> FrameResult:
        start = time.perf_counter()
        try:
            pair = frame.read()
            read_ms = 1000 * (time.perf_counter() - start)
            result = pipeline.process(pair, self.context)
        except FrameError as error:
            return _failed(frame, error.code, str(error))
        except Exception as fault:
            # Unattended, a fault of ours must not stop the frames that follow, nor come back at each restart.
            log.exception("frame %s", frame.name)
            return _failed(frame, "INTERNAL_ERROR", f"{type(fault).__name__}: {fault}")
        return replace(result, stages_ms={"read": read_ms, **result.stages_ms})


def _failed(frame: LiveFrame, code: str, detail: str) -> FrameResult:
    counts = dict.fromkeys(pipeline.COUNTS, 0)
    return FrameResult(frame.name, frame.index, None, "failed", (Reason(code, detail),), counts)
