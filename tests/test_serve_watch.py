"""Frames that appear in a folder: complete ones, each once, in order; also over a kill."""

import json
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Container
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest
from live import ListSink, names_in, running, wait_for

from stereo_ore.errors import FrameError, SourceError
from stereo_ore.io.recordings import open_source
from stereo_ore.plant.arrivals import arrivals
from stereo_ore.plant.frames import Position
from stereo_ore.plant.watch import FolderWatch

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


def test_a_frame_that_stays_incomplete_is_handed_on_as_failed_and_holds_up_only_for_a_while(
    tmp_path,
):
    put_pair(tmp_path, 1)
    (tmp_path / "left000002.png").write_bytes(picture())
    put_pair(tmp_path, 3)
    (tmp_path / "right000003.png").write_bytes(picture()[:50])
    put_pair(tmp_path, 4)
    frames = list(islice(watch(tmp_path).frames(Position(), threading.Event()), 4))
    assert [frame.name for frame in frames] == ["000001", "000002", "000003", "000004"]
    for frame, code in ((frames[1], "UNPAIRED"), (frames[2], "TRUNCATED_IMAGE")):
        with pytest.raises(FrameError) as fault:
            frame.read()
        assert fault.value.code == code


def test_a_late_frame_is_counted_and_left_out(tmp_path):
    for index in (1, 2, 4):
        put_pair(tmp_path, index)
    source, names, stop = watch(tmp_path), [], threading.Event()
    thread = collect(source, names, stop)
    wait_for(lambda: len(names) == 3)
    put_pair(tmp_path, 3)
    wait_for(lambda: "1 came too late" in source.state())
    put_pair(tmp_path, 5)
    wait_for(lambda: len(names) == 4)
    stop.set()
    thread.join()
    assert names == ["000001", "000002", "000004", "000005"]


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

    def seconds(done: Container[str]) -> float:
        start = time.perf_counter()
        found = arrivals(tmp_path, done)
        assert len(found) == (0 if done else 3000)
        return time.perf_counter() - start

    everything = {str(file) for file in tmp_path.iterdir()}
    assert min(seconds(everything) for _ in range(5)) < 0.3 * min(seconds(()) for _ in range(3))


def test_a_restart_goes_on_after_the_last_frame(tmp_path):
    for index in range(4):
        put_pair(tmp_path, index)
    assert take(watch(tmp_path), 2, Position("000001", 2)) == ["000002", "000003"]


def test_a_frame_that_was_copied_with_its_old_times_is_as_old_as_its_arrival(tmp_path):
    import os

    put_pair(tmp_path, 0)
    for file in tmp_path.iterdir():
        os.utime(file, (1, 1))
    frame = next(watch(tmp_path).frames(Position(), threading.Event()))
    assert 0 <= frame.age_s < 30


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


def test_500_frames_at_random_speed_each_once_and_in_order(tmp_path):
    inbox, out, sink = tmp_path / "in", tmp_path / "out", ListSink()
    inbox.mkdir()
    copying = threading.Thread(target=copy_slowly, args=(inbox, 500, random.Random(1)))
    with running(watch(inbox, patience_s=20), out, [sink]):
        copying.start()
        copying.join()
        wait_for(lambda: len(sink.messages) >= 500, 30)
    expected = [f"{index:06d}" for index in range(500)]
    assert names_in(out / "frames.jsonl") == expected
    records = [json.loads(line) for line in (out / "frames.jsonl").read_text().splitlines()]
    assert {record["status"] for record in records} == {"ok"}
    assert [record["index"] for record in records] == list(range(500))
    assert [message.frame for _, message in sink.messages if message.status == "ok"] == expected


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
        assert names_in(out / name) == [f"{index:06d}" for index in range(500)]
    assert json.loads((out / "run.json").read_text())["finished"]
