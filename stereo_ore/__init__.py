"""Stereo vision for ore on a grizzly screen: recorded pairs in, crusher-arm targets out.

The names in `__all__` are stable; everything else may change.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from stereo_ore.version import __version__

if TYPE_CHECKING:
    from stereo_ore.config import Config
    from stereo_ore.detector import Detector, Recording, filter_cloud, open_recording, run
    from stereo_ore.errors import (
        CalibrationError,
        CloudError,
        ConfigError,
        FrameError,
        OutputError,
        SourceError,
        StereoOreError,
    )
    from stereo_ore.io.results import Results
    from stereo_ore.result import Picture, Result
    from stereo_ore.types import Ore, Site, Solid, StereoCalibration, StereoPair, Strike

__all__ = [
    "CalibrationError",
    "CloudError",
    "Config",
    "ConfigError",
    "Detector",
    "FrameError",
    "Ore",
    "OutputError",
    "Picture",
    "Recording",
    "Result",
    "Results",
    "Site",
    "Solid",
    "SourceError",
    "StereoCalibration",
    "StereoOreError",
    "StereoPair",
    "Strike",
    "__version__",
    "filter_cloud",
    "open_recording",
    "run",
]

_MODULES = {
    "config": ("Config",),
    "detector": ("Detector", "Recording", "filter_cloud", "open_recording", "run"),
    "errors": tuple(name for name in __all__ if name.endswith("Error")),
    "result": ("Picture", "Result"),
    "io.results": ("Results",),
    "types": ("Ore", "Site", "Solid", "StereoCalibration", "StereoPair", "Strike"),
}
_HOME = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Import a name of the library where it is used first: NumPy and OpenCV take their time."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
