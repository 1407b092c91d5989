"""One live frame through the chain: its record, timing and inputs as lines, its pictures and cloud as files."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, replace

from stereo_ore import pipeline
from stereo_ore.batch import sha256
from stereo_ore.errors import FrameError
from stereo_ore.record import record, to_line
from stereo_ore.serve.frames import LiveFrame
from stereo_ore.sinks.frame_files import FrameFiles
from stereo_ore.sinks.run_folder import FrameLines
from stereo_ore.types import FrameResult, Reason


@dataclass(frozen=True)
class Processor:
    """Does for a live frame what `batch.Job` does for a recorded one."""

    context: pipeline.Context
    files: FrameFiles

    def __call__(self, frame: LiveFrame) -> FrameLines:
        """Process a frame and write its files; what can't be read is a failed frame."""
        result = self._result(frame)
        self.files.write(result)
        stages = {name: round(ms, 3) for name, ms in result.stages_ms.items()}
        timing = {"frame": frame.name, "stages_ms": stages, "total_ms": round(sum(stages.values()), 3)}
        inputs = {"frame": frame.name, "files": {str(path): sha256(path) for path in frame.files}}
        line = to_line(record(result, self.context.site))
        return FrameLines(line, json.dumps(timing), json.dumps(inputs))

    def _result(self, frame: LiveFrame) -> FrameResult:
        start = time.perf_counter()
        try:
            pair = frame.read()
        except FrameError as error:
            reasons = (Reason(error.code, str(error)),)
            return FrameResult(frame.name, frame.index, None, "failed", reasons, dict.fromkeys(pipeline.COUNTS, 0))
        read_ms = 1000 * (time.perf_counter() - start)
        result = pipeline.process(pair, self.context)
        return replace(result, stages_ms={"read": read_ms, **result.stages_ms})
