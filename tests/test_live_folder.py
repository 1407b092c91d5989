"""The folder of a run that goes on for a year: parts a day, a disk that fills, a folder that
vanishes, and what is kept."""

import errno
import json
import os
import shutil
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from live import ListSink, make_record, names_in, running, wait_for
from typer.testing import CliRunner

from stereo_ore.errors import ConfigError, OutputError
from stereo_ore.io import segments
from stereo_ore.io.results import Results
from stereo_ore.plant import live_folder
from stereo_ore.plant.clock import Clock
from stereo_ore.plant.frames import LiveFrame, Position
from stereo_ore.plant.live_files import LiveFiles, free_bytes
from stereo_ore.plant.live_folder import LiveFolder
from stereo_ore.plant.replay import schedule
from stereo_ore.plant.retention import Retention, parse_limits
from stereo_ore.runs.folder import FrameLines, RunFolder

DAY_NS = 86_400 * 10**9
ABOUT = {"source": "inbox", "versions": {"stereo-ore": "1"}}


class Noon(Clock):
    """Noon of a day that the test turns forward."""

    def __init__(self, day: int = 0) -> None:
        self.day = day

    def time_ns(self) -> int:
        return (20_000 + self.day) * DAY_NS + DAY_NS // 2


def lines(index: int, **changes: Any) -> FrameLines:
    name = f"{index:06d}"
    entry = {"frame": name, "files": {f"inbox/left{name}.png": None}, "written_ns": index}
    timing = {"frame": name, "stages_ms": {}, "total_ms": 1.0}
    record = make_record(index, **changes)
    return FrameLines(json.dumps(record), json.dumps(timing), json.dumps(entry))


def fill(folder: LiveFolder, *indices: int) -> None:
    for index in indices:
        folder.add(f"{index:06d}", lines(index))


def read(folder: Path) -> list[int]:
    return [record["index"] for record in Results(folder).records]


def test_a_new_day_begins_a_new_part_and_readers_read_all(tmp_path: Path) -> None:
    clock = Noon()
    with LiveFolder(tmp_path, ABOUT, clock=clock) as folder:
        for day in range(3):
            clock.day = day
            fill(folder, 2 * day, 2 * day + 1)
            assert read(tmp_path) == list(range(2 * day + 2))
        folder.finish()
    parts = segments.closed(tmp_path)
    assert [len(names_in(part / "frames.jsonl")) for part in parts] == [2, 2]
    assert [part.name[:6] for part in parts] == ["000000", "000001"]
    assert json.loads((parts[0] / "run.json").read_text())["source"] == "inbox"
    results = Results(tmp_path)
    assert len(results.timings) == 6
    assert [entry["frame"] for entry in results.inputs()] == [f"{n:06d}" for n in range(6)]
    assert len(list(schedule(tmp_path, 1.0, 1.0))) == 6
    assert [read(part) for part in parts] == [[0, 1], [2, 3]]


