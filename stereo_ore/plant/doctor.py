"""Is this machine ready to serve? One check a thing that is known to go wrong; none changes
anything.
"""

from __future__ import annotations

import ctypes
import os
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import version
from importlib.resources import as_file, files
from pathlib import Path
from typing import Literal

import numpy as np

from stereo_ore.chain import Chain
from stereo_ore.config import Config
from stereo_ore.errors import ConfigError, OutputError, StereoOreError
from stereo_ore.installation import conflict_text, conflicting_wheels
from stereo_ore.io.calibration import load
from stereo_ore.io.lock import FolderLock
from stereo_ore.io.parameters import load_config
from stereo_ore.io.recordings import open_source
from stereo_ore.io.site import load_site
from stereo_ore.plant.listening import listen
from stereo_ore.plant.live_files import NO_DISK_BYTES, free_bytes
from stereo_ore.plant.posture import live_postures, written_by_opcua
from stereo_ore.plant.sinks.settings import LOOPBACK, addresses, load_sinks, open_sinks
from stereo_ore.plant.watch import first_size
from stereo_ore.types import Site

_Verdict = Literal["ok", "warning", "fault"]

_LITTLE_DISK_BYTES = 5 * 10**9
EARLIEST_S = 1_767_225_600
"""1 January 2026: a clock that says less has never been set."""
TIME_ERROR = 5
"""What adjtimex(2) returns while the kernel's clock is not synchronised."""
NEEDED = ("numpy", "scipy", "sklearn", "cv2", "cv2.ximgproc", "open3d", "yaml", "pydantic")


@dataclass(frozen=True)
class _Finding:
    """What one check has found."""

    check: str
    verdict: _Verdict
    text: str


@dataclass(frozen=True)
class Plan:
    """What `serve` is to be given; what is None is not checked."""

    calib: Path | None = None
    site: Path | None = None
    config: Path | None = None
    watch: Path | None = None
    out: Path | None = None
    sinks: Path | None = None
    ports: tuple[tuple[str, int], ...] = ()
    page: int | None = None


def examine(plan: Plan) -> Iterator[_Finding]:
    """All findings, each as soon as it is known."""
    for name, check in CHECKS.items():
        try:
            found = list(check(plan))
        except StereoOreError as fault:
            found = [_Finding(name, "fault", str(fault))]
        except Exception as fault:
            found = [_Finding(name, "fault", f"{type(fault).__name__}: {fault}")]
        yield from (_Finding(name, each.verdict, each.text) for each in found)


def _ok(text: str) -> _Finding:
    return _Finding("", "ok", text)


def _warning(text: str) -> _Finding:
    return _Finding("", "warning", text)


def _fault(text: str) -> _Finding:
    return _Finding("", "fault", text)


def _installation(plan: Plan) -> Iterator[_Finding]:
    """Packages that can be imported, and one OpenCV."""
    if found := conflicting_wheels():
        yield _fault(conflict_text(found))
    missing = []
    for name in NEEDED:
        try:
            __import__(name)
        except (ImportError, AttributeError, OSError) as fault:
            missing.append(f"{name}: {fault}")
    for text in missing:
        yield _fault(f"{text}. Install again: pip install --force-reinstall stereo-ore")
    if not missing:
        yield _ok(f"Python {sys.version.split()[0]}, stereo-ore {version('stereo-ore')}")


def _clock(plan: Plan) -> Iterator[_Finding]:
    """A clock that has been set, and is kept by somebody."""
    if time.time() < EARLIEST_S:
        yield _fault(f"says {time.strftime('%Y-%m-%d')}: set it, and let NTP keep it")
    elif _synchronised() is False:
        yield _warning("is not synchronised: targets hold by the clocks of both sides; start NTP")
    else:
        yield _ok(time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime()))


def _synchronised() -> bool | None:
    """Whether the kernel says that somebody keeps its clock; None where it can't be asked."""
    try:
        state = ctypes.CDLL(None).adjtimex(ctypes.byref(ctypes.create_string_buffer(512)))
    except (OSError, AttributeError, TypeError):
        return None
    return None if state < 0 else state != TIME_ERROR


def _results(plan: Plan) -> Iterator[_Finding]:
    """Room, permission and nobody else in the folder of results."""
    if plan.out is None:
        return
    place = next(p for p in (plan.out, *plan.out.absolute().parents) if p.exists())
    if not place.is_dir() or not os.access(place, os.W_OK | os.X_OK):
        yield _fault(f"{place}: nothing can be written there. Check path and permissions")
        return
    if place == plan.out:
        FolderLock(place).close()
    free = free_bytes(place)
    text = f"{plan.out}: {free / 1e9:.1f} GB free"
    if free < NO_DISK_BYTES:
        yield _fault(f"{text}: no clouds and pictures would be written. Make room")
    elif free < _LITTLE_DISK_BYTES:
        yield _warning(f"{text}: see serve --keep")
    else:
        yield _ok(text)


