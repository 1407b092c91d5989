"""The verb `serve`: the whole chain behind it, the camera, what it refuses."""

import contextlib
import json
import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from live import ListSink, free_port, lines_of, names_in, running, wait_for
from typer.testing import CliRunner

from stereo_ore.cli import app, load_verbs
from stereo_ore.config import Config
from stereo_ore.errors import FrameError, OutputError, SourceError, StereoOreError
from stereo_ore.io.lock import FolderLock
from stereo_ore.io.recordings import open_source
from stereo_ore.plant.camera import LiveCamera, open_camera
from stereo_ore.plant.frames import LiveFrame, Position, ReplayedRecording
from stereo_ore.plant.live_folder import LiveFolder
from stereo_ore.plant.loop import Done, processing, serve
from stereo_ore.plant.publisher import Publisher
from stereo_ore.plant.status import PlantStatus
from stereo_ore.runs.driver import Driver
from stereo_ore.runs.frame_files import FrameFiles
from stereo_ore.runs.history import Watch
from stereo_ore.types import Site

COMMAND = [sys.executable, "-c", "from stereo_ore.cli import launch; launch()", "serve"]


def invoke(*arguments: object) -> Any:
    load_verbs()
    return CliRunner().invoke(app, ["serve", *map(str, arguments)])


def test_frames_copied_in_come_out_as_records_and_targets(synth_folder, tmp_path):
    inbox, out = tmp_path / "in", tmp_path / "out"
    inbox.mkdir()
    options = [
        f"--{name}={synth_folder / file}"
        for name, file in (("calib", "calibration.yaml"), ("site", "site.yaml"))
    ]
    options += ["--set=health.refuse_frozen=false", f"--out={out}", "--valid-for=60"]
    arguments = [*COMMAND, "--watch", str(inbox), *options, "--tcp=0", "--page=0"]

    def serve(frames: range) -> list[dict[str, Any]]:
        """Messages that a consumer got while the frames were copied in."""
        with subprocess.Popen(arguments, stderr=subprocess.PIPE, text=True) as process:
            port = next(
                int(line.rpartition(":")[2]) for line in process.stderr if line.startswith("TCP")
            )
            threading.Thread(target=process.stderr.read, daemon=True).start()
            with (
                socket.create_connection(("127.0.0.1", port), timeout=60) as consumer,
                consumer.makefile() as lines,
            ):
                for index in frames:
                    for side in ("left", "right"):
                        data = (synth_folder / f"{side}.png").read_bytes()
                        (inbox / f"{side}{index:03d}.png").write_bytes(
                            data if index != 1 else data[:5000]
                        )
                wait_for(
                    lambda: len(names_in(out / "frames.jsonl.part")) == frames.stop, 60, "records"
                )
                process.send_signal(signal.SIGTERM)
                received = [json.loads(line) for line in lines]
            assert process.wait(30) == 0
        return [message for message in received if message["schema"] == "stereo_ore/targets/1"]

    first = serve(range(1))
    # The second start finds the run finished, and goes on in it; a damaged frame between good ones
    # is waited for, holds up nobody, and is recorded.
    second = serve(range(1, 3))
    records = [json.loads(line) for line in (out / "frames.jsonl").read_text().splitlines()]
    assert [(record["frame"], record["index"]) for record in records] == [
        ("000", 0),
        ("002", 1),
        ("001", 2),
    ]
    assert [record["status"] for record in records] == ["ok", "ok", "failed"]
    assert (out / "overlays" / "002.png").is_file()
    good, stopped = first
    assert [target["id"] for target in good["targets"]] == records[0]["targets"]
    strikes = {ore["id"]: ore["strike"] for ore in records[0]["ores"]}
    for target in good["targets"]:
        assert target["position_m"] == strikes[target["id"]]["point"]["arm"]
    assert (stopped["status"], stopped["valid"]) == ("stopped", False)
    by_frame = {message["frame"]: message for message in second}
    assert not by_frame["001"]["valid"]
    assert by_frame["001"]["reasons"] == ["TRUNCATED_IMAGE"]
    assert by_frame["002"]["targets"] == [{**target} for target in good["targets"]]


def test_a_recording_is_served_to_its_end(tmp_path):
    recording = tmp_path / "recording"
    recording.mkdir()
    for index in range(5):
        cv2.imwrite(str(recording / f"frame{index}.png"), np.full((8, 16, 3), index, np.uint8))
    sink = ListSink()
    with running(ReplayedRecording(open_source(recording)), tmp_path / "out", [sink]):
        wait_for(lambda: len(sink.messages) == 5)
    assert names_in(tmp_path / "out" / "frames.jsonl") == [f"frame{index}" for index in range(5)]