def test_export_and_report_read_all_parts(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    from stereo_ore.cli import app, load_verbs
    from stereo_ore.report.data import page_data

    clock = Noon()
    with LiveFolder(tmp_path / "live", ABOUT, clock=clock) as folder:
        for day in range(3):
            clock.day = day
            fill(folder, day)
        folder.finish()
    load_verbs()
    done = CliRunner().invoke(
        app,
        ["export", str(tmp_path / "live"), str(tmp_path / "tables"), "--format", "parquet"],
    )
    assert done.exit_code == 0, done.output
    import pyarrow.parquet

    assert pyarrow.parquet.read_table(tmp_path / "tables" / "frames").num_rows == 3
    assert len(page_data(Results(tmp_path / "live"))["frames"]) == 3


def test_other_parameters_or_another_version_begin_a_new_part(tmp_path: Path) -> None:
    written: list[int] = []
    for turn in range(3):
        about = {**ABOUT, "versions": {"stereo-ore": str(turn)}}
        with LiveFolder(tmp_path, about, lambda turn=turn: written.append(turn)) as folder:
            assert folder.position().index == turn
            fill(folder, turn)
            folder.finish()
    assert written == [0, 1, 2]
    assert read(tmp_path) == [0, 1, 2]
    assert len(segments.closed(tmp_path)) == 2


def test_the_same_run_goes_on_in_its_part(tmp_path: Path) -> None:
    for turn in range(3):
        with LiveFolder(tmp_path, ABOUT, clock=Noon()) as folder:
            fill(folder, turn)
    assert segments.closed(tmp_path) == []
    assert read(tmp_path) == [0, 1, 2]


def test_a_folder_of_the_version_before_goes_on(tmp_path: Path) -> None:
    with RunFolder(tmp_path, ABOUT, resume=True, overwrite=False) as run:
        run.add(lines(0))
        run.finish()
    with LiveFolder(tmp_path, ABOUT) as folder:
        assert folder.position().index == 1
        fill(folder, 1)
    assert read(tmp_path) == [0, 1]


def test_another_source_is_refused_or_replaced(tmp_path: Path) -> None:
    clock = Noon()
    with LiveFolder(tmp_path, ABOUT, clock=clock) as folder:
        fill(folder, 0)
        clock.day = 1
        fill(folder, 1, 2)
    with pytest.raises(OutputError, match=r"holds a run of 'inbox'.*--overwrite"):
        LiveFolder(tmp_path, {"source": "other"})
    with LiveFolder(tmp_path, {"source": "other"}, overwrite=True) as folder:
        fill(folder, 7)
    assert read(tmp_path) == [7]


@pytest.mark.parametrize("until", range(9))
def test_killed_while_a_part_is_closed_no_frame_is_lost_or_there_twice(
    until: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each operation on a file that closes a part is the last in its turn."""
    clock, count = Noon(), 0
    folder = LiveFolder(tmp_path, ABOUT, clock=clock)
    fill(folder, 0, 1)
    clock.day = 1

    class Killed(BaseException):
        pass

    def dying(action: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            nonlocal count
            count += 1
            if count > until:
                raise Killed
            return action(*arguments, **named)

        return call

    for name in ("replace", "unlink", "mkdir"):
        monkeypatch.setattr(Path, name, dying(getattr(Path, name)))
    monkeypatch.setattr(shutil, "copyfile", dying(shutil.copyfile))
    with pytest.raises(Killed):
        fill(folder, 2)
    monkeypatch.undo()
    folder.__exit__(None, None, None)
    assert read(tmp_path) == [0, 1]
    with LiveFolder(tmp_path, ABOUT, clock=clock) as folder:
        assert folder.position().index == 2
        fill(folder, 2, 3)
    assert read(tmp_path) == [0, 1, 2, 3]
    assert all(part.name[0] != "." for part in segments.closed(tmp_path))


def test_what_is_handled_is_looked_up_in_all_parts(tmp_path: Path) -> None:
    clock = Noon()
    with LiveFolder(tmp_path, ABOUT, clock=clock) as folder:
        for day in range(3):
            clock.day = day
            fill(folder, day)
    with LiveFolder(tmp_path, ABOUT, clock=clock) as folder:
        position = folder.position()
        assert position.index == 3
        assert dict(position.handled(0)) == {f"inbox/left{n:06d}.png": n for n in range(3)}
        assert list(position.handled(2**62)) == []


def test_a_second_serve_on_a_folder_is_refused(tmp_path: Path) -> None:
    with LiveFolder(tmp_path, ABOUT), pytest.raises(OutputError, match="is in use by another"):
        LiveFolder(tmp_path, ABOUT)
    with LiveFolder(tmp_path, ABOUT):
        pass
    with (
        RunFolder(tmp_path / "run", ABOUT, resume=True, overwrite=False),
        pytest.raises(OutputError, match="is in use by another"),
    ):
        LiveFolder(tmp_path / "run", ABOUT)


def test_a_name_of_today_or_of_a_picture_that_is_there_gets_its_index(tmp_path: Path) -> None:
    def named(index: int, name: str = "a") -> str:
        return folder.named(LiveFrame(name, index, 0, (), lambda: None)).name

    with LiveFolder(tmp_path, ABOUT) as folder:
        assert named(0) == "a"
        folder.add("a", lines(0, frame="a"))
        assert named(1) == "a_1"
        (tmp_path / "overlays").mkdir()
        (tmp_path / "overlays" / "b.png").touch()
        assert named(1, "b") == "b_1"


# --- a disk that is full


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of a megabyte."""
    place = tmp_path / "disk"
    place.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(place)]
    if not shutil.which("mount") or subprocess.run(command, capture_output=True).returncode:
        pytest.skip("no disk can be mounted here")
    yield place
    subprocess.run(["umount", "-l", str(place)], check=True)


def fill_disk(place: Path) -> Path:
    file = place / "filler"
    with file.open("ab", buffering=0) as out, suppress(OSError):
        while True:
            out.write(b"x" * 4096)
    return file


def test_a_full_disk_costs_no_record_and_no_target(
    small_disk: Path, caplog: pytest.LogCaptureFixture
) -> None:
    out, sink, go = small_disk / "live", ListSink(), threading.Semaphore(0)
    with running(Paced(go), out, [sink]) as (status, _, _):

        def frame(count: int) -> Any:
            go.release()
            wait_for(lambda: len(sink.messages) == count)
            return sink.messages[-1][1]

        assert frame(1).reasons == ()
        assert status.json()["alarms"] == []
        filler = fill_disk(small_disk)
        for count in range(2, 30):
            message = frame(count)
            assert len(message.targets) == 2
        assert "DISK_FULL" in message.reasons
        (alarm,) = status.json()["alarms"]
        assert "No space left" in alarm
        assert "records wait in memory" in alarm
        filler.unlink()
        assert frame(30).reasons == ()
        assert status.json()["alarms"] == []
    assert read(out) == list(range(30))
    assert [record["frame"] for record in Results(out).records] == names_in(out / "timings.jsonl")
    said = [entry.getMessage() for entry in caplog.records if entry.levelname == "ERROR"]
    assert len(said) == 1
    assert "No space left" in said[0]


def test_started_on_a_full_disk_it_serves_and_writes_when_there_is_room(small_disk: Path) -> None:
    out, clock = small_disk / "live", Noon()
    with LiveFolder(out, ABOUT, clock=clock) as folder:
        fill(folder, 0)
    filler = fill_disk(small_disk)
    clock.day = 1
    with LiveFolder(out, ABOUT, clock=clock) as folder:
        assert folder.position().index == 1
        fill(folder, 1, 2)
        filler.unlink()
        fill(folder, 3)
        assert folder.alarm == ""
    assert read(out) == [0, 1, 2, 3]


def test_a_new_day_on_a_full_disk(small_disk: Path) -> None:
    out, clock = small_disk / "live", Noon()
    with LiveFolder(out, ABOUT, clock=clock) as folder:
        fill(folder, 0)
        filler = fill_disk(small_disk)
        for day in range(1, 4):
            clock.day = day
            fill(folder, *range(10 * day, 10 * day + 10))
        assert folder.waiting > 0
        filler.unlink()
        fill(folder, 40)
        assert (folder.alarm, folder.waiting) == ("", 0)
    assert read(out) == [0, *range(10, 41)]


def test_what_waits_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_folder, "MOST_WAITING", 20)
    monkeypatch.setattr(live_folder, "MOST_WAITING_BYTES", 20_000)
    full = True

    def write(self: RunFolder, name: str, line: str) -> None:
        if full:
            raise OSError(errno.ENOSPC, "No space left on device")
        original(self, name, line)

    original = RunFolder._append
    monkeypatch.setattr(RunFolder, "_append", write)
    with LiveFolder(tmp_path, ABOUT) as folder:
        fill(folder, *range(25))
        assert (folder.waiting, folder.lost_records) == (20, 5)
        assert "5 are lost" in folder.alarm
        full = False
        folder.finish()
    records = Results(tmp_path).records
    assert [record["index"] for record in records] == list(range(20))
    assert records[0]["ores"]
    assert not records[-1]["ores"]
    assert records[-1]["reasons"][-1]["code"] == "THINNED"