def _inbox(plan: Plan) -> Iterator[_Finding]:
    """A folder that can be read, and nobody else serves."""
    if plan.watch is None:
        return
    if not plan.watch.is_dir():
        yield _fault(f"{plan.watch}: no such folder. Make the one that frames are copied to")
        return
    names = os.listdir(plan.watch)
    FolderLock(plan.watch).close()
    yield _ok(f"{plan.watch}: {len(names)} entries")


def _calibration(plan: Plan) -> Iterator[_Finding]:
    """A calibration for images of the inbox's size."""
    if plan.calib is None:
        return
    seen = first_size(plan.watch) if plan.watch and plan.watch.is_dir() else None
    calibration = load(plan.calib, recorded_size=seen)
    size = "{} × {} px".format(*calibration.image_size)
    if seen and seen not in (calibration.image_size, _side_by_side(calibration.image_size)):
        yield _fault(
            f"{plan.calib} is for {size}, the inbox holds images of {seen[0]} × {seen[1]} px."
            " Give the calibration of that size"
        )
    else:
        baseline_mm = 1000 * float(np.linalg.norm(calibration.t_right_left))
        yield _ok(f"{plan.calib}: {size}, baseline {baseline_mm:.0f} mm")


def _side_by_side(size: tuple[int, int]) -> tuple[int, int]:
    return 2 * size[0], size[1]


def _site(plan: Plan) -> Iterator[_Finding]:
    """A site with all that targets need."""
    if plan.site is None:
        if plan.calib:
            yield _warning("no --site: no target is ever valid")
        return
    site = load_site(plan.site)
    lacks = [
        text
        for text, there in (
            ("arm_from_camera: no target is ever valid", site.T_arm_camera is not None),
            ("working_volume: everything in view may become a target", site.volume is not None),
            ("grizzly.plane: a wrong scale can't be seen", site.plane is not None),
        )
        if not there
    ]
    yield from (_warning(f"{plan.site} has no {text}") for text in lacks)
    if not lacks:
        yield _ok(f"{plan.site}: arm, working volume, plane of the bars")


def _parameters(plan: Plan) -> Iterator[_Finding]:
    """A file of parameters that is one."""
    if plan.config is not None:
        load_config(plan.config)
        yield _ok(str(plan.config))


def _consumers(plan: Plan) -> Iterator[_Finding]:
    """Ports that are free, files that are there, extras that are installed."""
    settings = load_sinks(plan.sinks, **dict(plan.ports))
    site = Site()
    if plan.site is not None:
        with suppress(ConfigError):  # which the check of the site tells
            site = load_site(plan.site)
    open_sinks(settings, postures=written_by_opcua(site, live_postures(site)))
    listening = [
        (name, part.host, part.port)
        for name, part in addresses(settings).items()
        if part.listens and part.port
    ]
    listening += [("page", LOOPBACK, plan.page)] if plan.page else []
    for name, host, port in listening:
        try:
            listen(host, port, name).close()
        except OutputError as fault:
            yield _fault(f"{name}: {fault.problem}. {fault.remedy}")
        else:
            yield _ok(f"{name}: {host}:{port} is free")
    if settings.mqtt:
        yield from _broker(settings.mqtt.host, settings.mqtt.port)


def _broker(host: str, port: int) -> Iterator[_Finding]:
    try:
        socket.create_connection((host, port), timeout=5).close()
    except OSError as fault:
        yield _warning(f"mqtt: no broker at {host}:{port}: {fault.strerror or fault}")
    else:
        yield _ok(f"mqtt: {host}:{port} answers")


def _frame(plan: Plan) -> Iterator[_Finding]:
    """The frame in the package, from pair to targets."""
    with as_file(files("stereo_ore") / "example") as folder:
        chain = Chain(load(folder / "calibration.yaml"), load_site(folder / "site.yaml"), Config())
        start = time.perf_counter()
        result = chain(open_source(folder).read(0))
        taken_ms = 1000 * (time.perf_counter() - start)
    text = f"{result.status}, {len(result.targets)} targets, {taken_ms:.0f} ms"
    if result.status != "ok" or not result.targets:
        codes = ", ".join(reason.code for reason in result.reasons)
        yield _fault(f"{text} ({codes}). Install again, with the versions of requirements.lock")
    else:
        yield _ok(text)


def _temporary(plan: Plan) -> Iterator[_Finding]:
    """A place for temporary files, which encoders of videos and bags need."""
    with tempfile.TemporaryFile() as file:
        file.write(b"x")
    yield _ok(tempfile.gettempdir())


CHECKS: dict[str, Callable[[Plan], Iterator[_Finding]]] = {
    "installation": _installation,
    "clock": _clock,
    "temporary files": _temporary,
    "results": _results,
    "inbox": _inbox,
    "calibration": _calibration,
    "site": _site,
    "parameters": _parameters,
    "consumers": _consumers,
    "built-in frame": _frame,
}
"""In this order."""