def test_a_fault_of_ours_is_a_failed_frame_and_no_end(tmp_path):
    frame = LiveFrame("f", 0, 0, (), lambda: 1 / 0)

    class Chain:
        site = Site()

    driver = Driver(Chain(), FrameFiles(tmp_path), unattended=True)
    record = json.loads(processing(driver, Watch(Config()))(frame).lines.record)
    assert (record["status"], record["reasons"][0]["code"], record["targets"]) == (
        "failed",
        "INTERNAL_ERROR",
        [],
    )


class Playback:
    """A recorded stand-in for a UVC camera: a side-by-side video that ends, as a camera does that
    is unplugged."""

    opened = 0

    def __init__(self, path: Path, allowed: threading.Semaphore) -> None:
        type(self).opened += 1
        self.video, self.allowed = cv2.VideoCapture(str(path)), allowed

    def read(self) -> tuple[bool, Any]:
        self.allowed.acquire(timeout=5)
        return self.video.read()

    def release(self) -> None:
        self.video.release()


@pytest.fixture
def video(tmp_path: Path) -> Path:
    path = tmp_path / "camera.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 15, (128, 48))
    for index in range(10):
        image = np.full((48, 128, 3), 20 * index, np.uint8)
        image[:, 64:] += 10
        writer.write(image)
    writer.release()
    return path


@pytest.fixture
def stop() -> Iterator[threading.Event]:
    stop = threading.Event()
    yield stop
    stop.set()


def test_a_camera_delivers_both_eyes_with_stamps(video, stop):
    allowed = threading.Semaphore(0)
    camera = LiveCamera(lambda: Playback(video, allowed), "camera 0")
    frames = camera.frames(Position(7), stop)
    for number in range(3):
        allowed.release()
        frame = next(frames)
        pair = frame.read()
        assert pair.left.shape == pair.right.shape == (48, 64, 3)
        assert np.abs(pair.left.astype(int) - 20 * number).max() <= 4
        assert np.abs(pair.right.astype(int) - 20 * number - 10).max() <= 4
        assert (frame.index, pair.index, pair.stamp_ns) == (
            7 + number,
            7 + number,
            frame.arrived_ns,
        )
        assert 0 <= frame.age_s < 10
    assert "delivers" in camera.state()


def test_a_slow_reader_gets_the_newest_picture(video, stop):
    allowed = threading.Semaphore(0)
    camera = LiveCamera(lambda: Playback(video, allowed), "camera 0")
    frames = camera.frames(Position(), stop)
    allowed.release()
    next(frames)
    for _ in range(8):
        allowed.release()
    wait_for(lambda: "7 pictures passed over" in camera.state())
    assert np.abs(next(frames).read().left.astype(int) - 160).max() <= 4


def test_a_camera_that_was_unplugged_is_opened_again(video, stop):
    allowed = threading.Semaphore(1000)
    missing = [True, True]

    def open_capture() -> Playback | None:
        return None if missing and missing.pop() else Playback(video, allowed)

    camera = LiveCamera(open_capture, "camera 0", retry_s=0.05)
    before = Playback.opened
    frames = camera.frames(Position(), stop)
    for frame in islice(frames, 3):
        frame.read()
    wait_for(lambda: Playback.opened >= before + 3, what="third opening")


def test_a_picture_that_can_not_be_split_is_a_failed_frame(stop):
    class Odd(Playback):
        def __init__(self) -> None:
            self.left = 1

        def read(self) -> tuple[bool, Any]:
            self.left -= 1
            return self.left == 0, np.zeros((4, 7, 3), np.uint8)

        def release(self) -> None:
            pass

    frame = next(LiveCamera(Odd, "camera 0").frames(Position(), stop))
    with pytest.raises(FrameError, match="7 px wide"):
        frame.read()


def test_a_camera_that_is_not_there(monkeypatch):
    monkeypatch.setenv("OPENCV_LOG_LEVEL", "OFF")
    with pytest.raises(SourceError, match="camera 97 can't be opened"):
        open_camera(97, (1280, 720))


@pytest.mark.parametrize(
    "sources", [[], ["--watch", "in", "--camera", "0"], ["x", "--watch", "in"]]
)
def test_one_source_and_one_only(synth_folder, tmp_path, sources):
    result = invoke(
        *sources, "--calib", synth_folder / "calibration.yaml", "--out", tmp_path / "out"
    )
    assert result.exit_code == 2
    assert "give one of" in result.output


def test_an_output_folder_of_another_run_is_refused(synth_folder, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "run.json").write_text('{"digest": "other", "source": "another"}')
    result = invoke(synth_folder, "--calib", synth_folder / "calibration.yaml", "--out", out)
    assert isinstance(result.exception, StereoOreError)
    assert "--overwrite" in str(result.exception)