def test_without_room_only_records_are_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from stereo_ore.plant import live_files
    from stereo_ore.runs.frame_files import FrameFiles

    written: list[str] = []
    monkeypatch.setattr(FrameFiles, "write", lambda self, result: written.append(result))
    files = LiveFiles(tmp_path)
    files.write("a")
    monkeypatch.setattr(live_files, "NO_DISK_BYTES", 10**18)
    files.write("b")
    assert "left on the disk" in files.room.fault
    monkeypatch.setattr(live_files, "NO_DISK_BYTES", 0)
    files.write("c")
    assert (written, files.room.fault, files.room.left_out) == (["a", "c"], "", 1)

    def refuse(self: FrameFiles, result: Any) -> None:
        raise OutputError("can't be written: No space left on device", file=tmp_path)

    monkeypatch.setattr(FrameFiles, "write", refuse)
    files.write("d")
    assert "No space left" in files.room.fault


# --- a folder that vanishes


class Paced:
    """A frame each time the test lets one go."""

    name = "inbox"

    def __init__(self, go: threading.Semaphore) -> None:
        self._go = go

    def frames(self, start: Position, stop: threading.Event) -> Iterator[LiveFrame]:
        index = start.index
        while not stop.is_set():
            if self._go.acquire(timeout=0.05):
                yield LiveFrame(f"{index:06d}", index, 2**62, (), lambda: None, 0.0, clock=Now())
                index += 1

    def state(self) -> str:
        return "paced"


