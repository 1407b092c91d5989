"""Targets over Modbus TCP, read by pymodbus's own client and, where it is installed, by Debian's
mbpoll."""

import math
import shutil
import socket
import struct
import subprocess
import threading
import time
from collections.abc import Iterator
from ipaddress import ip_network
from itertools import cycle
from typing import Any

import pytest
from live import free_port, make_message, make_ore, make_record, wait_for

pytest.importorskip("pymodbus", reason="pymodbus is not installed")

from pymodbus.client import ModbusTcpClient

from stereo_ore.errors import OutputError
from stereo_ore.plant.sinks import modbus, supervisor
from stereo_ore.plant.sinks.message import Origin, message, notice
from stereo_ore.plant.sinks.modbus import ModbusSink
from stereo_ore.plant.sinks.modbus_table import (
    HEAD_WORDS,
    MODBUS_SLOTS,
    READABLE_WORDS,
    SLOT_WORDS,
    rows,
    words,
)

ILLEGAL_FUNCTION, ILLEGAL_ADDRESS = 1, 2
MBPOLL = shutil.which("mbpoll")
AT_ONCE = 112
"""Registers of a request that holds the head and the three best targets."""


@pytest.fixture
def sink() -> Iterator[ModbusSink]:
    with ModbusSink("127.0.0.1", free_port(), origin=Origin("s", replay=True)) as sink:
        yield sink


@pytest.fixture
def master(sink: ModbusSink) -> Iterator[ModbusTcpClient]:
    with ModbusTcpClient("127.0.0.1", port=port_of(sink)) as master:
        yield master


def port_of(sink: ModbusSink) -> int:
    return int(sink.address.partition(":")[2])


def entries(registers: list[int]) -> dict[str, Any]:
    """Registers from address 0 on by the names of the documented table."""
    codes = {"uint16": ">H", "uint32": ">I", "int32": ">i", "float32": ">f"}
    data = struct.pack(f">{len(registers)}H", *registers)
    found = {}
    for address, kind, name, *_ in rows():
        if 2 * address + struct.calcsize(codes[kind]) <= len(data):
            found[f"{name}_again" if name in found else name] = struct.unpack_from(
                codes[kind], data, 2 * address
            )[0]
    return found


def read_all(master: ModbusTcpClient, size: int = 125) -> list[int]:
    parts = [
        master.read_holding_registers(start, count=min(size, READABLE_WORDS - start)).registers
        for start in range(0, READABLE_WORDS, size)
    ]
    return [register for part in parts for register in part]


def test_the_table_says_all_about_a_message(sink, master):
    record = make_record(7, ores=2, stamp_ns=5)
    record["ores"][1] |= {
        "oversize": False,
        "volume_m3": None,
        "size_m": None,
        "centre_of_gravity": None,
    }
    sink.publish(message(record, 70_000, Origin("s", replay=True), age_s=0.0, valid_for_s=5.0))
    found = entries(read_all(master))
    head = {
        "version": 1,
        "sequence": 70_000,
        "valid": 1,
        "count": 2,
        "status": 1,
        "frame_index": 7,
        "replay": 1,
    }
    assert {name: found[name] for name in head} == head
    assert 4000 < found["remaining"] <= 5000
    assert found["sequence_again"] == 70_000
    first = {
        name.partition(".")[2]: value
        for name, value in found.items()
        if name.startswith("target_1.")
    }
    assert (first["sequence_low"], first["id"], first["oversize"]) == (70_000 % 2**16, 1, 2)
    numbers = [value for value in first.values() if isinstance(value, float)]
    expected = [7, 1, 0.5, 0, 0, -1, 7, 0.3, 0.2, 0.02, 0.01, 0.01, 0.02, 0.9]
    assert numbers == pytest.approx(expected, rel=1e-7)
    assert (found["target_2.oversize"], found["target_2.position_y"]) == (1, 2.0)
    for name in ("volume", "size_longest", "sigma_x"):
        assert math.isnan(found[f"target_2.{name}"])
    assert (found["target_3.id"], found["target_3.sequence_low"]) == (0, 0)
    assert all(math.isnan(value) for name, value in found.items() if name.startswith("target_16.p"))


def test_input_registers_are_the_same(sink, master):
    sink.publish(make_message(3, status="degraded"))
    same = slice(2, None)
    holding, inputs = (
        read(0, count=AT_ONCE).registers
        for read in (master.read_holding_registers, master.read_input_registers)
    )
    assert holding[same] == inputs[same]


def test_before_the_first_message_and_after_the_last_there_is_no_target(sink, master):
    for status, number in (("starting", 0), ("stopped", 6)):
        if status == "stopped":
            sink.publish(make_message(2))
            sink.publish(notice(3, Origin("s"), "stopped"))
        found = entries(read_all(master))
        assert (found["status"], found["valid"], found["count"], found["remaining"]) == (
            number,
            0,
            0,
            0,
        )
        assert math.isnan(found["target_1.position_x"])
        assert found["frame_index"] == -1


