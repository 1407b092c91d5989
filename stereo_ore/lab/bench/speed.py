"""`bench speed`: what a frame costs by stage, beside OpenCV's plain SGBM in the same process."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path

import cv2
import numpy as np

from stereo_ore import memory
from stereo_ore.chain import Chain
from stereo_ore.config import Config
from stereo_ore.io import calibration
from stereo_ore.io.recordings import open_source
from stereo_ore.io.site import load_site
from stereo_ore.lab import synth
from stereo_ore.lab.bench.memory import peak_mb, sampled, stage_peaks_mb
from stereo_ore.runs.batch import Job
from stereo_ore.runs.driver import Driver, frame_lines
from stereo_ore.runs.frame_files import FrameFiles
from stereo_ore.types import FrameResult, Site

SEED = 2
"""Of the scene, a screen of real size with distorted eyes: rectifying belongs to a frame."""

PLAIN_FOCAL_PX, _PLAIN_DISPARITIES = 530.0, 128
"""Plain matchers search so many disparities at this focal length, and as near at others."""

PLAIN = {"3WAY": cv2.STEREO_SGBM_MODE_SGBM_3WAY, "SGBM": cv2.STEREO_SGBM_MODE_SGBM}
BEFORE = ("read", "rectify", "match")
"""Stages up to the disparity; all others come after matching."""


@dataclass(frozen=True)
class FrameCost:
    """A frame of one size: medians over interleaved rounds in milliseconds, ratios as medians of
    each round's own.

    `frame_ms` is from reading to the record; `files_ms` cloud and overlay on disk. `plain_ms` is
    ``StereoSGBM.compute`` on grey images, whole, `disparities` wide. `peak_mb` is the process's
    resident set. A frame whose `status` is "degraded" may have ended before its last stages.
    """

    size: str
    site: bool
    disparities: int
    stages_ms: Mapping[str, float]
    frame_ms: float
    after_ms: float
    files_ms: float
    plain_ms: Mapping[str, float]
    frame_ratio: Mapping[str, float]
    after_ratio: Mapping[str, float]
    peak_mb: float | None = None
    stage_peaks_mb: Mapping[str, float] = field(default_factory=dict)
    counts: Mapping[str, int] = field(default_factory=dict)
    status: str = "ok"


def make_scene(folder: Path, size: str) -> Path:
    """A scene folder of this image size; one that is there already is taken."""
    if not (folder / "site.yaml").exists():
        spec = replace(synth.sample_spec(SEED, "large", size), raw=True, supersampling=1)
        synth.write(synth.scene(spec), folder)
    return folder


def measure_speed(size: str, scene: Path, site: bool, rounds: int) -> FrameCost:
    """What a frame costs, in a process of its own: memory that another size has left behind does
    not count.
    """
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(_measure, size, scene, site, rounds).result()


def _measure(size: str, scene: Path, site: bool, rounds: int) -> FrameCost:
    memory.keep_freed()
    place = load_site(scene / "site.yaml") if site else Site()
    chain = Chain(calibration.load(scene / "calibration.yaml"), place, Config())
    with tempfile.TemporaryDirectory() as folder:
        job = Job(open_source(scene), Driver(chain, FrameFiles(Path(folder))))
        result = _frame(job)[0]
        job.driver.files.write(result)
        peak, stage_peaks = _memory(job)
        plain = _plain_matchers(result)
        times = [_round(job, plain) for _ in range(rounds)]
    frames = np.array([_total(t, ("files", *PLAIN)) for t in times])
    after = np.array([_total(t, ("files", *PLAIN, *BEFORE)) for t in times])
    plain_ms = {name: np.array([t[name] for t in times]) for name in PLAIN}
    return FrameCost(
        size, site, _plain_disparities(chain.rig.fx),
        stages_ms={
            name: float(np.median([t[name] for t in times]))
            for name in times[0]
            if name not in PLAIN
        },
        frame_ms=float(np.median(frames)), after_ms=float(np.median(after)),
        files_ms=float(np.median([t["files"] for t in times])),
        plain_ms={name: float(np.median(ms)) for name, ms in plain_ms.items()},
        frame_ratio={name: float(np.median(frames / ms)) for name, ms in plain_ms.items()},
        after_ratio={name: float(np.median(after / ms)) for name, ms in plain_ms.items()},
        peak_mb=peak, stage_peaks_mb=stage_peaks, counts=dict(result.counts), status=result.status,
    )  # fmt: skip


def _round(job: Job, plain: Mapping[str, Callable[[], object]]) -> dict[str, float]:
    """Milliseconds of each stage, of the record, of the files, and of the plain matchers, one after
    the other.
    """
    result, times = _frame(job)
    lines, files = frame_lines(result, job.driver.chain.site, []), job.driver.files
    times["files"] = _ms(lambda: files.write(result)) + _ms(
        lambda: files.draw(lines, job.driver.chain.rig)
    )
    return times | {name: _ms(task) for name, task in plain.items()}


def _frame(job: Job) -> tuple[FrameResult, dict[str, float]]:
    """A frame from file to record, and milliseconds of each stage."""
    paths = job.source.files(0)
    for path in paths:
        os.utime(path)  # a file as new as each frame's: its hash is not remembered
    result = job.detect(0)
    site = job.driver.chain.site
    return result, dict(result.stages_ms) | {
        "record": _ms(lambda: frame_lines(result, site, paths))
    }


def _memory(job: Job) -> tuple[float | None, dict[str, float]]:
    found: list[tuple[float, dict[str, float]]] = []
    samples = sampled(lambda: found.append((time.perf_counter(), _frame(job)[1])))
    return peak_mb(samples), stage_peaks_mb(samples, *found[0])


def _plain_matchers(result: FrameResult) -> dict[str, Callable[[], object]]:
    pair = result.pair
    assert pair is not None, "a synthetic frame can be read"
    grey = [cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in (pair.left, pair.right)]
    count = _plain_disparities(pair.rig.fx)

    def task(mode: int) -> Callable[[], object]:
        matcher = cv2.StereoSGBM.create(0, count, 5, 200, 800, 1, 31, 10, 100, 32, mode)
        return lambda: matcher.compute(*grey)

    return {name: task(mode) for name, mode in PLAIN.items()}


def _plain_disparities(focal_px: float) -> int:
    return max(16, 16 * round(_PLAIN_DISPARITIES * focal_px / PLAIN_FOCAL_PX / 16))


def _total(times: Mapping[str, float], without: tuple[str, ...]) -> float:
    return sum(ms for name, ms in times.items() if name not in without)


def _ms(task: Callable[[], object]) -> float:
    start = time.perf_counter()
    task()
    return 1000 * (time.perf_counter() - start)
