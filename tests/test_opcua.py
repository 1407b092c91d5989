"""The OPC UA server, seen by a real client in another process.

Run as a program this file is that client: it prints a JSON line for every message it has seen.
"""

import json
import math
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from statistics import median
from typing import Any

import pytest
from live import free_port, make_message, wait_for

pytest.importorskip("asyncua", reason="asyncua is not installed")

from asyncua import ua
from asyncua.sync import Client

from stereo_ore.errors import OutputError
from stereo_ore.plant.sinks import opcua, supervisor
from stereo_ore.plant.sinks.message import Origin, notice
from stereo_ore.plant.sinks.opcua import OpcUaSecurity, OpcUaSink
from stereo_ore.plant.sinks.opcua_model import NAMESPACE, OPCUA_SLOTS, PAYLOAD

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning:asyncua")

QUEUE = 10_000
WINDOW = 250
"""So many messages are published before the client has to have acknowledged those before."""


def node_id(folder: str, name: str, namespace: int) -> str:
    return f"ns={namespace};s=StereoOre.{folder}.{name}"


class Assembler:
    """Puts the values of one message together by their source timestamp, as a client of a
    subscription has to."""

    def __init__(self, names: dict[Any, str]) -> None:
        self.names = names
        self.changes: dict[Any, dict[str, Any]] = {}
        self.latest = 0

    def datachange_notification(self, node: Any, value: Any, data: Any) -> None:
        stamp = data.monitored_item.Value.SourceTimestamp
        name = self.names[node.nodeid]
        self.changes.setdefault(stamp, {})[name] = value
        if name == "Sequence":
            self.latest = value

    def whole(self) -> list[dict[str, Any]]:
        """Messages in order; a value that did not change is that of the message before."""
        state: dict[str, Any] = {}
        messages = []
        for stamp in sorted(self.changes):
            state = {**state, **self.changes[stamp]}
            if "Sequence" in self.changes[stamp]:
                messages.append(state)
        return messages


def client(url: str, count: int, timeout_s: float) -> None:
    """Subscribe to everything, acknowledge as an arm does, and print what came when message `count`
    or the time has."""
    with Client(url, timeout=60, watchdog_intervall=60) as connection:
        namespace = connection.get_namespace_index(NAMESPACE)
        nodes = {v.name: connection.get_node(node_id(v.folder, v.name, namespace)) for v in PAYLOAD}
        assembler = Assembler({node.nodeid: name for name, node in nodes.items()})
        subscription = connection.create_subscription(20, assembler)
        subscription.subscribe_data_change(list(nodes.values()), queuesize=QUEUE)
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        acknowledgement = connection.get_node(
            node_id("Acknowledgement", "AcknowledgedSequence", namespace)
        )
        end = time.monotonic() + timeout_s
        while assembler.latest < count and time.monotonic() < end:
            time.sleep(0.1)
            acknowledgement.write_value(assembler.latest, ua.VariantType.UInt32)
        for message in assembler.whole():
            values = {
                name: value for name, value in message.items() if not isinstance(value, datetime)
            }
            sys.stdout.write(json.dumps(values) + "\n")


@pytest.fixture(scope="module")
def sink() -> Iterator[OpcUaSink]:
    with OpcUaSink("127.0.0.1", free_port()) as sink:
        yield sink


@pytest.fixture
def connection(sink: OpcUaSink) -> Iterator[Client]:
    with Client(sink.url) as connection:
        yield connection


def read(connection: Client, folder: str, name: str) -> Any:
    namespace = connection.get_namespace_index(NAMESPACE)
    # Uncertain, which what belongs to no valid target is, would raise otherwise.
    return (
        connection.get_node(node_id(folder, name, namespace))
        .read_data_value(raise_on_bad_status=False)
        .Value.Value
    )


def publish(sink: OpcUaSink, message: Any) -> float:
    """Publish and wait until it is written; the time it took [s]."""
    sent = sink.state().sent
    start = time.perf_counter()
    sink.publish(message)
    while sink.state().sent == sent:
        time.sleep(0.0001)
    return time.perf_counter() - start


