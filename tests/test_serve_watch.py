"""Frames that appear in a folder: complete ones, each once, in order; also over a kill."""

import json
import math
import os
import random
import signal
import subprocess
import sys
import threading
import time
from itertools import islice
from pathlib import Path
from threading import Event

import cv2
import numpy as np
import pytest
from live import ListSink, names_in, running, wait_for

from stereo_ore.errors import FrameError, SourceError
from stereo_ore.io.recordings import open_source
from stereo_ore.plant.arrivals import arrivals
from stereo_ore.plant.clock import SYSTEM, Clock
from stereo_ore.plant.frames import Position
from stereo_ore.plant.inbox import Inbox
from stereo_ore.plant.watch import FolderWatch

SIDES = ("left", "right")
SERVER = Path(__file__).with_name("live.py")


def picture(seed: int = 0, suffix: str = ".png", width: int = 16) -> bytes:
    image = np.random.default_rng(seed).integers(0, 255, (12, width, 3), np.uint8)
    return cv2.imencode(suffix, image)[1].tobytes()


def put_pair(folder: Path, index: int) -> None:
    for side in ("left", "right"):
        (folder / f"{side}{index:06d}.png").write_bytes(picture(index))


def watch(folder: Path, patience_s: float = 0.3) -> FolderWatch:
    return FolderWatch(folder, poll_s=0.01, patience_s=patience_s)


def take(source: FolderWatch, count: int, start: Position = Position()) -> list[str]:  # noqa: B008
    return [frame.name for frame in islice(source.frames(start, threading.Event()), count)]


def collect(source: FolderWatch, names: list, stop: threading.Event) -> threading.Thread:
    thread = threading.Thread(
        target=lambda: names.extend(f.name for f in source.frames(Position(), stop))
    )
    thread.start()
    return thread


@pytest.mark.parametrize("layout", ["marks", "subfolders", "side_by_side", "folders"])
def test_each_layout_of_images(tmp_path, layout):
    for index in (9, 10):
        if layout == "side_by_side":
            (tmp_path / f"frame_{index}.png").write_bytes(picture(index, width=32))
        for side in () if layout == "side_by_side" else ("left", "right"):
            file = {
                "marks": f"{side}_{index}.png",
                "subfolders": f"{side}/{index}.png",
                "folders": f"{index}/{side}.png",
            }
            path = tmp_path / file[layout]
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(picture(index))
    frames = list(islice(watch(tmp_path).frames(Position(), threading.Event()), 2))
    assert [frame.index for frame in frames] == [0, 1]
    assert "9" in frames[0].name
    assert "10" in frames[1].name
    assert frames[1].read().left.shape == (12, 16, 3)
    assert frames[1].read().index == 1


def test_a_folder_that_is_not_there_is_an_error(tmp_path):
    with pytest.raises(SourceError, match="no such folder"):
        FolderWatch(tmp_path / "none")


