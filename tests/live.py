"""What the tests of live operation share: records, messages, ports, waiting, and a server in a
process of its own.

Run as a program it serves a folder with a stub in place of the chain: ``python live.py WATCH OUT
[--opcua PORT]``."""

import argparse
import json
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from stereo_ore.errors import FrameError
from stereo_ore.plant.frames import LiveFrame
from stereo_ore.plant.live_folder import LiveFolder
from stereo_ore.plant.loop import Done, serve
from stereo_ore.plant.publisher import Publisher
from stereo_ore.plant.sinks.message import Message, Origin, message
from stereo_ore.plant.status import PlantStatus
from stereo_ore.plant.watch import FolderWatch
from stereo_ore.runs.folder import FrameLines


def make_ore(id: int, index: int = 0) -> dict[str, Any]:
    """An ore whose strike and size tell the frame it belongs to."""
    point = {"camera": [0.0, 0.0, 2.0], "arm": [float(index), float(id), 0.5]}
    direction = {"camera": [0.0, 0.0, 1.0], "arm": [0.0, 0.0, -1.0]}
    size = [float(index), 0.3, 0.2]
    return {
        "id": id,
        "points": 800,
        "pixels": 9000,
        "cut": False,
        "surface_centroid": point,
        "centre_of_gravity": point | {"sigma_m": [0.01, 0.01, 0.02], "method": "test"},
        "volume_m3": 0.02,
        "volume_bounds_m3": [0.01, 0.03],
        "size_m": size,
        "box": {
            "camera": {"centre": [0, 0, 2], "axes": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]},
            "extent_m": size,
        },
        "oversize": True,
        "strike": {
            "point": point,
            "direction": direction,
            "slope_deg": 8.0,
            "flatness_m": 0.003,
            "score": 0.9,
            "alternates": [],
        },
        "reasons": [],
    }


def make_record(
    index: int = 0, ores: int = 2, status: str = "ok", arm: bool = True, **changes: Any
) -> dict[str, Any]:
    """A record of a frame with its targets."""
    targets = list(range(1, ores + 1)) if status == "ok" else []
    counts = dict.fromkeys(("pixels", "disparities", "points", "voxels", "kept"), 1000)
    return {
        "schema": "stereo_ore/frame/1",
        "frame": f"{index:06d}",
        "index": index,
        "stamp_ns": None,
        "status": status,
        "reasons": [] if status == "ok" else [{"code": "FEW_DISPARITIES", "detail": "for a test"}],
        "units": "m",
        "camera_frame": "left_rectified",
        "arm_frame": "arm" if arm else None,
        "counts": counts | {"ores": ores, "targets": len(targets)},
        "grizzly": None,
        "ores": [make_ore(id, index) for id in range(1, ores + 1)],
        "targets": targets,
    } | changes


def make_message(sequence: int = 1, valid_for_s: float = 60.0, **record: Any) -> Message:
    """The message of a fresh record whose index is its sequence number."""
    record = {"index": sequence, **record}
    return message(
        make_record(**record), sequence, Origin("test"), age_s=0.0, valid_for_s=valid_for_s
    )


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


def wait_for(
    condition: Callable[[], object], timeout_s: float = 60.0, what: str = "condition"
) -> None:
    end = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end, f"no {what} within {timeout_s} s"
        time.sleep(0.01)


def names_in(file: Path) -> list[str]:
    """Names of the frames in a file of lines, up to the last whole line."""
    if not file.exists():
        return []
    lines = file.read_text().splitlines(keepends=True)
    return [json.loads(line)["frame"] for line in lines if line.endswith("\n")]


class ListSink:
    """Keeps what it is given, and when."""

    def __init__(self) -> None:
        self.messages: list[tuple[float, Message]] = []

    def __enter__(self) -> "ListSink":
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def publish(self, message: Message) -> None:
        self.messages.append((time.monotonic(), message))

    def state(self) -> Any:
        from stereo_ore.plant.sinks.base import SinkState

        return SinkState("list", "here", True, 1, len(self.messages), 0)


def lines_of(frame: LiveFrame, **record: Any) -> FrameLines:
    """What the stub makes of a frame: a failed record when it can't be read."""
    try:
        frame.read()
        made = make_record(frame.index, frame=frame.name, **record)
    except FrameError as error:
        reasons = [{"code": error.code, "detail": str(error)}]
        made = make_record(frame.index, frame=frame.name, status="failed", reasons=reasons)
    entry = json.dumps({"frame": frame.name})
    return FrameLines(json.dumps(made), entry, entry)


@contextmanager
def running(
    source: Any, out: Path, sinks: list[Any], valid_for_s: float = 5.0, **record: Any
) -> Iterator[Any]:
    """A live run with the stub in a thread; gives its status, publisher and stop event; finished at
    the end."""
    stop = threading.Event()
    with LiveFolder(out, {"source": source.name}) as folder:
        with Publisher(sinks, valid_for_s) as publisher:
            status = PlantStatus(source, publisher, lambda: folder.alarm)
            arguments = (
                source,
                lambda frame: Done(lines_of(frame, **record)),
                folder,
                publisher,
                status,
                stop,
            )
            thread = threading.Thread(target=serve, args=arguments)
            thread.start()
            try:
                yield status, publisher, stop
            finally:
                stop.set()
                thread.join(10)
        folder.finish()


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("watch", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--opcua", type=int)
    arguments = parser.parse_args()
    done = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: done.set())
    sinks: list[Any] = []
    if arguments.opcua:
        from stereo_ore.plant.sinks.opcua import OpcUaSink

        sinks.append(OpcUaSink("127.0.0.1", arguments.opcua))
    with running(
        FolderWatch(arguments.watch, poll_s=0.02, patience_s=20),
        arguments.out,
        sinks,
        valid_for_s=2.0,
    ):
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        done.wait()


if __name__ == "__main__":
    main()