def test_targets_run_out_while_they_are_read(sink, master):
    sink.publish(make_message(1, valid_for_s=2.0))
    seen = []
    while not seen or seen[-1]["valid"]:
        seen.append(entries(master.read_holding_registers(0, count=AT_ONCE).registers))
        time.sleep(0.02)
    left = [found["remaining"] for found in seen]
    assert left == sorted(left, reverse=True)
    assert 0 < left[0] <= 2000
    assert (seen[-1]["count"], seen[-1]["remaining"]) == (0, 0)
    assert math.isnan(seen[-1]["target_1.position_x"])


def test_the_heartbeat_beats_and_rolls_over(sink, master, monkeypatch):
    sink._beats = 2**16 - 2
    beats = set()
    wait_for(
        lambda: (
            beats.add(entries(master.read_holding_registers(0, count=2).registers)["heartbeat"])
            or 1 in beats
        ),
        5,
    )
    assert {2**16 - 1, 0, 1} <= beats


def test_only_the_acknowledgement_can_be_written(sink, master):
    assert master.write_registers(600, [1, 4464, 2]).isError() is False
    wait_for(lambda: "message 70000, ore 2" in sink.state().detail, what="acknowledgement")
    assert master.write_register(602, 5).isError() is False
    assert "ore 5" in sink.state().detail
    for address, values in (
        (0, [9]),
        (4, [1]),
        (5, [60000]),
        (16, [1, 2]),
        (599, [1, 2]),
        (602, [1, 2]),
        (700, [1]),
    ):
        assert master.write_registers(address, values).exception_code == ILLEGAL_ADDRESS
        assert master.write_register(address, values[0]).isError() is (address != 602)
    assert (
        master.mask_write_register(address=4, and_mask=0, or_mask=1).exception_code
        == ILLEGAL_ADDRESS
    )
    assert master.write_coil(600, True).exception_code == ILLEGAL_FUNCTION
    assert master.write_coils(600, [True] * 8).exception_code == ILLEGAL_FUNCTION
    assert master.read_coils(0, count=8).exception_code == ILLEGAL_FUNCTION
    assert entries(read_all(master))["valid"] == 0


def test_what_is_not_there_can_not_be_read(master):
    for address, count in (
        (READABLE_WORDS, 1),
        (READABLE_WORDS - 1, 2),
        (599, 1),
        (603, 1),
        (65535, 1),
    ):
        assert master.read_holding_registers(address, count=count).exception_code == ILLEGAL_ADDRESS


def test_written_and_read_in_one_request(sink, master):
    sink.publish(make_message(9))
    done = master.readwrite_registers(
        read_address=0, read_count=AT_ONCE, write_address=600, values=[0, 9, 1]
    )
    assert entries(done.registers)["sequence"] == 9
    assert "message 9, ore 1" in sink.state().detail


def test_no_request_is_torn_and_a_set_read_in_parts_tells(sink, master):
    stop = threading.Event()
    messages = cycle([make_message(sequence, ores=16) for sequence in range(1, 200)])

    def publish() -> None:
        while not stop.wait(0.01):
            sink.publish(next(messages))

    publisher = threading.Thread(target=publish)
    publisher.start()
    try:
        wait_for(lambda: entries(read_all(master))["sequence"])
        torn, end = 0, time.monotonic() + 3
        while torn == 0 or time.monotonic() < end:
            assert time.monotonic() < end + 20, "or the test shows nothing"
            found = entries(master.read_holding_registers(0, count=AT_ONCE).registers)
            for slot in (1, 2, 3):
                assert found[f"target_{slot}.sequence_low"] == found["sequence"] % 2**16
                assert found[f"target_{slot}.position_x"] == found["sequence"]
            torn += not check_set(entries(read_all(master)))
    finally:
        stop.set()
        publisher.join()
    assert check_set(entries(read_all(master)))


def check_set(found: dict[str, Any]) -> bool:
    """Whether the numbers say that a set is whole; then it must be."""
    slots = range(1, MODBUS_SLOTS + 1)
    lows = {found[f"target_{slot}.sequence_low"] for slot in slots}
    whole = found["sequence"] == found["sequence_again"] and lows == {found["sequence"] % 2**16}
    assert not whole or {found[f"target_{slot}.position_x"] for slot in slots} == {
        found["sequence"]
    }
    return whole


def test_a_server_that_fails_is_an_alarm_and_starts_again(sink, monkeypatch):
    monkeypatch.setattr(supervisor, "RESTART_S", 0.1)
    sink.publish(make_message(4))
    with monkeypatch.context() as broken:
        broken.setattr(modbus, "MODBUS_HEARTBEAT_S", "soon")
        wait_for(lambda: sink.state().alarm, what="alarm")
    wait_for(lambda: not sink.state().alarm, what="restart")
    assert sink.state().restarts >= 1
    with ModbusTcpClient("127.0.0.1", port=port_of(sink)) as master:
        assert entries(master.read_holding_registers(0, count=AT_ONCE).registers)["sequence"] == 4