def test_a_frame_waits_until_both_files_are_whole(tmp_path):
    names, stop = [], threading.Event()
    thread = collect(watch(tmp_path, patience_s=60), names, stop)
    data = picture()
    (tmp_path / "left0.png").write_bytes(data)
    time.sleep(0.1)
    right = tmp_path / "right0.png"
    for end in (0, 5, 40, len(data) // 2, len(data) - 3):
        right.write_bytes(data[:end])
        time.sleep(0.05)
        assert names == [], f"taken with {end} of {len(data)} bytes"
    right.write_bytes(data)
    wait_for(lambda: names == ["0"])
    stop.set()
    thread.join()


def test_a_format_without_an_end_marker_waits_until_it_has_settled(tmp_path):
    start = time.monotonic()
    for side in ("left", "right"):
        (tmp_path / f"{side}0.bmp").write_bytes(picture(suffix=".bmp"))
    assert take(watch(tmp_path, patience_s=60), 1) == ["0"]
    assert time.monotonic() - start > 0.9


def test_a_frame_that_stays_incomplete_is_handed_on_as_failed_and_holds_up_nobody(tmp_path):
    put_pair(tmp_path, 1)
    (tmp_path / "left000002.png").write_bytes(picture())
    put_pair(tmp_path, 3)
    (tmp_path / "right000003.png").write_bytes(picture()[:50])
    put_pair(tmp_path, 4)
    frames = list(islice(watch(tmp_path).frames(Position(), threading.Event()), 4))
    assert [frame.name for frame in frames] == ["000001", "000004", "000002", "000003"]
    for frame, code in ((frames[2], "UNPAIRED"), (frames[3], "TRUNCATED_IMAGE")):
        with pytest.raises(FrameError) as fault:
            frame.read()
        assert fault.value.code == code


def test_frames_come_in_the_order_of_their_arrival_whatever_their_names(tmp_path):
    """The end of a month, a counter that begins anew, and a name that sorts behind all others."""
    source, names, stop = watch(tmp_path), [], threading.Event()
    thread = collect(source, names, stop)
    order = ["20261130_235959", "20261201_000000", "zzz", "999999", "000000", "000001"]
    for count, name in enumerate(order, 1):
        for side in ("left", "right"):
            (tmp_path / f"{side}_{name}.png").write_bytes(picture(count))
        wait_for(lambda count=count: len(names) == count)
    stop.set()
    thread.join()
    assert names == order


def test_a_backlog_comes_in_the_order_in_which_it_was_written(tmp_path):
    for count, index in enumerate((7, 3, 9, 1)):
        put_pair(tmp_path, index)
        for file in tmp_path.glob(f"*{index:06d}.png"):
            os.utime(file, (count, count))
    assert take(watch(tmp_path), 4) == ["000007", "000003", "000009", "000001"]


def test_a_name_that_is_used_again_is_a_new_frame(tmp_path):
    source, frames, stop = watch(tmp_path), [], threading.Event()
    thread = threading.Thread(target=lambda: frames.extend(source.frames(Position(), stop)))
    thread.start()
    for turn in range(3):
        for side in ("left", "right"):
            (tmp_path / f"{side}000000.png").write_bytes(picture(turn, width=16 + turn))
        wait_for(lambda turn=turn: len(frames) == turn + 1)
    (tmp_path / "left000000.png").chmod(0o600)
    os.utime(tmp_path / "right000000.png", (1, 1))
    time.sleep(0.2)
    stop.set()
    thread.join()
    assert [frame.name for frame in frames] == ["000000"] * 3


def test_behind_the_newest_is_next_and_the_others_are_skipped_with_a_reason(tmp_path):
    for index in range(20):
        put_pair(tmp_path, index)
        for file in tmp_path.glob(f"*{index:06d}.png"):
            os.utime(file, (index, index))
    (tmp_path / "left000099.png").write_bytes(picture())
    source = FolderWatch(tmp_path, poll_s=0.01, patience_s=0.2, queue=2)
    frames = list(islice(source.frames(Position(), threading.Event()), 21))
    assert [frame.name for frame in frames[:20]] == [
        "000019",
        *(f"{index:06d}" for index in range(19)),
    ]
    assert [bool(frame.skipped) for frame in frames] == [False, *[True] * 19, False]
    assert [frame.index for frame in frames] == list(range(21))
    assert frames[20].name == "000099"
    assert "19 were skipped" in source.state()


def test_as_many_as_may_wait_come_in_order(tmp_path):
    for index in range(2):
        put_pair(tmp_path, index)
    source = FolderWatch(tmp_path, poll_s=0.01, queue=2)
    frames = list(islice(source.frames(Position(), threading.Event()), 2))
    assert [(frame.name, frame.skipped) for frame in frames] == [("000000", ""), ("000001", "")]


def test_two_files_for_one_eye_stop_nobody(tmp_path):
    put_pair(tmp_path, 0)
    (tmp_path / "LEFT_000000.png").write_bytes(picture())
    put_pair(tmp_path, 1)
    frames = list(islice(watch(tmp_path).frames(Position(), threading.Event()), 3))
    assert {frame.name for frame in frames[:2]} == {"000000", "000001"}
    with pytest.raises(FrameError) as fault:
        frames[2].read()
    assert fault.value.code == "UNPAIRED"


def test_frames_that_are_deleted_once_done_change_nothing(tmp_path):
    source, names, stop = watch(tmp_path), [], threading.Event()
    thread = collect(source, names, stop)
    for index in range(5):
        put_pair(tmp_path, index)
        wait_for(lambda index=index: len(names) == index + 1)
        for file in tmp_path.iterdir():
            file.unlink()
    stop.set()
    thread.join()
    assert names == [f"{index:06d}" for index in range(5)]
    assert "late" not in source.state()


def test_a_picture_without_a_mark_beside_pairs_is_no_frame(tmp_path):
    source, names, stop = watch(tmp_path), [], threading.Event()
    put_pair(tmp_path, 0)
    (tmp_path / "preview.png").write_bytes(picture(width=32))
    thread = collect(source, names, stop)
    wait_for(lambda: len(names) == 1)
    time.sleep(0.1)
    put_pair(tmp_path, 1)
    wait_for(lambda: len(names) == 2)
    stop.set()
    thread.join()
    assert names == ["000000", "000001"]


def test_a_folder_that_goes_away_may_come_back(tmp_path):
    inbox = tmp_path / "in"
    inbox.mkdir()
    source, names, stop = watch(inbox), [], threading.Event()
    thread = collect(source, names, stop)
    put_pair(inbox, 0)
    wait_for(lambda: len(names) == 1)
    inbox.rename(tmp_path / "away")
    wait_for(lambda: "can't be read" in source.state())
    (tmp_path / "away").rename(inbox)
    put_pair(inbox, 1)
    wait_for(lambda: len(names) == 2)
    assert "can't be read" not in source.state()
    stop.set()
    thread.join()


def test_names_agree_with_those_that_run_gives(tmp_path):
    for name in ("cam L 9.png", "cam R 9.png", "cam L 10.png", "cam R 10.png", "only_left_11.png"):
        (tmp_path / name).write_bytes(picture())
    assert take(watch(tmp_path), 3) == list(open_source(tmp_path).names)


def test_listing_does_not_grow_with_the_frames_that_are_done(tmp_path):
    for index in range(3000):
        for side in ("left", "right"):
            (tmp_path / f"{side}{index:06d}.png").touch()

    def seconds(inbox: Inbox) -> float:
        start = time.perf_counter()
        arrivals(tmp_path, inbox.new_files())
        return time.perf_counter() - start

    done = Inbox(tmp_path)
    for file in done.new_files()[""]:
        done.handle(file)
    assert len(arrivals(tmp_path, Inbox(tmp_path).new_files())) == 3000
    assert arrivals(tmp_path, done.new_files()) == []
    assert min(seconds(done) for _ in range(5)) < 0.3 * min(
        seconds(Inbox(tmp_path)) for _ in range(3)
    )


class StillClock(Clock):
    now_s = 100.0

    def monotonic(self) -> float:
        return self.now_s


def handled_inbox(folder: Path, clock: Clock = SYSTEM) -> Inbox:
    """An inbox of ten frames that are handled, in a folder whose time is sure."""
    for index in range(10):
        put_pair(folder, index)
    inbox = Inbox(folder, clock)
    for file in inbox.new_files()[""]:
        inbox.handle(file)
    return inbox


def listings(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """Each listing of a folder from now on."""
    seen: list[object] = []
    listed = os.listdir

    def listdir(path: object) -> list[str]:
        seen.append(path)
        return listed(path)

    monkeypatch.setattr(os, "listdir", listdir)
    return seen


def test_a_new_file_that_the_system_tells_of_needs_no_listing(tmp_path, monkeypatch):
    clock = StillClock()
    inbox = handled_inbox(tmp_path, clock)
    clock.now_s += 3
    inbox.new_files()
    seen = listings(monkeypatch)
    put_pair(tmp_path, 10)
    (tmp_path / ".hidden.png").touch()
    wait_for(lambda: len(inbox.new_files()[""]) == 2)
    told = len(seen)
    (tmp_path / "left000010.png").unlink()
    put_pair(tmp_path, 3)
    names = ["left000003.png", "right000003.png", "right000010.png"]
    wait_for(lambda: [file.name for file in inbox.new_files()[""]] == names)
    if sys.platform == "linux":
        assert told <= 1  # where the word came later than the folder's time
    clock.now_s += 60
    before = len(seen)
    inbox.new_files()
    assert len(seen) == before + 1, "listed now and then all the same"


def test_a_file_written_anew_under_its_name_is_seen_at_once(tmp_path, monkeypatch):
    monkeypatch.setattr("stereo_ore.plant.inbox.RECHECKS", 0)
    clock = StillClock()
    inbox = handled_inbox(tmp_path, clock)
    clock.now_s += 3
    inbox.new_files()
    changed_ns = tmp_path.stat().st_mtime_ns
    put_pair(tmp_path, 3)
    assert tmp_path.stat().st_mtime_ns == changed_ns
    names = ["left000003.png", "right000003.png"]
    wait_for(lambda: [file.name for file in inbox.new_files()[""]] == names)


def test_where_the_system_tells_nothing_a_folder_is_listed(tmp_path, monkeypatch, caplog):
    def watch_limit(*paths: object, **options: object) -> None:
        raise OSError("OS file watch limit reached")

    monkeypatch.setattr("watchfiles.watch", watch_limit)
    caplog.set_level("INFO")
    inbox = handled_inbox(tmp_path)
    seen = listings(monkeypatch)
    put_pair(tmp_path, 10)
    assert len(inbox.new_files()[""]) == 2
    assert seen == [tmp_path]
    assert "watch limit reached" in caplog.text


def test_new_folders_are_found_by_what_the_system_tells(tmp_path):
    inbox = Inbox(tmp_path)
    assert inbox.new_files() == {"": []}
    for side in SIDES:
        (tmp_path / side).mkdir()
        (tmp_path / side / "1.png").write_bytes(picture())
    wait_for(lambda: [len(files) for files in inbox.new_files().values()] == [0, 1, 1])


def test_a_restart_goes_on_with_what_was_not_handled(tmp_path):
    for index in range(4):
        put_pair(tmp_path, index)
    done = [(str(tmp_path / f"{side}{n:06d}.png"), math.inf) for n in (0, 2) for side in SIDES]
    assert take(watch(tmp_path), 2, Position(2, lambda since_ns: done)) == ["000001", "000003"]


@pytest.mark.parametrize("trust", [True, False])
def test_a_frame_that_was_copied_late_with_its_old_times_is_old(tmp_path, trust):
    """Unless it is said that its files' times tell nothing; a new mode makes it no younger."""
    source, frames, stop = FolderWatch(tmp_path, poll_s=0.01, trust_times=trust), [], Event()
    thread = threading.Thread(target=lambda: frames.extend(source.frames(Position(), stop)))
    thread.start()
    time.sleep(0.1)
    for side in SIDES:
        file = tmp_path / f".{side}"
        file.write_bytes(picture())
        os.utime(file, (time.time() - 32,) * 2)
        file.chmod(0o600)
        file.rename(tmp_path / f"{side}000000.png")
    wait_for(lambda: len(frames) == 1)
    stop.set()
    thread.join()
    assert (frames[0].age_s > 31) == trust


def test_a_name_that_is_a_stamp_tells_the_age(tmp_path):
    stamp = time.time_ns() - 60 * 10**9
    for side in SIDES:
        (tmp_path / f"{side}_{stamp}.png").write_bytes(picture())
    frame = next(watch(tmp_path).frames(Position(), threading.Event()))
    assert 59 < frame.age_s < 90


def copy_slowly(folder: Path, count: int, rng: random.Random) -> None:
    """Copy as tools do: some under the final name from the first byte, some by renaming; the eyes
    in any order."""
    data = picture()
    for index in range(count):
        for side in rng.sample(("left", "right"), 2):
            target = folder / f"{side}{index:06d}.png"
            partial = target if rng.random() < 0.5 else target.with_suffix(".png.part")
            with partial.open("wb") as file:
                file.write(data[: rng.randrange(len(data))])
                file.flush()
                if rng.random() < 0.2:
                    time.sleep(rng.random() * 0.02)
                file.seek(0)
                file.write(data)
            partial.rename(target)


def test_500_frames_at_random_speed_each_once(tmp_path):
    inbox, out, sink = tmp_path / "in", tmp_path / "out", ListSink()
    inbox.mkdir()
    copying = threading.Thread(target=copy_slowly, args=(inbox, 500, random.Random(1)))
    with running(watch(inbox, patience_s=20), out, [sink]):
        copying.start()
        copying.join()
        wait_for(lambda: sum(m.status == "ok" for _, m in sink.messages) == 500, 60)
    expected = [f"{index:06d}" for index in range(500)]
    assert sorted(names_in(out / "frames.jsonl")) == expected
    records = [json.loads(line) for line in (out / "frames.jsonl").read_text().splitlines()]
    assert {record["status"] for record in records} == {"ok"}
    assert [record["index"] for record in records] == list(range(500))
    assert sorted(m.frame for _, m in sink.messages if m.status == "ok") == expected


def test_killed_and_restarted_it_goes_on_where_it_was(tmp_path):
    inbox, out, rng = tmp_path / "in", tmp_path / "out", random.Random(2)
    inbox.mkdir()
    copying = threading.Thread(target=copy_slowly, args=(inbox, 500, rng))
    command = [sys.executable, str(SERVER), str(inbox), str(out)]
    for turn in range(4):
        with subprocess.Popen(command, stdout=subprocess.PIPE) as server:
            assert server.stdout.readline() == b"ready\n"
            if turn == 0:
                copying.start()
            done = out / "frames.jsonl.part"
            if turn < 3:
                wait_for(lambda turn=turn, done=done: len(names_in(done)) > 100 * (turn + 1), 30)
                server.send_signal(signal.SIGKILL)
            else:
                copying.join()
                wait_for(lambda done=done: len(names_in(done)) == 500, 30)
                server.send_signal(signal.SIGTERM)
    for name in ("frames.jsonl", "timings.jsonl"):
        assert sorted(names_in(out / name)) == [f"{index:06d}" for index in range(500)]
    assert json.loads((out / "run.json").read_text())["finished"]
