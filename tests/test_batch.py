"""Frames one after the other: read ahead, written behind, in order, with every error at its
frame."""

import json
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereo_ore.chain import no_counts
from stereo_ore.config import Config
from stereo_ore.errors import FrameError, OutputError
from stereo_ore.runs import ahead, batch
from stereo_ore.runs.ahead import ReadAhead
from stereo_ore.runs.driver import Driver
from stereo_ore.runs.frame_files import npz
from stereo_ore.types import FrameResult, Site, StereoPair

IMAGE = np.zeros((2, 2, 3), np.uint8)


@dataclass
class Fake:
    """A recording that takes its time, fails at some frames, and knows what was read, and by
    whom."""

    count: int = 12
    broken: tuple[int, ...] = ()
    seconds: float = 0.0
    calls: list[tuple[int, str]] = field(default_factory=list)
    path: Path = Path("fake")
    calibration: None = None

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"{index:06d}" for index in range(self.count))

    @property
    def description(self) -> Mapping[str, Any]:
        return {}

    def files(self, index: int) -> tuple[Path, ...]:
        return ()

    def stamp(self, index: int) -> None:
        return None

    def read(self, index: int) -> StereoPair:
        self.calls.append((index, threading.current_thread().name))
        time.sleep(self.seconds)
        if index in self.broken:
            raise FrameError("is broken", code="BROKEN", file=f"{index}")
        return StereoPair(IMAGE, IMAGE, name=self.names[index], index=index)


class FakeFiles:
    """Takes its time to write, and fails at some frames."""

    def __init__(self, seconds: float = 0.0, broken: tuple[int, ...] = ()) -> None:
        self.seconds, self.broken, self.done = seconds, broken, []

    def write(self, result: FrameResult) -> None:
        time.sleep(self.seconds)
        if result.index in self.broken:
            raise OutputError("disk full", file=result.name)
        self.done.append(result.index)


class FakeChain:
    """A frame takes it 20 ms."""

    config, site = Config(), Site()

    def __call__(self, pair: StereoPair) -> FrameResult:
        time.sleep(0.02)
        return FrameResult(pair.name, pair.index, None, "ok", (), no_counts())


@pytest.fixture
def job() -> batch.Job:
    return made()


def made(
    source: Fake | None = None, files: FakeFiles | None = None, strict: bool = False
) -> batch.Job:
    driver = Driver(FakeChain(), files or FakeFiles())  # type: ignore[arg-type]
    return batch.Job(source or Fake(), driver, strict)


def indices(lines: Iterator[batch.FrameLines]) -> list[int]:
    return [json.loads(entry.record)["index"] for entry in lines]


def test_lines_come_in_order_and_after_their_files(job: batch.Job) -> None:
    for entry in batch.run_in_batches(job, range(0, 12, 3)):
        assert json.loads(entry.record)["index"] in job.driver.files.done
    assert job.driver.files.done == [0, 3, 6, 9]
    assert [index for index, _ in job.source.calls] == [0, 3, 6, 9]
    assert {thread.split("_")[0] for _, thread in job.source.calls} == {"read ahead"}


def test_reading_and_writing_cost_no_time_of_their_own(job: batch.Job) -> None:
    slow = made(Fake(seconds=0.02), FakeFiles(seconds=0.02))
    start = time.perf_counter()
    [slow(index) for index in range(12)]
    one_by_one = time.perf_counter() - start
    start = time.perf_counter()
    assert indices(batch.run_in_batches(slow, range(12))) == list(range(12))
    assert time.perf_counter() - start < 0.7 * one_by_one


def test_what_waits_is_bounded() -> None:
    slow = made(files=FakeFiles(seconds=0.05))
    lines = batch.run_in_batches(slow, range(12))
    next(lines)
    assert len(slow.source.calls) <= batch.WRITES_AHEAD + 1 + ahead.FRAMES_AHEAD
    lines.close()
    assert len(slow.driver.files.done) <= batch.WRITES_AHEAD + 1, (
        "frames in work are finished, no more are begun"
    )


def test_a_frame_that_cannot_be_read_fails_alone(job: batch.Job) -> None:
    assert indices(batch.run_in_batches(made(Fake(broken=(1, 4))), range(6))) == [0, 1, 2, 3, 4, 5]


def test_a_strict_job_gives_the_frames_before(job: batch.Job) -> None:
    found = []
    with pytest.raises(FrameError, match="frame 000004 failed: 4: is broken"):
        found.extend(
            json.loads(entry.record)["index"]
            for entry in batch.run_in_batches(made(Fake(broken=(4,)), strict=True), range(8))
        )
    assert found == [0, 1, 2, 3]


def test_a_full_disk_ends_the_run_at_its_frame(job: batch.Job) -> None:
    full, found = made(files=FakeFiles(broken=(3,))), []
    with pytest.raises(OutputError, match="000003: disk full"):
        found.extend(
            json.loads(entry.record)["index"] for entry in batch.run_in_batches(full, range(8))
        )
    assert found == [0, 1, 2]


def test_frames_out_of_the_announced_order_are_read_too() -> None:
    source = Fake()
    with ReadAhead(source, [0, 1, 2]) as recording:
        assert [recording.read(index).index for index in (5, 0, 1, 7, 2, 2)] == [5, 0, 1, 7, 2, 2]
        assert (recording.names, recording.path, recording.files(0)) == (
            source.names,
            source.path,
            (),
        )
        assert (recording.calibration, recording.description) == (None, {})


def test_stage_arrays_come_back(tmp_path: Path) -> None:
    arrays = {"a": np.arange(6, dtype=np.float32).reshape(2, 3), "b": np.zeros(0, bool)}
    (tmp_path / "a.npz").write_bytes(npz(arrays))
    with np.load(tmp_path / "a.npz", allow_pickle=False) as found:
        assert set(found.files) == {"a", "b"}
        for name, array in arrays.items():
            np.testing.assert_array_equal(found[name], array)
            assert found[name].dtype == array.dtype
    assert npz(arrays) == npz(arrays)