def test_the_model_says_all_about_a_message(sink, connection):
    publish(sink, make_message(3))
    values = {v.name: read(connection, v.folder, v.name) for v in PAYLOAD}
    assert (values["Sequence"], values["Frame"], values["FrameIndex"], values["Status"]) == (
        3,
        "000003",
        3,
        "ok",
    )
    assert (values["Valid"], values["Count"], values["Id"][:3]) == (True, 2, [1, 2, 0])
    assert values["Position"][:6] == [3.0, 1.0, 0.5, 3.0, 2.0, 0.5]
    assert values["Direction"][:3] == [0.0, 0.0, -1.0]
    assert values["Size"][:3] == [3.0, 0.3, 0.2]
    assert (values["Oversize"][:3], values["Score"][0]) == ([1, 1, -1], 0.9)
    assert values["SequenceNumber"] == [3] * OPCUA_SLOTS
    assert (values["ValidUntil"] - values["Published"]).total_seconds() == pytest.approx(
        60, abs=0.1
    )
    assert json.loads(values["Json"])["targets"][1]["id"] == 2
    assert (values["Replay"], values["Session"]) == (False, "test")
    # A slot that is not in use is no place to strike.
    assert all(math.isnan(value) for value in values["Position"][6:])


def test_units_and_frame_are_properties(sink, connection):
    namespace = connection.get_namespace_index(NAMESPACE)
    position = connection.get_node(node_id("Targets", "Position", namespace))
    assert position.get_child("0:EngineeringUnits").read_value().DisplayName.Text == "m"
    assert position.get_child(f"{namespace}:Frame").read_value() == "arm"
    assert "strike points" in position.read_description().Text


def test_a_degraded_frame_and_the_end_leave_no_target(sink, connection):
    for message in (make_message(4, status="degraded"), notice(5, Origin(), "stopped")):
        publish(sink, make_message(3))
        publish(sink, message)
        assert read(connection, "Targets", "Valid") is False
        assert read(connection, "Targets", "Count") == 0
        assert all(math.isnan(value) for value in read(connection, "Targets", "Position"))
        assert read(connection, "Targets", "Id") == [0] * OPCUA_SLOTS
    assert read(connection, "Result", "Status") == "stopped"
    assert read(connection, "Result", "Reasons") == ["STOPPED"]


def test_more_targets_than_slots_keep_the_best(sink, connection):
    publish(sink, make_message(6, ores=OPCUA_SLOTS + 4))
    assert read(connection, "Targets", "Count") == OPCUA_SLOTS
    assert read(connection, "Targets", "Id") == list(range(1, OPCUA_SLOTS + 1))


def test_the_arm_acknowledges_and_can_write_nothing_else(sink, connection):
    namespace = connection.get_namespace_index(NAMESPACE)
    for name, value in (("AcknowledgedSequence", 6), ("AcknowledgedTarget", 2)):
        connection.get_node(node_id("Acknowledgement", name, namespace)).write_value(
            value, ua.VariantType.UInt32
        )
    wait_for(lambda: "message 6, ore 2" in sink.state().detail, what="acknowledgement")
    for variable in PAYLOAD:
        node = connection.get_node(node_id(variable.folder, variable.name, namespace))
        with pytest.raises(ua.UaStatusCodeError):
            node.write_value(node.read_data_value())
    assert sink.state().consumers == 1


def test_nobody_is_an_administrator(sink):
    connection = Client(sink.url)
    connection.set_user("admin")
    connection.set_password("admin")
    with pytest.raises(ua.UaError), connection:
        pass


def test_the_heartbeat_beats(sink, connection):
    first = read(connection, "Result", "Heartbeat")
    wait_for(lambda: read(connection, "Result", "Heartbeat") >= first + 2, 5)


