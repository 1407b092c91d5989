"""ROS 2, live: a driver, the program and a listener, each a process of its own, on this machine
only."""

import hashlib
import importlib.util
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from live import names_in, wait_for
from ros2_driver_plan import START, STEP

from stereo_ore.io.ros_frame import x_along

if importlib.util.find_spec("rclpy") is None:
    pytest.skip(
        "rclpy is not installed: the extra [ros2], Linux x86-64, Python 3.11 to 3.13",
        allow_module_level=True,
    )

TESTS = Path(__file__).parent
COMMAND = [sys.executable, "-m", "stereo_ore"]
ENVIRONMENT = {
    **os.environ,
    "ROS_DOMAIN_ID": str(10 + os.getpid() % 90),
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    "PYTHONPATH": os.pathsep.join([str(TESTS), str(TESTS.parent)]),
    "FASTRTPS_DEFAULT_PROFILES_FILE": str(TESTS.parent / "docs/ros2/fastdds.xml"),
    "OMP_NUM_THREADS": "1",
}
VALID_FOR_S = 30.0
GONE_S = 2.5
"""A listener knows after this time that the program is gone, on a busy machine too."""
WAIT_S = 120.0


@dataclass
class Process:
    """A running process and the lines that it has written so far."""

    popen: subprocess.Popen[str]
    lines: list[str] = field(default_factory=list)
    objects: list[dict[str, Any]] = field(default_factory=list)

    def wait_line(self, word: str, timeout_s: float = WAIT_S) -> None:
        wait_for(lambda: any(word in line for line in self.lines), timeout_s, f"{word!r}")

    def json(self) -> list[dict[str, Any]]:
        return list(self.objects)

    def read(self, stream: Any) -> None:
        for line in stream:
            if line.startswith("{"):
                self.objects.append(json.loads(line))
            self.lines.append(line.rstrip("\n"))


@contextmanager
def process(*command: object, stderr: bool = False) -> Iterator[Process]:
    """Start it; whatever happens it is gone at the end."""
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stdin": subprocess.PIPE, "text": True}
    if stderr:
        pipes["stderr"] = subprocess.PIPE
    with subprocess.Popen([*map(str, command)], env=ENVIRONMENT, **pipes) as popen:
        running = Process(popen)
        readers = [
            threading.Thread(target=running.read, args=(stream,), daemon=True)
            for stream in (popen.stdout, popen.stderr)
            if stream
        ]
        for reader in readers:
            reader.start()
        try:
            yield running
        finally:
            popen.kill()
            for reader in readers:
                reader.join(5)


@contextmanager
def driver(scene: Path, **plan: Any) -> Iterator[Process]:
    files = [scene / "left.png", scene / "right.png", scene / "calibration.yaml"]
    with process(sys.executable, TESTS / "ros2_driver.py", *files, json.dumps(plan)) as running:
        yield running


@contextmanager
def listener(*topics: str, seconds: float = 240) -> Iterator[Process]:
    program = TESTS / "ros2_listener.py"
    with process(sys.executable, program, "stereo_ore", seconds, *topics) as running:
        yield running


# --- the whole program


@dataclass(frozen=True)
class Served:
    """What a run of three frames wrote and said; killed at `killed_s`, after the last of them."""

    out: Path
    heard: list[dict[str, Any]]
    late: list[dict[str, Any]]
    killed_s: float
    told: list[str]

    def of(self, topic: str, late: bool = False) -> list[dict[str, Any]]:
        return [m for m in (self.late if late else self.heard) if m["topic"] == topic]