class Now(Clock):
    """A clock on which nothing grows old."""

    def monotonic(self) -> float:
        return 0.0


def test_a_folder_that_is_removed_takes_the_targets_of_the_next_frame_away(tmp_path: Path) -> None:
    out, sink, go = tmp_path / "live", ListSink(), threading.Semaphore(0)
    with running(Paced(go), out, [sink]) as (status, _, _):

        def frame() -> Any:
            count = len(sink.messages)
            go.release()
            wait_for(lambda: len(sink.messages) == count + 1)
            return sink.messages[-1][1]

        assert len(frame().targets) == 2
        out.rename(tmp_path / "away")
        message = frame()
        assert (message.status, message.targets) == ("degraded", ())
        assert message.reasons == ("RESULTS_GONE",)
        assert "is gone" in status.json()["alarms"][0]
        (tmp_path / "away").rename(out)
        assert len(frame().targets) == 2
        assert status.json()["alarms"] == []
        shutil.rmtree(out)
        assert frame().targets == ()
        out.mkdir()
        assert len(frame().targets) == 2
    assert read(out) == [3, 4]
    assert free_bytes(tmp_path / "none") == 0


# --- what is kept


def aged(folder: Path, name: str, age_d: float, size: int = 1000) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / name
    file.write_bytes(bytes(size))
    seconds = Noon().time_ns() / 1e9 - 86_400 * age_d
    os.utime(file, (seconds, seconds))
    return file


@pytest.mark.parametrize(
    ("limit", "left"),
    [("clouds=2d", 2), ("clouds=3MB", 3), ("clouds=2d,1MB", 1), ("overlays=1d", 5)],
)
def test_older_or_more_than_the_limit_goes_the_oldest_first(
    limit: str, left: int, tmp_path: Path
) -> None:
    for age in range(5):
        aged(tmp_path / "clouds", f"{age}.ply", age + 0.5, 10**6)
    Retention(tmp_path, parse_limits([limit]), clock=Noon()).sweep()
    assert sorted(file.name for file in (tmp_path / "clouds").iterdir()) == [
        f"{age}.ply" for age in range(left)
    ]


def test_of_the_inbox_only_what_is_done_goes(tmp_path: Path) -> None:
    old = [aged(tmp_path / "in", f"left{n}.png", 9) for n in range(3)]
    done = [(old[0], (old[0].stat().st_mtime_ns, 1000)), (old[1], (Noon().time_ns(), 1000))]
    retention = Retention(tmp_path, parse_limits(["inbox=1d"]), lambda: done, Noon())
    assert retention.sweep() == 1
    assert [file.exists() for file in old] == [False, True, True]


def test_records_go_by_whole_parts_never_the_one_that_grows(tmp_path: Path) -> None:
    clock = Noon()
    with LiveFolder(tmp_path, ABOUT, clock=clock) as folder:
        for day in range(4):
            clock.day = day
            fill(folder, day)
        assert len(segments.closed(tmp_path)) == 3
        Retention(tmp_path, parse_limits(["records=0.000001MB"])).sweep()
        assert segments.closed(tmp_path) == []
        fill(folder, 9)
    assert read(tmp_path) == [3, 9]
    with LiveFolder(tmp_path, ABOUT, clock=clock) as folder:
        assert folder.position().index == 10


def test_a_link_is_neither_followed_nor_removed(tmp_path: Path) -> None:
    foreign = aged(tmp_path / "foreign", "a.ply", 9)
    (tmp_path / "clouds").mkdir()
    (tmp_path / "clouds" / "a.ply").symlink_to(foreign)
    Retention(tmp_path, parse_limits(["clouds=1d"]), clock=Noon()).sweep()
    assert foreign.exists()


@pytest.mark.parametrize("text", ["clouds", "clouds=", "clouds=7", "stages=7d", "clouds=7d;1GB"])
def test_a_limit_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match=r"is no limit\. One of clouds"):
        parse_limits([text])


def test_what_can_not_be_removed_is_told_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    for n in range(3):
        aged(tmp_path / "clouds", f"{n}.ply", 9)

    def refuse(self: Path, missing_ok: bool = False) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(Path, "unlink", refuse)
    assert Retention(tmp_path, parse_limits(["clouds=1d"]), clock=Noon()).sweep() == 0
    assert caplog.text.count("Read-only file system") == 1
