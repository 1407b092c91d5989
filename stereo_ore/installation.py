"""What can be told of a broken installation without importing any of it."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, distribution

OPENCV_WHEELS = (
    "opencv-python",
    "opencv-python-headless",
    "opencv-contrib-python",
    "opencv-contrib-python-headless",
)
"""Distributions that all bring `cv2`: the one installed last overwrites the others' files."""
WANTED_WHEEL = OPENCV_WHEELS[-1]


def conflicting_wheels() -> list[str]:
    """The OpenCV distributions that are installed, where there are several."""
    found = []
    for name in OPENCV_WHEELS:
        try:
            distribution(name)
        except PackageNotFoundError:
            continue
        found.append(name)
    return found if len(found) > 1 else []


def conflict_text(found: Sequence[str]) -> str:
    """What to do about several OpenCV distributions."""
    return (
        f"{' and '.join(found)} overwrite each other: pip uninstall -y {' '.join(found)}"
        f" && pip install {WANTED_WHEEL}"
    )