def test_strangers_and_too_many_are_refused(monkeypatch):
    monkeypatch.setattr(modbus, "MODBUS_CONSUMERS", 2)
    with ModbusSink("127.0.0.1", free_port(), [ip_network("10.1.0.0/16")]) as sink:
        with socket.create_connection(("127.0.0.1", port_of(sink)), timeout=5) as stranger:
            assert refused(stranger)
        assert "1 connections refused" in sink.state().detail
    with ModbusSink("127.0.0.1", free_port(), [ip_network("127.0.0.1/32")]) as sink:
        address = "127.0.0.1", port_of(sink)
        known = [socket.create_connection(address, timeout=5) for _ in range(2)]
        wait_for(lambda: sink.state().consumers == 2)
        with socket.create_connection(address, timeout=5) as third:
            assert refused(third)
        for connection in known:
            connection.close()
        wait_for(lambda: sink.state().consumers == 0)
        with ModbusTcpClient(address[0], port=address[1]) as master:
            assert not master.read_holding_registers(0, count=2).isError()


def test_a_master_that_asks_nothing_gives_its_place_to_one_that_waits(sink, monkeypatch):
    monkeypatch.setattr(modbus, "MODBUS_CONSUMERS", 2)
    monkeypatch.setattr(modbus, "IDLE_S", 1.0)
    address = "127.0.0.1", port_of(sink)
    with (
        socket.create_connection(address, timeout=5) as idle,
        ModbusTcpClient(*address[:1], port=address[1]) as busy,
    ):
        wait_for(lambda: sink.state().consumers == 2)
        with socket.create_connection(address, timeout=5) as early:
            assert refused(early)
        time.sleep(1.1)
        assert not busy.read_holding_registers(0, count=2).isError()
        with ModbusTcpClient(address[0], port=address[1]) as late:
            assert not late.read_holding_registers(0, count=2).isError()
            assert refused(idle)
            assert not busy.read_holding_registers(0, count=2).isError()
            assert sink.state().consumers == 2
    wait_for(lambda: sink.state().consumers == 0)


def refused(connection: socket.socket) -> bool:
    try:
        return connection.recv(1) == b""
    except ConnectionResetError:
        return True


def test_a_port_in_use_is_an_error(sink):
    with (
        pytest.raises(OutputError, match=r"modbus: can't listen on 127.*another program"),
        ModbusSink("127.0.0.1", port_of(sink)),
    ):
        pass


def test_numbers_at_their_limits_have_a_place():
    """Whatever a record may hold, the table can be made: a message must not stop the server."""
    record = make_record(1, ores=20)
    record["ores"] = [make_ore(id) for id in range(1, 20)] + [make_ore(70_000)]
    record["targets"] = [70_000, *range(1, 20)]
    record["ores"][-1]["strike"]["score"] = 1e300
    record["ores"][-1]["volume_m3"] = -1e39
    made = message(
        record | {"index": 2**40}, 2**32 + 5, Origin("no hex"), age_s=0.0, valid_for_s=1e6
    )
    found = entries(words(made, 2**20))
    assert (found["sequence"], found["count"], found["frame_index"], found["remaining"]) == (
        5,
        16,
        2**31 - 1,
        2**16 - 1,
    )
    assert found["target_1.score"] == math.inf
    assert found["target_1.volume"] == -math.inf
    assert found["target_1.id"] == 70_000 % 2**16


def test_the_table_has_no_gap_in_a_slot_and_no_register_twice():
    sizes = {"uint16": 1, "uint32": 2, "int32": 2, "float32": 2}
    taken = [address + word for address, kind, *_ in rows() for word in range(sizes[kind])]
    assert len(set(taken)) == len(taken)
    assert HEAD_WORDS + MODBUS_SLOTS * SLOT_WORDS + 2 == READABLE_WORDS
    assert AT_ONCE == HEAD_WORDS + 3 * SLOT_WORDS


def mbpoll(sink: ModbusSink, *words: str) -> str:
    command = [str(MBPOLL), "-m", "tcp", "-p", str(port_of(sink)), *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=20)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.skipif(
    MBPOLL is None, reason="mbpoll is not installed (Debian: apt-get install mbpoll)"
)
def test_mbpoll_reads_targets_and_acknowledges(sink):
    """mbpoll counts registers from 1, and takes the high word first with -B."""
    sink.publish(make_message(5))
    values = [
        line.split("\t")[1].strip()
        for line in mbpoll(
            sink, "-1", "-t", "4:float", "-B", "-r", "21", "-c", "6", "127.0.0.1"
        ).splitlines()
        if line.startswith("[")
    ]
    assert [float(value) for value in values] == [5.0, 1.0, 0.5, 0.0, 0.0, -1.0]
    assert "\t5" in mbpoll(sink, "-1", "-t", "4:int", "-B", "-r", "3", "-c", "1", "127.0.0.1")
    assert "\t5" in mbpoll(sink, "-1", "-t", "3:int", "-B", "-r", "529", "-c", "1", "127.0.0.1")
    mbpoll(sink, "-t", "4:int", "-B", "-r", "601", "127.0.0.1", "5")
    assert "message 5" in sink.state().detail