@pytest.fixture(scope="module")
def served(synth_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Served:
    """A driver's frames through `serve --ros2 --ros2-out`, one listener from the start and one that
    comes after the last frame; then the program is killed."""
    out = tmp_path_factory.mktemp("ros2") / "out"
    options = ["--site", synth_folder / "site.yaml", "--out", out, "--valid-for", VALID_FOR_S]
    options += ["--set", "health.refuse_frozen=false"]
    with (
        # A PNG is smaller than what the middleware buffers: none is lost on a busy machine.
        driver(
            synth_folder, count=3, period_s=1.5, vary=False, encoding="png", linger_s=240
        ) as camera,
        listener() as early,
        process(*COMMAND, "serve", "--ros2", "--ros2-out", *options, stderr=True) as program,
    ):
        camera.wait_line("done", 2 * WAIT_S)
        newest = START + 2 * STEP

        def shown() -> bool:
            pictures = (m for m in early.json() if m["topic"] == "overlay/compressed")
            return any(picture["stamp"] == newest for picture in pictures)

        wait_for(shown, WAIT_S, "overlay of the last frame")
        with listener() as late:
            latest = {"lumps", "cloud", "overlay/compressed", "camera_info", "/diagnostics"}
            wait_for(lambda: {m["topic"] for m in late.json()} >= latest, WAIT_S, "the latest")
            program.popen.send_signal(signal.SIGKILL)
            killed_s = time.monotonic()
            time.sleep(GONE_S)
            return Served(out, early.json(), late.json(), killed_s, list(program.lines))


@pytest.fixture(scope="module")
def on_files(served: Served, synth_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The frames that were not passed over, from files that are named by the same stamps."""
    folder = tmp_path_factory.mktemp("files")
    for eye in ("left", "right"):
        (folder / "in" / eye).mkdir(parents=True)
        data = (synth_folder / f"{eye}.png").read_bytes()
        for line in processed(served):
            (folder / "in" / eye / f"{json.loads(line)['frame']}.png").write_bytes(data)
    options = [f"--{name}={synth_folder / file}" for name, file in
               (("calib", "calibration.yaml"), ("site", "site.yaml"))]  # fmt: skip
    command = [*COMMAND, "run", folder / "in", *options, "--set", "health.refuse_frozen=false"]
    command += ["--no-report", "--out", folder / "out"]
    subprocess.run([*map(str, command)], env=ENVIRONMENT, check=True, capture_output=True)
    return folder / "out"


def processed(served: Served) -> list[str]:
    """Lines of the frames that were not passed over."""
    lines = (served.out / "frames.jsonl.part").read_text().splitlines()
    return [line for line in lines if json.loads(line)["status"] == "ok"]


def test_frames_of_a_driver_give_what_run_gives_on_the_files(
    served: Served, on_files: Path
) -> None:
    expected = {
        json.loads(line)["frame"]: line
        for line in (on_files / "frames.jsonl").read_text().splitlines()
    }
    lines = processed(served)
    assert lines
    for number, line in enumerate(lines):
        record = json.loads(line)
        name = record["frame"]
        # One that was passed over has a number too.
        line = line.replace(f'"index":{record["index"]},', f'"index":{number},', 1)
        assert line.replace('"header"', '"file name"') == expected[name]
        for file in (f"clouds/{name}.ply", f"overlays/{name}.png"):
            assert (served.out / file).read_bytes() == (on_files / file).read_bytes()


def test_what_is_not_processed_is_recorded_by_name(served: Served) -> None:
    names = names_in(served.out / "frames.jsonl.part")
    assert names == [str(START + number * STEP) for number in range(3)]


def test_targets_are_those_of_the_record_in_both_frames(served: Served) -> None:
    record = json.loads(processed(served)[-1])
    plans = {ore["id"]: ore["strike"] for ore in record["ores"]}
    assert record["targets"]
    for topic, base, frame in (
        ("targets", "arm", "arm_base_link"),
        ("targets_camera", "camera", "camera_left_optical_frame"),
    ):
        (message,) = (m for m in served.of(topic) if m["stamp"] == record["stamp_ns"])
        assert message["frame"] == frame
        for pose, id in zip(message["data"], record["targets"], strict=True):
            assert pose[:3] == plans[id]["point"][base]
            x, y, z, w = pose[3:]
            ahead = [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]
            np.testing.assert_allclose(ahead, plans[id]["direction"][base], atol=1e-6)


def test_a_cloud_is_that_of_the_file(served: Served) -> None:
    from stereo_ore.io import clouds

    message = served.of("cloud")[-1]
    cloud = clouds.read(served.out / "clouds" / f"{message['stamp']}.ply")
    fields = [(name, 7) for name in ("x", "y", "z", "rgb")] + [("ore_id", 5), ("score", 7)]
    assert [(name, kind) for name, _, kind in message["data"]["fields"]] == fields
    columns = [("xyz", "<f4", 3), ("rgb", "<u4"), ("ore_id", "<i4"), ("score", "<f4")]
    table = np.zeros(len(cloud), columns)
    table["xyz"] = np.stack([cloud[axis] for axis in "xyz"], 1)
    red, green, blue = (cloud[name].astype(int) for name in ("red", "green", "blue"))
    table["rgb"] = red * 65536 + green * 256 + blue
    table["ore_id"], table["score"] = cloud["ore_id"], cloud["score"]
    assert message["data"]["points"] == len(cloud) > 1000
    assert message["data"]["sha256"] == hashlib.sha256(table.tobytes()).hexdigest()


def test_lumps_labels_screen_and_strikes_are_markers_that_fade(served: Served) -> None:
    record = json.loads(processed(served)[-1])
    lumps, strikes = served.of("lumps")[-1]["data"], served.of("strikes")
    kinds = Counter(marker["ns"] for marker in lumps)
    assert kinds == {
        "": 1,
        "screen": 1,
        "lumps": len(record["ores"]),
        "labels": len(record["ores"]),
    }
    assert (lumps[0]["action"], {marker["action"] for marker in lumps[1:]}) == (3, {0})
    assert {marker["lifetime_s"] for marker in lumps[1:]} == {VALID_FOR_S}
    boxes = {marker["id"]: marker for marker in lumps if marker["ns"] == "lumps"}
    for ore in record["ores"]:
        assert boxes[ore["id"]]["position"] == ore["box"]["camera"]["centre"]
        assert boxes[ore["id"]]["scale"] == ore["box"]["extent_m"]
    (screen,) = (marker for marker in lumps if marker["ns"] == "screen")
    heights = (
        np.array(screen["points"]) @ record["grizzly"]["normal"] - record["grizzly"]["offset_m"]
    )
    assert len(heights) == 6
    assert np.abs(heights).max() < 1e-9
    arrows = next(m["data"] for m in reversed(strikes) if m["stamp"] == record["stamp_ns"])[1:]
    assert [marker["ns"] for marker in arrows] == ["strikes"] * len(record["targets"])
    plans = {ore["id"]: ore["strike"] for ore in record["ores"]}
    for arrow, id in zip(arrows, record["targets"], strict=True):
        assert 0 < arrow["lifetime_s"] < VALID_FOR_S
        way = np.array(plans[id]["direction"]["camera"])
        tip = np.array(arrow["position"]) + arrow["scale"][0] * x_along(way)[:, 0]
        np.testing.assert_allclose(tip, plans[id]["point"]["camera"], atol=1e-6)


def test_overlay_camera_info_and_diagnostics(served: Served) -> None:
    name = json.loads(processed(served)[-1])["frame"]
    overlay, info = served.of("overlay/compressed")[-1], served.of("camera_info")[-1]
    picture = (served.out / "overlays" / f"{name}.png").read_bytes()
    assert overlay["data"] == ["png", hashlib.sha256(picture).hexdigest()]
    assert info["stamp"] == overlay["stamp"] == int(name)
    assert info["data"][:2] == [672, 376]
    assert info["data"][2][0] == info["data"][3][0] > 0
    told = served.of("/diagnostics")[-1]["data"]
    assert (told["name"], told["frame"], told["session"] != "") == (
        "stereo_ore: targets",
        name,
        True,
    )
    assert any(float(m["data"]["latency_ms"] or 0) > 0 for m in served.of("/diagnostics"))
    ok = next(m["data"] for m in served.of("/diagnostics") if m["data"]["valid"] == "true")
    assert (ok["level"], ok["status"]) == (0, "ok")


def test_a_late_listener_has_the_latest_of_all(served: Served) -> None:
    newest = json.loads(processed(served)[-1])["stamp_ns"]
    for topic in ("lumps", "cloud", "overlay/compressed", "camera_info"):
        (message,) = served.of(topic, late=True)
        assert message["stamp"] == newest
    told = {m["data"]["frame"] for m in served.of("/diagnostics", late=True)}
    assert told == {str(newest)}


def test_targets_vanish_when_the_program_is_killed(served: Served) -> None:
    """Liveliness within its lease, arrows by their lifetime: both before targets would expire."""
    for late in (False, True):
        gone = [m for m in served.of("liveliness", late) if m["alive"] == 0]
        assert len(gone) == 1
        assert 0 < gone[0]["at"] - served.killed_s < GONE_S
    for message in served.of("strikes"):
        for marker in message["data"][1:]:
            assert message["came"] + marker["lifetime_s"] < served.killed_s + VALID_FOR_S


def test_the_way_to_a_static_transform_is_told(served: Served) -> None:
    (line,) = (line for line in served.told if "static_transform_publisher" in line)
    assert line.endswith("--frame-id arm_base_link --child-frame-id camera_left_optical_frame")


def test_a_replay_publishes_the_same_and_withdraws_it_at_the_end(served: Served) -> None:
    topics = ("targets", "cloud", "/diagnostics")
    # Long enough for the two to discover each other.
    command = [*COMMAND, "replay", served.out, "--rate", 0.5, "--valid-for", 2, "--ros2-out"]
    with listener(*topics) as heard:
        heard.wait_line('"up"')
        with process(*command):
            wait_for(lambda: any("stopped" in line for line in heard.lines), WAIT_S, "the end")
        messages = heard.json()
    clouds = {m["stamp"]: m["data"] for m in messages if m["topic"] == "cloud"}
    # Of clouds that follow each other at once a listener may get the last alone.
    last = served.of("cloud")[-1]
    assert clouds[last["stamp"]] == last["data"]
    found = [m["data"] for m in messages if m["topic"] == "targets"]
    assert any(found)
    assert found[-1] == []
    assert {m["data"]["replay"] for m in messages if m["topic"] == "/diagnostics"} == {"true"}


# --- a driver that misbehaves, with a stub in place of the chain


def topics_of(prefix: str) -> list[str]:
    return [f"{prefix}/{eye}/image_rect" for eye in ("left", "right")]


def records(out: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (out / "frames.jsonl").read_text().splitlines()]


def code_of(record: dict[str, Any]) -> str:
    return record["reasons"][0]["code"] if record["reasons"] else "ok"


def test_eyes_that_drop_a_clock_that_jumps_and_a_driver_that_dies(
    synth_folder: Path, tmp_path: Path
) -> None:
    prefix, back = "/odd", -3_600_000_000_000
    plan = {"count": 20, "period_s": 0.15, "drop_left": [3, 4], "drop_right": [6], "prefix": prefix}
    plan |= {"jump": [9, back], "kill_at": 12, "encoding": "png"}
    again = {"count": 3, "period_s": 0.2, "prefix": prefix, "encoding": "png"}
    again["start_ns"] = START + 1000 * STEP
    topics = [f"{topic}/compressed" for topic in topics_of(prefix)]
    command = [sys.executable, TESTS / "ros2_server.py", *topics, tmp_path / "out", 0]
    with process(*command) as server:
        with driver(synth_folder, **plan) as camera:
            assert camera.popen.wait(WAIT_S) == -signal.SIGKILL
        with driver(synth_folder, **again) as camera:
            camera.wait_line("done")
            wait_for(
                lambda: (
                    str(START + 1002 * STEP) in names_in(tmp_path / "out" / "frames.jsonl.part")
                ),
                WAIT_S,
            )
        server.popen.stdin.close()
        assert server.popen.wait(WAIT_S) == 0
    found = records(tmp_path / "out")
    codes = {record["frame"].partition("_")[0]: code_of(record) for record in found}
    stamps = [START + n * STEP + (back if n >= 9 else 0) for n in range(13)]
    lonely = {3, 4, 6, 12}
    for number, stamp in enumerate(stamps):
        expected = {"UNPAIRED"} if number in lonely else {"ok", "OVERTAKEN"}
        assert codes[str(stamp)] in expected, number
    for number in range(3):
        assert codes[str(again["start_ns"] + number * STEP)] in {"ok", "OVERTAKEN"}
    assert len(found) == 16
    assert len({record["frame"] for record in found}) == 16


def flood(scene: Path, out: Path, count: int, work_s: float) -> tuple[list[Any], dict[str, Any]]:
    """Frames at twice the rate at which they are worked on."""
    topics = topics_of("/flood")
    plan = {"count": count, "period_s": work_s / 2, "prefix": "/flood", "info": False}
    with process(sys.executable, TESTS / "ros2_server.py", *topics, out, work_s) as server:
        with driver(scene, **plan) as camera:
            camera.wait_line("done", WAIT_S + 5 * count * work_s)
            time.sleep(1.0)
        server.popen.stdin.close()
        assert server.popen.wait(WAIT_S) == 0
        (about,) = server.json()
    return records(out), about


def accounted(found: list[Any], count: int) -> Counter[str]:
    """Frames by what became of them; each that was sent is in one record."""
    codes = Counter(map(code_of, found))
    lost = sum(
        int(r["reasons"][0]["detail"].split(": ")[1].split()[0])
        for r in found
        if code_of(r) == "NEVER_CAME"
    )
    numbers = {
        (int(r["frame"].partition("_")[0]) - START) // STEP
        for r in found
        if code_of(r) != "NEVER_CAME"
    }
    assert numbers <= set(range(count))
    assert len(numbers) + lost == count, (codes, sorted(set(range(count)) - numbers))
    return codes


def test_frames_at_twice_the_rate_are_processed_or_recorded_as_passed_over(
    synth_folder: Path, tmp_path: Path
) -> None:
    found, about = flood(synth_folder, tmp_path / "out", 60, 0.06)
    codes = accounted(found, 60)
    assert codes["ok"] >= 10
    assert np.median(about["newer"]) <= 2


@pytest.mark.slow
def test_of_300_frames_at_twice_the_rate_none_is_lost_without_a_record(
    synth_folder: Path, tmp_path: Path
) -> None:
    work_s = 0.3
    found, about = flood(synth_folder, tmp_path / "out", 300, work_s)
    codes = accounted(found, 300)
    assert codes["ok"] >= 100
    assert np.median(about["ages_s"]) < 1.5 * work_s
    assert np.percentile(about["ages_s"], 99) < 2 * work_s


@pytest.mark.slow
def test_2000_frames_take_no_more_memory_than_200(synth_folder: Path, tmp_path: Path) -> None:
    small = tmp_path / "small"
    small.mkdir()
    for eye in ("left", "right"):
        image = cv2.imread(str(synth_folder / f"{eye}.png"))
        cv2.imwrite(str(small / f"{eye}.png"), cv2.resize(image, None, fx=0.4, fy=0.4))
    shutil.copy(synth_folder / "calibration.yaml", small)
    found, about = flood(small, tmp_path / "out", 2000, 0.04)
    accounted(found, 2000)
    memory = about["memory_kb"]
    assert len(memory) >= 5
    assert max(memory[1:]) - memory[1] < 20_000, memory
