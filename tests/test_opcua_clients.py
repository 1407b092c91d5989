"""What clients write, and what other programs make of the model: asyncua's low-level calls, and
node-opcua."""

import json
import math
import os
import random
import threading
import time
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import node
import pytest
from live import free_port, make_message, make_ore, make_record, wait_for

pytest.importorskip("asyncua", reason="asyncua is not installed")

from asyncua import ua
from asyncua.sync import Client

from stereo_ore.plant.sinks import opcua, supervisor
from stereo_ore.plant.sinks.message import Origin, message
from stereo_ore.plant.sinks.opcua import OpcUaSink
from stereo_ore.plant.sinks.opcua_model import (
    MODEL,
    NAMESPACE,
    OPCUA_SLOTS,
    POSTURE_SLOTS,
    UNITS,
    WRITTEN_FOLDERS,
)
from stereo_ore.plant.sinks.opcua_nodeset import nodeset
from stereo_ore.version import __version__

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning:asyncua")

VARIABLES = {variable.name: variable for variable in MODEL}
CODES = ua.StatusCodes
STAMP = 1_795_000_000_123_456_789


@pytest.fixture(scope="module")
def sink() -> Iterator[OpcUaSink]:
    with OpcUaSink("127.0.0.1", free_port(), origin=Origin("s", replay=True)) as sink:
        yield sink


class Arm:
    """A client that reads and writes as exactly as the services allow."""

    def __init__(self, url: str) -> None:
        self.client = Client(url)

    def __enter__(self) -> "Arm":
        self.client.connect()
        self.namespace = self.client.get_namespace_index(NAMESPACE)
        return self

    def __exit__(self, *_: object) -> None:
        self.client.disconnect()

    def id(self, name: str) -> ua.NodeId:
        return ua.NodeId(f"StereoOre.{VARIABLES[name].folder}.{name}", self.namespace)

    def read(self, name: str, index_range: str | None = None) -> ua.DataValue:
        item = ua.ReadValueId(self.id(name), ua.AttributeIds.Value, index_range)
        parameters = ua.ReadParameters(NodesToRead=[item])
        (value,) = self.client.tloop.post(self.client.aio_obj.uaclient.read(parameters))
        return value

    def write(self, name: str, value: ua.DataValue, index_range: str | None = None) -> int:
        item = ua.WriteValue(self.id(name), ua.AttributeIds.Value, index_range, value)
        parameters = ua.WriteParameters(NodesToWrite=[item])
        (status,) = self.client.tloop.post(self.client.aio_obj.uaclient.write(parameters))
        return int(status.value)


@pytest.fixture
def arm(sink: OpcUaSink) -> Iterator[Arm]:
    with Arm(sink.url) as arm:
        yield arm


def show(sink: OpcUaSink, sequence: int, **record: Any) -> None:
    sent = sink.state().sent
    sink.publish(make_message(sequence, **record))
    wait_for(lambda: sink.state().sent > sent, what="message")


def uint32(value: Any, status: int = CODES.Good, **times: Any) -> ua.DataValue:
    return ua.DataValue(
        ua.Variant(value, ua.VariantType.UInt32), StatusCode=ua.StatusCode(status), **times
    )


def beats(arm: Arm, times: int = 2) -> None:
    first = arm.read("Heartbeat").Value.Value
    wait_for(lambda: arm.read("Heartbeat").Value.Value >= first + times, 30, what="heartbeat")


FAR = datetime(9999, 12, 31, tzinfo=UTC)
WRITES = {
    "uncertain": (uint32(1, CODES.UncertainLastUsableValue), CODES.Good),
    "bad": (uint32(1, CODES.BadSensorFailure), CODES.Good),
    "bad and empty": (
        ua.DataValue(ua.Variant(), StatusCode=ua.StatusCode(CODES.BadNoData)),
        CODES.Good,
    ),
    "long ago": (uint32(1, SourceTimestamp=datetime(1602, 1, 1, tzinfo=UTC)), CODES.Good),
    "far ahead": (uint32(1, SourceTimestamp=FAR, ServerTimestamp=FAR), CODES.Good),
    "list": (uint32([1, 2]), CODES.BadTypeMismatch),
    "empty list": (uint32([]), CODES.BadTypeMismatch),
    "nothing": (ua.DataValue(ua.Variant()), CODES.BadTypeMismatch),
    "text": (ua.DataValue(ua.Variant("1")), CODES.BadTypeMismatch),
    "signed": (ua.DataValue(ua.Variant(1, ua.VariantType.Int32)), CODES.BadTypeMismatch),
    "real": (ua.DataValue(ua.Variant(1.0)), CODES.BadTypeMismatch),
    "truth": (ua.DataValue(ua.Variant(True)), CODES.BadTypeMismatch),
}