def test_a_second_serve_of_an_inbox_is_refused(synth_folder, tmp_path):
    (tmp_path / "in").mkdir()
    calib = synth_folder / "calibration.yaml"
    with FolderLock(tmp_path / "in"):
        result = invoke("--watch", tmp_path / "in", "--calib", calib, "--out", tmp_path / "out")
    assert isinstance(result.exception, OutputError)
    assert "in: is in use by another stereo-ore" in str(result.exception)
    assert not (tmp_path / "out").exists()


def test_help_names_every_consumer():
    result = invoke("--help")
    assert result.exit_code == 0
    for option in ("--watch", "--camera", "--opcua", "--mqtt", "--tcp", "--page", "--valid-for"):
        assert option in result.output


@pytest.mark.parametrize(
    ("option", "module", "extra"), [("--opcua", "asyncua", "opcua"), ("--mqtt", "paho", "mqtt")]
)
def test_a_missing_extra_is_named(synth_folder, tmp_path, monkeypatch, option, module, extra):
    for name in [name for name in sys.modules if name.partition(".")[0] == module]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, module, None)
    calib, out = synth_folder / "calibration.yaml", tmp_path / "out"
    result = invoke(synth_folder, "--calib", calib, "--out", out, option, 4840)
    assert f'pip install "stereo-ore[{extra}]"' in str(result.exception)
    assert not out.exists()


class Endless:
    """Frames as fast as they are taken."""

    name = "endless"

    def frames(self, start: Position, stop: threading.Event) -> Iterator[LiveFrame]:
        index = start.index
        while not stop.is_set():
            yield LiveFrame(f"{index:06d}", index, time.time_ns(), (), lambda: None)
            index += 1

    def state(self) -> str:
        return "endless"


def test_a_frame_is_recorded_then_published_and_its_files_come_last(tmp_path):
    order, stop = [], threading.Event()

    class Showing(ListSink):
        def show(self, message: Any, record: Any, age_s: float) -> None:
            order.append(("targets", names_in(tmp_path / "frames.jsonl.part")))

        def show_files(self, record: Any) -> None:
            order.append(("shown", record["frame"]))

    def process(frame: LiveFrame) -> Done:
        stop.set()
        return Done(lines_of(frame), lambda: order.append(("files", frame.name)))

    with LiveFolder(tmp_path, {"source": "endless"}) as folder, Publisher([Showing()], 5) as told:
        status = PlantStatus(Endless(), told, lambda: "")
        assert serve(Endless(), process, folder, told, status, stop) == 1
    assert order == [("targets", ["000000"]), ("files", "000000"), ("shown", "000000")]


def read_all(consumer: socket.socket) -> None:
    with contextlib.suppress(OSError):
        while consumer.recv(1 << 16):
            pass


def used() -> tuple[float, int]:
    """Resident memory [MB] and open handles of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6, len(list(Path("/proc/self/fd").iterdir()))


def serve_20_000(out: Path, found: Any) -> None:
    """Put what is used after each thousand frames into a queue."""
    from stereo_ore.plant.sinks.opcua import OpcUaSink
    from stereo_ore.plant.sinks.tcp import TcpSink

    sinks = [OpcUaSink("127.0.0.1", free_port()), TcpSink("127.0.0.1", 0)]
    with (
        running(Endless(), out, sinks) as (status, _, _),
        socket.create_connection(("127.0.0.1", sinks[1].port)) as consumer,
    ):
        drain = threading.Thread(target=read_all, args=(consumer,))
        drain.start()
        for count in range(1000, 20_001, 1000):
            wait_for(lambda count=count: sum(status.json()["frames"].values()) > count, 600)
            found.put(used())
        consumer.shutdown(socket.SHUT_RDWR)
        drain.join()


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs /proc")
def test_20_000_frames_leave_memory_and_handles_flat(tmp_path):
    """In a process of its own: what other tests have left behind is none of it."""
    pytest.importorskip("asyncua", reason="asyncua is not installed")
    own = multiprocessing.get_context("spawn")
    found = own.Queue()
    process = own.Process(target=serve_20_000, args=(tmp_path / "out", found))
    process.start()
    samples = np.array([found.get(timeout=700) for _ in range(20)])
    process.join(60)
    assert process.exitcode == 0
    memory, handles = samples.T
    # Outboxes and allocators fill up at first; names are remembered until a part is closed. 300
    # bytes a frame that stay would be 3 MB here.
    assert np.median(memory[-5:]) - np.median(memory[4:9]) < 3, memory
    # A file is open now and then when they are counted, early and late alike.
    assert handles[10:].max() <= handles[:10].max(), handles
