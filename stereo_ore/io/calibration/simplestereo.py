"""simplestereo's JSON: res1, intrinsic1, distCoeffs1 … R, T in the board's unit; X_2 = R·X_1 +
T.
"""

from __future__ import annotations

from pathlib import Path

from stereo_ore.io.calibration import opencv
from stereo_ore.io.calibration.file_storage import parse_storage
from stereo_ore.io.calibration.formats import Hints
from stereo_ore.types import StereoCalibration


def recognises(text: str) -> bool:
    """Whether the text has simplestereo's names."""
    return text.lstrip().startswith("{") and '"intrinsic1"' in text and '"distCoeffs1"' in text


def read(path: Path, text: str, hints: Hints) -> StereoCalibration:
    """The calibration in the file, whose entries are OpenCV's under other names."""
    return opencv.combine_storages(path, parse_storage(path, text), hints)