@pytest.mark.parametrize("write", WRITES)
def test_after_any_write_the_server_lives_and_only_a_good_whole_number_counts(
    sink: OpcUaSink, arm: Arm, write: str
):
    value, answer = WRITES[write]
    assert arm.write("AcknowledgedSequence", uint32(7)) == CODES.Good
    wait_for(lambda: "message 7" in sink.state().detail, what="acknowledgement")
    assert arm.write("AcknowledgedSequence", value) == answer
    beats(arm)
    kept = answer == CODES.BadTypeMismatch
    counts = "message 7" if kept else "message 1" if value.StatusCode.is_good() else "nothing"
    assert counts in sink.state().detail
    assert arm.write("AcknowledgedSequence", uint32(3)) == CODES.Good
    wait_for(lambda: "message 3" in sink.state().detail, what="acknowledgement")
    assert (sink.state().alarm, sink.state().restarts) == ("", 0)


def test_a_part_of_a_value_is_not_written(sink: OpcUaSink, arm: Arm):
    assert arm.write("AcknowledgedSequence", uint32(3), "0") == CODES.BadWriteNotSupported
    assert (
        arm.write("Position", ua.DataValue(ua.Variant([0.0])), "3:5") == CODES.BadUserAccessDenied
    )


@pytest.mark.parametrize(
    ("name", "index_range", "expected"),
    [
        ("Position", "3", [8.0]),
        ("Position", "3:5", [8.0, 2.0, 0.5]),
        ("Position", "0:2", [8.0, 1.0, 0.5]),
        ("Id", "1:2", [2, 0]),
        ("Id", "14:99", [0, 0]),
        ("Frame", "3:5", "008"),
        ("Position", "48", CODES.BadIndexRangeNoData),
        ("Position", "0,1", CODES.BadIndexRangeNoData),
        ("Count", "0", CODES.BadIndexRangeNoData),
        ("Reasons", "0", CODES.BadIndexRangeNoData),
        ("Position", "5:3", CODES.BadIndexRangeInvalid),
        ("Position", "3:3", CODES.BadIndexRangeInvalid),
        ("Position", "three", CODES.BadIndexRangeInvalid),
        ("Position", "-1", CODES.BadIndexRangeInvalid),
        ("Position", "٣", CODES.BadIndexRangeInvalid),
    ],
)
def test_a_range_gives_its_elements_or_says_why_not(
    sink: OpcUaSink, arm: Arm, name: str, index_range: str, expected: Any
):
    show(sink, 8, frame="000008")
    value = arm.read(name, index_range)
    if isinstance(expected, int):
        assert (int(value.StatusCode.value), value.Value.Value) == (expected, None)
    else:
        assert value.StatusCode.is_good()
        assert value.Value.Value == expected
        assert value.SourceTimestamp == arm.read(name).SourceTimestamp


def test_a_part_can_not_be_monitored_and_the_rest_can(sink: OpcUaSink, arm: Arm):
    class Ignore:
        def datachange_notification(self, *_: object) -> None: ...

    subscription = arm.client.create_subscription(100, Ignore())
    items = []
    for handle, index_range in enumerate((None, "3:5", None), 1):
        item = ua.ReadValueId(arm.id("Position"), ua.AttributeIds.Value, index_range)
        parameters = ua.MonitoringParameters(ClientHandle=handle, SamplingInterval=100, QueueSize=1)
        items.append(ua.MonitoredItemCreateRequest(item, ua.MonitoringMode.Reporting, parameters))
    create = ua.CreateMonitoredItemsParameters(
        subscription.aio_obj.subscription_id, ItemsToCreate=items
    )
    results = arm.client.tloop.post(arm.client.aio_obj.uaclient.create_monitored_items(create))
    assert [int(result.StatusCode.value) for result in results] == [
        CODES.Good,
        CODES.BadNotSupported,
        CODES.Good,
    ]
    subscription.delete()


