"""JSON lines over TCP, with consumers of every kind."""

import json
import socket
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
from live import make_message, wait_for

from stereo_ore.errors import OutputError
from stereo_ore.plant.sinks import tcp
from stereo_ore.plant.sinks.tcp import TcpSink


@pytest.fixture
def sink() -> Iterator[TcpSink]:
    with TcpSink("127.0.0.1", 0) as sink:
        yield sink


class Consumer:
    """Reads lines in the way a client would."""

    def __init__(self, sink: TcpSink) -> None:
        before = sink.state().consumers
        self.connection = socket.create_connection(("127.0.0.1", sink.port), timeout=5)
        self.lines = self.connection.makefile("rb")
        wait_for(lambda: sink.state().consumers > before)

    def read(self) -> dict[str, Any]:
        """The next line that is no heartbeat."""
        while True:
            line = json.loads(self.lines.readline())
            if line["schema"] != "stereo_ore/heartbeat/1":
                return line

    def close(self) -> None:
        self.lines.close()
        self.connection.close()


def test_each_consumer_gets_every_message_in_order(sink):
    consumers = [Consumer(sink), Consumer(sink)]
    received: list[list[int]] = [[], []]

    def read(consumer, numbers):
        numbers.extend(consumer.read()["sequence"] for _ in range(500))

    threads = [
        threading.Thread(target=read, args=pair) for pair in zip(consumers, received, strict=True)
    ]
    for thread in threads:
        thread.start()
    for sequence in range(1, 501):
        sink.publish(make_message(sequence))
        wait_for(lambda sequence=sequence: sink.state().sent >= 2 * (sequence - 30))
    for thread in threads:
        thread.join(10)
    assert received == [list(range(1, 501))] * 2
    for consumer in consumers:
        consumer.close()


def test_a_late_consumer_starts_with_the_latest_message_without_expired_targets(sink):
    sink.publish(make_message(1))
    consumer = Consumer(sink)
    assert consumer.read()["valid"]
    consumer.close()
    sink.publish(make_message(2, valid_for_s=0.05))
    time.sleep(0.1)
    consumer = Consumer(sink)
    late = consumer.read()
    assert (late["sequence"], late["valid"], late["targets"]) == (2, False, [])
    consumer.close()


def test_heartbeats_tell_that_the_program_lives(sink, monkeypatch):
    monkeypatch.setattr(tcp, "TCP_HEARTBEAT_S", 0.05)
    consumer = Consumer(sink)
    lines = [json.loads(consumer.lines.readline()) for _ in range(3)]
    assert [line["schema"] for line in lines] == ["stereo_ore/heartbeat/1"] * 3
    assert lines[2]["time_ns"] > lines[0]["time_ns"]
    consumer.close()


def test_a_consumer_that_reads_nothing_delays_nobody_and_is_cut_off(monkeypatch):
    # Long enough for a reader on a busy machine, far longer than a publisher that does not wait
    # takes.
    monkeypatch.setattr(tcp, "SEND_TIMEOUT_S", 2.0)
    with TcpSink("127.0.0.1", 0) as sink:
        slow = socket.socket()
        slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        slow.connect(("127.0.0.1", sink.port))
        wait_for(lambda: sink.state().consumers == 1)
        good = Consumer(sink)
        numbers: list[int] = []
        count = 4000
        reader = threading.Thread(
            target=lambda: numbers.extend(good.read()["sequence"] for _ in range(count))
        )
        reader.start()
        longest = 0.0
        for sequence in range(1, count + 1):
            made = make_message(sequence, ores=16)
            start = time.perf_counter()
            sink.publish(made)
            longest = max(longest, time.perf_counter() - start)
            if sequence % 20 == 0:
                wait_for(lambda sequence=sequence: len(numbers) >= sequence - 20)
        reader.join(20)
        assert numbers == list(range(1, count + 1))
        assert longest < 1.0, "publishing never waits for a consumer"
        wait_for(lambda: sink.state().consumers == 1, what="cut")
        assert sink.state().dropped > 0
        slow.close()
        good.close()


def test_a_consumer_that_goes_away_may_come_back(sink):
    first = Consumer(sink)
    first.close()

    def gone():
        sink.publish(make_message(1))
        return sink.state().consumers == 0

    wait_for(gone)
    second = Consumer(sink)
    second.read()
    sink.publish(make_message(2))
    assert second.read()["sequence"] == 2
    second.close()


def test_the_last_message_arrives_before_the_end():
    with TcpSink("127.0.0.1", 0) as sink:
        consumer = Consumer(sink)
        sink.publish(make_message(1, status="degraded"))
    assert consumer.read()["sequence"] == 1
    assert consumer.lines.readline() == b""
    consumer.close()


def test_too_many_consumers_are_turned_away(sink):
    consumers = [Consumer(sink) for _ in range(tcp.MAX_CONSUMERS)]
    extra = socket.create_connection(("127.0.0.1", sink.port), timeout=5)
    assert extra.recv(1) == b""
    for consumer in consumers:
        consumer.close()
    extra.close()


def test_a_consumer_that_hangs_gives_its_place_to_one_that_waits(sink, monkeypatch):
    monkeypatch.setattr(tcp, "MAX_CONSUMERS", 2)
    monkeypatch.setattr(tcp, "HANGING_S", 1.5)
    monkeypatch.setattr(tcp, "SEND_TIMEOUT_S", 60.0)
    hangs = socket.socket()
    hangs.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    hangs.connect(("127.0.0.1", sink.port))
    wait_for(lambda: sink.state().consumers == 1)
    good = Consumer(sink)
    stop = threading.Event()

    def read() -> None:
        while not stop.is_set():
            good.lines.readline()

    reader = threading.Thread(target=read)
    reader.start()
    # More than the system's buffers take, so that the hanging consumer's thread waits.
    for sequence in range(1, 2001):
        sink.publish(make_message(sequence, ores=16))
        time.sleep(0.001)
    time.sleep(2.0)
    waits = socket.create_connection(("127.0.0.1", sink.port), timeout=5)
    assert json.loads(waits.makefile("rb").readline())["schema"] == "stereo_ore/targets/1"
    assert sink.state().consumers == 2
    refused = socket.create_connection(("127.0.0.1", sink.port), timeout=5)
    assert refused.recv(1) == b"", "nobody hangs any more: who comes now is turned away"
    stop.set()
    reader.join(5)
    for connection in (hangs, waits, refused):
        connection.close()
    good.close()


def test_a_port_in_use_is_an_error_that_says_so(sink):
    with (
        pytest.raises(OutputError, match=rf"127\.0\.0\.1:{sink.port}.*another program"),
        TcpSink("127.0.0.1", sink.port),
    ):
        pass
