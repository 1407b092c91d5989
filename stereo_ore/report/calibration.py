"""The verdict on the calibration by the first pair of a run: a wrong one spoils everything and
shows nowhere else.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from stereo_ore.calibrate.check import check_pair
from stereo_ore.errors import FrameError
from stereo_ore.io.atomic import write_text
from stereo_ore.io.recordings import Source
from stereo_ore.types import StereoCalibration

CHECK_FILE = "calibration_check.json"


def write_check(
    folder: Path, recording: Source, indices: range, calibration: StereoCalibration
) -> dict[str, Any] | None:
    """Judge the calibration by the first readable frame of its size, and keep the verdict in the
    run's folder.
    """
    for index in indices:
        try:
            pair = recording.read(index)
        except FrameError:
            continue
        if pair.left.shape[1::-1] != calibration.image_size:
            continue
        result = check_pair(pair, calibration)
        rows = result.residual
        text = f"{rows.used} matched features of frame {pair.name}"
        if rows.enough:
            text += (
                f": rows differ by {rows.systematic_px:.2f} px systematically, noise"
                f" {rows.noise_px:.2f} px"
            )
        findings = [
            {"severity": f.severity, "code": f.code, "text": f.text} for f in result.findings
        ]
        check = {"frame": pair.name, "verdict": result.verdict, "text": text, "findings": findings}
        write_text(folder / CHECK_FILE, json.dumps(check, indent=1, ensure_ascii=False) + "\n")
        return check
    return None