def start_client(url: str, count: int, timeout_s: float) -> subprocess.Popen[bytes]:
    command = [sys.executable, __file__, url, str(count), str(timeout_s)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdout.readline() == b"ready\n"
    return process


def acknowledged(sink: OpcUaSink) -> int:
    found = re.search(r"message (\d+)", sink.state().detail)
    return int(found[1]) if found else 0


def check_stream(sink: OpcUaSink, count: int) -> list[float]:
    """Publish `count` messages to a client in another process; it must see each, whole and in
    order."""
    timeout_s = 30 + count / 20
    with start_client(sink.url, count, timeout_s) as process:
        times = []
        for sequence in range(1, count + 1):
            times.append(publish(sink, make_message(sequence, ores=1 + sequence % 5)))
            if sequence % WINDOW == 0:
                wait_for(
                    lambda sequence=sequence: acknowledged(sink) > sequence - WINDOW,
                    timeout_s,
                    "acknowledgement",
                )
        output, _ = process.communicate(timeout=timeout_s)
    seen = [json.loads(line) for line in output.splitlines()]
    seen = [message for message in seen if message["Session"] == "test"]
    first = next(place for place, message in enumerate(seen) if message["Sequence"] == 1)
    stream = seen[first:]
    assert [message["Sequence"] for message in stream] == list(range(1, count + 1))
    for message in stream:
        sequence, ores = message["Sequence"], 1 + message["Sequence"] % 5
        assert message["SequenceNumber"] == [sequence] * OPCUA_SLOTS
        assert (message["Frame"], message["FrameIndex"], message["Count"]) == (
            f"{sequence:06d}",
            sequence,
            ores,
        )
        assert message["Position"][: 3 * ores : 3] == [float(sequence)] * ores
        assert all(math.isnan(value) for value in message["Position"][3 * ores :])
        assert message["Size"][: 3 * ores : 3] == [float(sequence)] * ores
        assert message["Id"] == [*range(1, ores + 1), *[0] * (OPCUA_SLOTS - ores)]
        assert json.loads(message["Json"])["sequence"] == sequence
    return times


def test_a_client_in_another_process_sees_every_message_whole_and_in_order(sink):
    check_stream(sink, 300)


@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="POSIX only")
def test_a_client_that_hangs_delays_nobody(sink, connection):
    with start_client(sink.url, 10**6, 60) as process:
        process.send_signal(signal.SIGSTOP)
        times = [publish(sink, make_message(sequence, ores=16)) for sequence in range(1, 301)]
        assert read(connection, "Result", "Sequence") == 300
        process.kill()
        process.communicate()
    assert median(times) < 0.05
    assert max(times) < 2
    wait_for(lambda: sink.state().consumers == 1, what="farewell")


@pytest.mark.slow
def test_10_000_updates_in_order_none_torn_median_below_5_ms(sink):
    times = check_stream(sink, 10_000)
    assert median(times) < 0.005


def test_reading_one_by_one_finds_a_torn_record_out(sink):
    """Sequence first, then the payload, then SequenceNumber: equal only when the payload is
    whole."""
    command = [sys.executable, __file__, "--one-by-one", sink.url]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        assert process.stdout.readline() == b"ready\n"
        sequence = 0
        while process.poll() is None and sequence < 5000:
            sequence += 1
            publish(sink, make_message(sequence))
            # Bursts, in which a record is torn under the reader's hands, and pauses, in which it is
            # whole.
            time.sleep(0.3 if sequence % 100 == 0 else 0)
        whole, torn_and_found, torn = map(int, process.stdout.read().split())
    assert torn == 0
    assert whole > 0
    assert torn_and_found > 0, "or the test shows nothing"


def one_by_one(url: str, count: int = 400) -> None:
    with Client(url) as connection:
        namespace = connection.get_namespace_index(NAMESPACE)
        sys.stdout.write("ready\n")
        sys.stdout.flush()

        def value(folder: str, name: str) -> Any:
            return connection.get_node(node_id(folder, name, namespace)).read_value()

        whole = found = torn = 0
        for _ in range(count):
            sequence = value("Result", "Sequence")
            index, position = value("Result", "FrameIndex"), value("Targets", "Position")
            began = value("Targets", "SequenceNumber")[0]
            consistent = index == sequence and position[0] == sequence
            if began != sequence:
                found += not consistent
            else:
                whole, torn = whole + consistent, torn + (not consistent)
        sys.stdout.write(f"{whole} {found} {torn}\n")