def test_arrays_tell_their_rank_and_length(sink: OpcUaSink, arm: Arm):
    lengths = dict.fromkeys(("Position", "Direction", "Size", "Sigma", "Centre"), 48)
    lengths |= {"From": 48, "To": 48, "Name": POSTURE_SLOTS, "Radius": POSTURE_SLOTS}
    lengths |= {"VolumeBounds": 32, "AlternatePosition": 144, "AlternateDirection": 144}
    lengths |= dict.fromkeys(("Reasons", "Foreign"), 0)
    lengths |= dict.fromkeys(
        ("SequenceNumber", "Id", "Oversize", "Score", "Volume", "Track"), OPCUA_SLOTS
    )
    for name, variable in VARIABLES.items():
        found = arm.client.get_node(arm.id(name))
        assert found.read_value_rank() == (1 if name in lengths else -1)
        assert (found.read_array_dimensions() or None) == (
            [lengths[name]] if name in lengths else None
        )
        value = arm.read(name).Value
        assert value.VariantType.name == variable.type
        if lengths.get(name):
            assert len(value.Value) == lengths[name]


def test_what_no_target_stands_behind_is_uncertain_and_keeps_its_value(sink: OpcUaSink, arm: Arm):
    show(sink, 4)
    assert arm.read("Position").StatusCode.is_good()
    show(sink, 5, status="degraded")
    position = arm.read("Position")
    assert (int(position.StatusCode.value), len(position.Value.Value)) == (CODES.Uncertain, 48)
    assert all(map(math.isnan, position.Value.Value))
    for name in ("Valid", "Count", "Status", "Reasons", "Json", "Sequence", "Frame"):
        assert arm.read(name).StatusCode.is_good()


def test_times_and_numbers_for_clients_without_64_bits(sink: OpcUaSink, arm: Arm):
    show(sink, 6, stamp_ns=STAMP, index=2**40, stamp_source="file name")
    assert (arm.read("StampNs").Value.Value, arm.read("FrameIndex").Value.Value) == (STAMP, 2**40)
    assert arm.read("Stamp").Value.Value == datetime(1970, 1, 1, tzinfo=UTC) + timedelta(
        microseconds=STAMP // 1000
    )
    assert arm.read("StampSource").Value.Value == "file name"
    assert arm.read("FrameIndex32").Value.Value == 2**31 - 1
    show(sink, 7)
    assert (arm.read("StampNs").Value.Value, arm.read("Stamp").Value.Value.year) == (0, 1601)
    assert arm.read("StampSource").Value.Value == ""
    assert arm.read("FrameIndex32").Value.Value == 7


def test_before_the_first_frame_it_already_says_that_it_is_a_replay():
    with (
        OpcUaSink("127.0.0.1", free_port(), origin=Origin("s", replay=True)) as sink,
        Arm(sink.url) as arm,
    ):
        values = {
            name: arm.read(name).Value.Value for name in ("Status", "Replay", "Session", "Valid")
        }
    assert values == {"Status": "starting", "Replay": True, "Session": "s", "Valid": False}


def test_a_heartbeat_that_dies_is_an_alarm_and_the_server_starts_again_with_the_last_message(
    monkeypatch,
):
    with OpcUaSink("127.0.0.1", free_port()) as sink:
        show(sink, 9)
        with monkeypatch.context() as broken:
            broken.setattr(opcua, "_whole_number", lambda *_: 1 / 0)
            wait_for(lambda: "division by zero" in sink.state().alarm, what="alarm")
        wait_for(lambda: not sink.state().alarm, 60, what="restart")
        assert sink.state().restarts >= 1
        with Arm(sink.url) as arm:
            assert (arm.read("Sequence").Value.Value, arm.read("Valid").Value.Value) == (9, True)
            beats(arm)


def test_a_loop_that_hangs_is_an_alarm(monkeypatch):
    monkeypatch.setattr(supervisor, "SILENT_S", 0.8)
    with OpcUaSink("127.0.0.1", free_port()) as sink:
        hang = threading.Event()
        with monkeypatch.context() as broken:
            broken.setattr(opcua, "_whole_number", lambda *_: (hang.wait(10), 0)[1])
            wait_for(lambda: "no heartbeat" in sink.state().alarm, what="alarm")
            hang.set()
        wait_for(lambda: not sink.state().alarm, what="heartbeat")


