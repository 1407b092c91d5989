"""20,000 frames through `serve` at 100 a second: memory and handles flat, clock stamps without
drift, latency stable.

Run as a program this file is the OPC UA client: it subscribes, and prints a line of JSON a message.
"""

import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from live import free_port, running, wait_for

from stereo_ore.plant.frames import LiveFrame, Position

FRAMES, RATE_HZ, VALID_FOR_S = 20_000, 100, 5.0
WARM = 2_000
"""Frames after which nothing is new any more."""


class Paced:
    """Frames at a steady rate; one that is late does not delay those behind it."""

    name = "paced"

    def __init__(self, go: threading.Event) -> None:
        self.go = go

    def frames(self, start: Position, stop: threading.Event) -> Iterator[LiveFrame]:
        self.go.wait()
        begin = time.monotonic()
        for index in range(start.index, FRAMES):
            stop.wait(max(0.0, begin + index / RATE_HZ - time.monotonic()))
            if stop.is_set():
                return
            yield LiveFrame(f"{index:06d}", index, time.time_ns(), (), lambda: None)
        stop.wait()

    def state(self) -> str:
        return "paced"


def used() -> tuple[float, int, int]:
    """Resident memory [MB], open handles and threads of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    handles = len(list(Path("/proc/self/fd").iterdir()))
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6, handles, threading.active_count()


def receive(port: int, rows: Any) -> None:
    """Sequence, index, both stamps and time of arrival [ns] of every message that a TCP consumer
    gets, by index."""
    with (
        socket.create_connection(("127.0.0.1", port)) as connection,
        connection.makefile("rb") as lines,
    ):
        for line in lines:
            now = time.time_ns()
            message = json.loads(line)
            if message.get("index") is not None:
                times = message["published_ns"], message["valid_until_ns"], now
                rows[message["index"]] = message["sequence"], message["index"], *times
            if message.get("status") == "stopped":
                return


def quarters(values: Any) -> list[float]:
    """Medians of the four quarters."""
    return [round(float(np.median(part)), 2) for part in np.array_split(values, 4)]


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs /proc")
def test_20_000_frames_at_100_a_second(tmp_path: Path) -> None:
    pytest.importorskip("asyncua", reason="asyncua is not installed")
    from stereo_ore.plant.sinks.opcua import OpcUaSink
    from stereo_ore.plant.sinks.tcp import TcpSink

    opcua, tcp = OpcUaSink("127.0.0.1", free_port()), TcpSink("127.0.0.1", 0)
    rows = np.full(
        (FRAMES, 5), -1, np.int64
    )  # all of it at once: a list that grows would look like a leak
    samples: list[tuple[float, int, int]] = []
    go = threading.Event()
    with running(Paced(go), tmp_path / "out", [opcua, tcp], VALID_FOR_S) as (status, _, _):
        reader = threading.Thread(target=receive, args=(tcp.port, rows))
        reader.start()
        command = [sys.executable, __file__, opcua.url]
        with (
            (tmp_path / "seen").open("w") as file,
            subprocess.Popen(command, stdout=file) as client,
        ):

            def done() -> int:
                return sum(status.json()["frames"].values())

            wait_for((tmp_path / "seen").read_text, what="client")
            go.set()

            for count in range(WARM, FRAMES + 1, 1000):
                wait_for(lambda count=count: done() >= count, 600, what=f"frame {count}")
                samples.append(used())
            wait_for(
                lambda: opcua.state().sent + opcua.state().dropped >= FRAMES,
                60,
                what="last message",
            )
            dropped = opcua.state().dropped + tcp.state().dropped
            time.sleep(1)
            client.terminate()
        seen = [
            json.loads(line)
            for line in (tmp_path / "seen").read_text().splitlines()
            if line[0] == "["
        ]
    reader.join(20)
    judge(rows[rows[:, 0] >= 0], np.array(seen), np.array(samples), dropped)


def judge(rows: Any, seen: Any, samples: Any, dropped: int) -> None:
    """Print the figures, then hold them against what is wanted."""
    sequence, index, published, until, arrived = rows.T
    seen = seen[seen[:, 0] > 0]  # number 0 was there before the client
    tcp_ms, opcua_ms = (arrived - published) / 1e6, seen[:, 1]
    # Against the frame's place in time: what is late now and then is load, what is late by and by
    # is drift.
    late_ms = ((published - published[0]) - (index - index[0]) * 1e9 / RATE_HZ) / 1e6
    drift_ms = [round(float(np.quantile(part, 0.1)), 2) for part in np.array_split(late_ms, 4)]
    held_s = (until - published) / 1e9
    figures = {
        "messages TCP": len(rows),
        "messages OPC UA": len(seen),
        "dropped": dropped,
        "memory MB": [
            round(float(value), 1) for value in (samples[0, 0], samples[-1, 0], samples[:, 0].max())
        ],
        "handles": sorted(set(samples[:, 1].astype(int).tolist())),
        "threads": sorted(set(samples[:, 2].astype(int).tolist())),
        "TCP ms by quarter": quarters(tcp_ms),
        "TCP ms 99 %, max": [
            round(float(value), 1) for value in (np.quantile(tcp_ms, 0.99), tcp_ms.max())
        ],
        "OPC UA ms by quarter": quarters(opcua_ms),
        "OPC UA ms 99 %, max": [
            round(float(value), 1) for value in (np.quantile(opcua_ms, 0.99), opcua_ms.max())
        ],
        "stamps behind the clock, ms by quarter (10 %)": drift_ms,
        "held s": [round(float(value), 4) for value in (held_s.min(), held_s.max())],
    }
    sys.stdout.write(json.dumps(figures, indent=1) + "\n")
    # A machine too busy to write 100 messages a second drops the oldest, and counts them.
    assert len(rows) + len(seen) + dropped >= 2 * FRAMES
    assert (np.diff(sequence) > 0).all()
    assert (np.diff(seen[:, 0]) > 0).all()
    assert samples[-1, 0] < 1.05 * samples[0, 0]
    assert samples[:, 1].max() <= samples[0, 1]
    assert (
        samples[:, 2].max() <= samples[0, 2] + 2
    )  # the event loop's pool makes its threads as it needs them
    for values in (tcp_ms, opcua_ms):
        first, *_, last = quarters(values)
        assert last < 2 * first + 5
    assert np.ptp(drift_ms) < 20
    assert held_s.max() <= VALID_FOR_S


def client(url: str) -> None:
    """Sequence and latency [ms] of every change of `Sequence`, until terminated."""
    from asyncua.sync import Client

    from stereo_ore.plant.sinks.opcua_model import NAMESPACE

    class Handler:
        def datachange_notification(self, node: Any, value: Any, data: Any) -> None:
            stamp = data.monitored_item.Value.SourceTimestamp.timestamp()
            sys.stdout.write(json.dumps([value, 1000 * (time.time() - stamp)]) + "\n")
            sys.stdout.flush()

    with Client(url) as connection:
        namespace = connection.get_namespace_index(NAMESPACE)
        node = connection.get_node(f"ns={namespace};s=StereoOre.Result.Sequence")
        subscription = connection.create_subscription(20, Handler())
        subscription.subscribe_data_change([node], queuesize=1000)
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        while True:
            time.sleep(1)


if __name__ == "__main__":
    client(sys.argv[1])
