"""Which ROS 2 there is, and one line for whoever has none.

Wheels from the registry (the extra ``ros2``) bring compiled libraries in ``PREFIX/lib`` and a
bootstrapper that starts every Python of their environment anew with these on ``LD_LIBRARY_PATH``,
in no particular order. So a sourced ROS 2, whose libraries have the same names, may get the
wheels' ones; `cleaned_environment` tells where that is so.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import platform
import sys
from array import array
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from stereo_ore.errors import MissingExtraError, OutputError

EXTRA = "ros2"
BOOTSTRAPPED = "_ROS_WHEELS_BOOTSTRAP_COMPLETE"
"""Set by the wheels' bootstrapper; a Python that inherits it does not look for its libraries."""
RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
WIDER = (RANGE, "ROS_LOCALHOST_ONLY", "ROS_STATIC_PEERS")
"""Variables by which a user says who may be found."""


def require() -> None:
    """Load rclpy and its middleware, and stay on this machine unless the user says otherwise.

    Raises
    ------
    MissingExtraError
        Where there is no rclpy.
    OutputError
        Where there is one that can't be loaded.
    """
    if importlib.util.find_spec("rclpy") is None:
        raise MissingExtraError("rclpy", EXTRA, remedy=_how_to_install())
    if not any(os.environ.get(name) for name in WIDER):
        os.environ[RANGE] = "LOCALHOST"
    try:
        importlib.import_module("rclpy").get_rmw_implementation_identifier()
    except Exception as fault:  # what the loader, pybind and rclpy raise has no common base
        raise OutputError(
            f"ROS 2 can't be loaded on {_here()}: {_first_line(fault)}",
            remedy=_how_to_load(),
        ) from None


def cleaned_environment() -> dict[str, str] | None:
    """The environment in which a sourced ROS 2 gets its own libraries; None where it has them
    already, or where none is sourced.
    """
    sourced = [Path(part) for part in _parts("AMENT_PREFIX_PATH")]
    spec = importlib.util.find_spec("rclpy") if sourced else None
    places = [Path(place) for place in (spec.submodule_search_locations or ())] if spec else []
    if not any(place.is_relative_to(prefix) for place in places for prefix in sourced):
        return None
    paths = _parts("LD_LIBRARY_PATH")
    kept = [path for path in paths if not _is_wheels(path)]
    if kept == paths:
        return None
    return {**os.environ, "LD_LIBRARY_PATH": os.pathsep.join(kept), BOOTSTRAPPED: "1"}


class MessageTypes(Mapping[str, Callable[..., Any]]):
    """Message classes by their full name, such as ``std_msgs/msg/Header``."""

    def __getitem__(self, name: str) -> Callable[..., Any]:
        return _message(name)

    def __iter__(self) -> Iterator[str]:
        return iter(())

    def __len__(self) -> int:
        return 0


@cache
def _message(name: str) -> Callable[..., Any]:
    package, kind, message = name.split("/")
    try:
        found = getattr(importlib.import_module(f"{package}.{kind}"), message)
    except ImportError:
        raise MissingExtraError(package, EXTRA, remedy=_how_to_install()) from None
    assert isinstance(found, type), "a message's name is that of a class"
    return found


def domain() -> str:
    """Where this program looks for others, in words."""
    number = os.environ.get("ROS_DOMAIN_ID") or "0"
    return f"domain {number}, discovery {os.environ.get(RANGE, 'as your ROS 2 says')}"


def octets(data: bytes | memoryview) -> array[int]:
    """What rclpy takes without looking at each octet."""
    taken = array("B")
    taken.frombytes(data)
    return taken


def has_transforms() -> bool:
    """Whether there are messages for transforms: a sourced ROS 2 has them, the wheels have not."""
    return importlib.util.find_spec("tf2_msgs") is not None


def _parts(variable: str) -> list[str]:
    return [part for part in os.environ.get(variable, "").split(os.pathsep) if part]


def _is_wheels(path: str) -> bool:
    """Whether a folder of libraries is what the bootstrapper adds for this environment; OpenCV's
    package adds one, too.
    """
    place, prefix = Path(path).resolve(), Path(sys.prefix).resolve()
    of_package = place.is_relative_to(prefix) and place.name.startswith("ros_")
    return place == prefix / "lib" or of_package


def _supported() -> bool:
    """Whether the registry has wheels for this Python and platform."""
    right_python = (3, 11) <= sys.version_info[:2] <= (3, 13)
    return sys.platform == "linux" and platform.machine() == "x86_64" and right_python


def _here() -> str:
    python = f"Python {sys.version_info.major}.{sys.version_info.minor}"
    return f"{platform.system()} {platform.machine()}, {python}"


def _how_to_install() -> str:
    if _supported():
        return f'pip install "stereo-ore[{EXTRA}]" ({_here()}), or source a ROS 2 for this Python'
    return (
        f"The extra {EXTRA} is for Linux x86_64 and Python 3.11 to 3.13, this is {_here()}:"
        " install ROS 2 and source its setup.bash"
    )


def _how_to_load() -> str:
    if sourced := os.environ.get("AMENT_PREFIX_PATH"):
        return f"The sourced ROS 2 ({sourced}) must be made for this Python"
    found = any(_is_wheels(path) for path in _parts("LD_LIBRARY_PATH"))
    if os.environ.get(BOOTSTRAPPED) and not found:
        return f"Start it from a shell in which {BOOTSTRAPPED} is not set"
    return f'Its middleware is missing or damaged: pip install "stereo-ore[{EXTRA}]"'


def _first_line(fault: Exception) -> str:
    lines = [line.strip() for line in str(fault).splitlines() if line.strip()]
    return lines[0].rstrip(".") if lines else type(fault).__name__