def test_a_lump_is_told_with_centre_bounds_and_other_strikes(sink: OpcUaSink, arm: Arm):
    lump = make_ore(1)
    other = {"point": {"arm": [1.0, 2.0, 3.0]}, "direction": {"arm": [0.0, 1.0, 0.0]}, "score": 0.5}
    half = other | {"point": {"arm": None}}
    lump["strike"]["alternates"] = [other, half, other]
    lump["centre_of_gravity"]["arm"] = [4.0, 5.0, 6.0]
    show(sink, 11, ores=1)
    sink.publish(message(make_record(11, ores=1) | {"ores": [lump]}, 12, Origin("s"),
                         age_s=0.0, valid_for_s=60.0))  # fmt: skip
    wait_for(lambda: arm.read("Sequence").Value.Value == 12, what="message")
    assert arm.read("Centre").Value.Value[:3] == [4.0, 5.0, 6.0]
    assert arm.read("VolumeBounds").Value.Value[:2] == [0.01, 0.03]
    positions = arm.read("AlternatePosition").Value.Value
    assert positions[:6] == [1.0, 2.0, 3.0] * 2
    assert all(map(math.isnan, positions[6:]))
    assert arm.read("AlternateDirection").Value.Value[3:6] == [0.0, 1.0, 0.0]


@pytest.mark.parametrize(
    ("status", "state"), [("ok", 1), ("empty", 1), ("degraded", 4), ("failed", 4)]
)
def test_results_have_the_states_of_machine_vision(
    sink: OpcUaSink, arm: Arm, status: str, state: int
):
    show(sink, 20 + state, status=status)
    assert arm.read("ResultState").Value.Value == state


def test_the_server_says_what_it_is(sink: OpcUaSink, arm: Arm):
    build = arm.client.get_node(ua.ObjectIds.Server_ServerStatus_BuildInfo).read_value()
    assert (build.ProductUri, build.ProductName) == ("urn:stereo-ore", "stereo-ore")
    assert build.SoftwareVersion == __version__


def random_value(rng: random.Random) -> ua.DataValue:
    """A value of random type, rank, status and times."""
    kinds = [
        (ua.VariantType.UInt32, lambda: rng.randrange(2**32)),
        (ua.VariantType.Int32, lambda: rng.randrange(-(2**31), 2**31)),
        (ua.VariantType.UInt64, lambda: rng.randrange(2**64)),
        (ua.VariantType.Double, lambda: rng.choice([0.0, math.nan, math.inf, -1e308])),
        (ua.VariantType.Boolean, lambda: rng.random() < 0.5),
        (ua.VariantType.String, lambda: rng.choice(["", "1", "ore\0", "é" * 500])),
        (ua.VariantType.ByteString, lambda: rng.randbytes(rng.randrange(100))),
        (ua.VariantType.DateTime, lambda: datetime(rng.randrange(1601, 9999), 1, 1, tzinfo=UTC)),
        (ua.VariantType.Null, lambda: None),
    ]
    kind, make = rng.choice(kinds[:1] if rng.random() < 0.5 else kinds)
    value = (
        make()
        if rng.random() < 0.7 or kind is ua.VariantType.Null
        else [make() for _ in range(rng.randrange(20))]
    )
    codes = [
        CODES.Good,
        CODES.Uncertain,
        CODES.UncertainLastUsableValue,
        CODES.BadSensorFailure,
        CODES.BadNoData,
    ]
    times = [None, datetime(1601, 1, 2, tzinfo=UTC), FAR, datetime.now(UTC)]
    status = ua.StatusCode(rng.choice(codes))
    variant = ua.Variant(value, kind, is_array=isinstance(value, list))
    return ua.DataValue(
        variant, status, SourceTimestamp=rng.choice(times), ServerTimestamp=rng.choice(times)
    )


def scribble(url: str, seed: int, count: int, faults: list[str]) -> None:
    """Write `count` random values to random nodes, as a client that means no good or is badly
    programmed."""
    rng = random.Random(seed)
    try:
        with Arm(url) as arm:
            for _ in range(count):
                name = rng.choice(
                    [
                        "AcknowledgedSequence",
                        "AcknowledgedTarget",
                        *(["Position", "Valid", "Heartbeat"]),
                    ]
                )
                index_range = rng.choice([None, None, None, "0", "3:5", "9:1", ""])
                arm.write(name, random_value(rng), index_range)
    except Exception as fault:
        faults.append(f"{type(fault).__name__}: {fault}")