def test_a_killed_server_is_noticed_by_the_client_within_the_stated_time(tmp_path):
    from test_serve_watch import SERVER, put_pair

    inbox, port = tmp_path / "in", free_port()
    inbox.mkdir()
    command = [sys.executable, str(SERVER), str(inbox), str(tmp_path / "out"), "--opcua", str(port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as server:
        assert server.stdout.readline() == b"ready\n"
        with Client(f"opc.tcp://127.0.0.1:{port}/stereo-ore", timeout=2) as connection:
            put_pair(inbox, 0)
            wait_for(lambda: read(connection, "Targets", "Valid"), what="target")
            # The source stops: targets become invalid by themselves within the two seconds that the
            # server was given.
            start = time.monotonic()
            wait_for(lambda: not read(connection, "Targets", "Valid"), 4, what="expiry")
            assert time.monotonic() - start < 3
            assert read(connection, "Result", "Status") == "expired"
            put_pair(inbox, 1)
            wait_for(lambda: read(connection, "Targets", "Valid"), what="target")
            valid_until = read(connection, "Result", "ValidUntil").timestamp()
            server.kill()
            server.wait()
            killed = time.time()
            with pytest.raises((ConnectionError, TimeoutError, ua.UaError, OSError)):
                read(connection, "Targets", "Valid")
            assert time.time() - killed < 3
            # What the client has read before tells it for how long to believe it.
            assert valid_until < killed + 2.1


def test_a_server_that_fails_is_started_again(sink, connection, monkeypatch):
    monkeypatch.setattr(supervisor, "RESTART_S", 0.1)
    with monkeypatch.context() as broken:
        broken.setattr(opcua, "PAYLOAD", (*PAYLOAD[:3], replace(PAYLOAD[3], value=lambda _: 1 / 0)))
        sink.publish(make_message(1))
        wait_for(lambda: "failed" in sink.state().alarm, what="failure")
        # The client's connection has ended, so that it can't take the half-written message for a
        # whole one.
        with pytest.raises((ConnectionError, TimeoutError, ua.UaError, OSError)):
            read(connection, "Targets", "Valid")
    publish(sink, make_message(2))
    with Client(sink.url) as again:
        assert read(again, "Result", "Sequence") == 2


def test_a_port_in_use_is_an_error(sink):
    port = int(sink.url.split(":")[2].split("/")[0])
    with (
        pytest.raises(OutputError, match=r"opcua: can't listen on 127.*another program"),
        OpcUaSink("127.0.0.1", port),
    ):
        pass


def make_certificate(folder: Path, name: str) -> tuple[Path, Path]:
    import asyncio

    from asyncua.crypto.cert_gen import setup_self_signed_certificate
    from cryptography.x509.oid import ExtendedKeyUsageOID

    key, certificate = folder / f"{name}.key.pem", folder / f"{name}.der"
    uses = [ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH]
    subject = {"commonName": name}
    asyncio.run(
        setup_self_signed_certificate(
            key, certificate, f"urn:test:{name}", "localhost", uses, subject
        )
    )
    return certificate, key


def secured_client(
    url: str, certificate: Path, key: Path, user: str | None, password: str
) -> Client:
    connection = Client(url)
    connection.application_uri = "urn:test:arm"
    from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256

    connection.set_security(SecurityPolicyBasic256Sha256, str(certificate), str(key))
    if user:
        connection.set_user(user)
        connection.set_password(password)
    return connection


def test_beyond_this_machine_only_known_certificates_and_users_get_in(tmp_path):
    server_certificate, server_key = make_certificate(tmp_path, "server")
    certificate, key = make_certificate(tmp_path, "arm")
    stranger, stranger_key = make_certificate(tmp_path, "stranger")
    (tmp_path / "trusted").mkdir()
    (tmp_path / "trusted" / "arm.der").write_bytes(certificate.read_bytes())
    security = OpcUaSecurity(
        server_certificate, server_key, tmp_path / "trusted", {"arm": "correct horse"}
    )
    assert "horse" not in repr(security)
    with OpcUaSink("127.0.0.1", free_port(), security) as sink:
        publish(sink, make_message(1))
        with secured_client(sink.url, certificate, key, "arm", "correct horse") as connection:
            assert read(connection, "Result", "Sequence") == 1
        for user, password in (("arm", "wrong"), ("admin", "correct horse"), (None, "")):
            with (
                pytest.raises(ua.UaError),
                secured_client(sink.url, certificate, key, user, password),
            ):
                pass
        refused = secured_client(sink.url, stranger, stranger_key, "arm", "correct horse")
        refused.application_uri = "urn:test:stranger"
        with pytest.raises((ua.UaError, ConnectionError, TimeoutError)), refused:
            pass
        with pytest.raises(ua.UaError), Client(sink.url):
            pass


def test_a_certificate_that_is_none_is_an_error(tmp_path):
    (tmp_path / "x").write_text("nothing")
    security = OpcUaSecurity(tmp_path / "x", tmp_path / "x", None, {"arm": "secret"})
    with (
        pytest.raises(OutputError, match="Are certificate and key"),
        OpcUaSink("127.0.0.1", free_port(), security),
    ):
        pass


if __name__ == "__main__":
    if sys.argv[1] == "--one-by-one":
        one_by_one(sys.argv[2])
    else:
        client(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]))