def used_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def chaos(sink: OpcUaSink, writes: int) -> tuple[float, float, float]:
    """Random writes from two clients while frames run; longest time of a frame and of the heartbeat
    [s], MB grown."""
    faults: list[str] = []
    sent, published, longest, oldest = sink.state().sent, 0, 0.0, 0.0
    writers = [
        threading.Thread(target=scribble, args=(sink.url, seed, writes // 2, faults))
        for seed in (1, 2)
    ]
    for writer in writers:
        writer.start()
    warm = None
    while any(writer.is_alive() for writer in writers):
        published += 1
        start = time.monotonic()
        sink.publish(make_message(published, ores=1 + published % 5))
        while sink.state().sent < sent + published:
            time.sleep(0.001)
            assert time.monotonic() - start < 10, "a frame is not published"
        longest = max(longest, time.monotonic() - start)
        oldest = max(oldest, sink._supervisor.silent_s)
        time.sleep(0.02)
        if warm is None and published == 50:
            warm = used_mb()
    assert faults == []
    assert published >= writes // 100
    return longest, oldest, used_mb() - (warm or used_mb())


def check_after_chaos(sink: OpcUaSink) -> None:
    assert (sink.state().restarts, sink.state().alarm) == (0, "")
    with Arm(sink.url) as arm:
        beats(arm)
        assert arm.write("AcknowledgedSequence", uint32(5)) == CODES.Good
        wait_for(lambda: "message 5" in sink.state().detail, what="acknowledgement")


def test_random_writes_from_two_clients_stop_nothing():
    with OpcUaSink("127.0.0.1", free_port()) as sink:
        chaos(sink, 400)
        check_after_chaos(sink)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs /proc")
def test_10_000_random_writes_stop_nothing_and_leave_memory_flat(
    capsys: pytest.CaptureFixture[str],
):
    with OpcUaSink("127.0.0.1", free_port()) as sink:
        longest, oldest, grown_mb = chaos(sink, 10_000)
        with capsys.disabled():
            print(  # noqa: T201
                f"\nlongest frame {longest:.3f} s, oldest heartbeat {oldest:.3f} s, memory"
                f" +{grown_mb:.1f} MB"
            )
        check_after_chaos(sink)
        assert longest < 1.0
        assert oldest < 2.0
        assert grown_mb < 10


def javascript(*arguments: str) -> dict[str, dict[str, Any]]:
    """What node-opcua says, by name."""
    packages = "node-opcua-address-space", "node-opcua-nodesets", "node-opcua-client"
    return {row["name"]: row for row in node.run("node_opcua.js", *arguments, packages=packages)}


def test_node_opcua_loads_the_nodeset_with_units(tmp_path: Path):
    file = tmp_path / "model.xml"
    file.write_text(nodeset(), encoding="utf-8")
    rows = javascript("load", str(file))
    kind = rows.pop("the type")
    assert (kind["id"], kind["of"]) == ("StereoOreType", "BaseObjectType")
    assert kind["mandatory"] == [f"{variable.folder}.{variable.name}" for variable in MODEL]
    assert rows.keys() == VARIABLES.keys()
    for name, variable in VARIABLES.items():
        row = rows[name]
        assert row["unit"] == (
            [variable.unit, UNITS[variable.unit].code] if variable.unit else None
        )
        assert (row["rank"], row["dimensions"]) == (
            (-1, None) if variable.length is None else (1, [variable.length])
        )
        assert (row["text"], row["frame"]) == (variable.text, variable.frame or None)
        assert row["id"] == f"StereoOre.{variable.folder}.{name}"
        assert row["access"] == (3 if variable.folder in WRITTEN_FOLDERS else 1)
        assert ua.VariantType(row["type"]).name == variable.type


def test_node_opcua_reads_what_was_published(sink: OpcUaSink):
    show(sink, 6, stamp_ns=STAMP)
    names = [
        ("Result", "StampNs"),
        ("Result", "Stamp"),
        ("Result", "FrameIndex"),
        ("Result", "FrameIndex32"),
    ]
    names += [("Result", "Json"), ("Targets", "Position", "3:5"), ("Targets", "Size", "99")]
    rows = javascript("read", sink.url, json.dumps(names))
    assert rows["StampNs"]["value"] == [STAMP >> 32, STAMP & 0xFFFFFFFF], "a pair, as ever"
    assert rows["Stamp"]["value"] == "2026-11-18T11:06:40.123Z"
    assert (rows["FrameIndex"]["value"], rows["FrameIndex32"]["value"]) == ([0, 6], 6)
    assert rows["Position"]["value"] == [6.0, 2.0, 0.5]
    assert rows["Size"]["status"] == "BadIndexRangeNoData"
    assert json.loads(rows["Json"]["value"])["stamp_utc"].endswith(".123456789Z")
