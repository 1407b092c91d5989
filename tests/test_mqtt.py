"""MQTT against a real mosquitto; skipped where it is not installed (Debian: apt-get install
mosquitto)."""

import ipaddress
import json
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from importlib.resources import files
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from live import free_port, make_message, names_in, running, wait_for

pytest.importorskip("paho.mqtt.client", reason="paho-mqtt is not installed")

from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion

from stereo_ore.errors import OutputError
from stereo_ore.plant.sinks import mqtt
from stereo_ore.plant.sinks.message import Origin
from stereo_ore.plant.sinks.mqtt import MqttLogin, MqttSink

MOSQUITTO = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin:/usr/local/sbin")
TOPIC = "site/targets"
DAY = timedelta(days=1)

pytestmark = pytest.mark.skipif(MOSQUITTO is None, reason="mosquitto is not installed")


class Broker:
    """A mosquitto that can be stopped and started again on the same port."""

    def __init__(self, folder: Path) -> None:
        self.port = free_port()
        self.config = folder / "mosquitto.conf"
        self.settings = f"listener {self.port} 127.0.0.1\nallow_anonymous true\npersistence false\n"
        self.config.write_text(self.settings)
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        command = [str(MOSQUITTO), "-c", str(self.config)]
        self.process = subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        wait_for(self.listens, what="broker")

    def listens(self) -> bool:
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", self.port)) == 0

    def stop(self) -> None:
        if self.process:
            self.process.kill()
            self.process.wait()
        self.process = None


@contextmanager
def broker_with(folder: Path, settings: str) -> Iterator[Broker]:
    """A broker that can do less than others."""
    broker = Broker(folder)
    broker.config.write_text(broker.settings + settings)
    broker.start()
    try:
        yield broker
    finally:
        broker.stop()


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    broker = Broker(tmp_path)
    broker.start()
    yield broker
    broker.stop()


class Subscriber:
    """A client of its own that keeps what it is sent."""

    def __init__(self, port: int) -> None:
        self.messages: list[dict[str, Any]] = []
        self.subscriptions = 0
        self.client = Client(CallbackAPIVersion.VERSION2, protocol=MQTTProtocolVersion.MQTTv5)
        self.client.on_connect = lambda client, *_: client.subscribe(TOPIC, qos=1)
        self.client.on_subscribe = self._subscribed
        self.expiries: list[int | None] = []
        self.client.on_message = self._received
        self.client.reconnect_delay_set(1, 1)
        self.client.connect_async("127.0.0.1", port)
        self.client.loop_start()
        wait_for(lambda: self.subscriptions)

    def _subscribed(self, *_: object) -> None:
        self.subscriptions += 1

    def _received(self, client: Client, data: object, message: Any) -> None:
        line = json.loads(message.payload)
        if line["status"] != "starting":
            self.messages.append(line)
            self.expiries.append(getattr(message.properties, "MessageExpiryInterval", None))

    def close(self) -> None:
        self.client.disconnect()
        self.client.loop_stop()


@pytest.fixture
def sink(broker: Broker) -> Iterator[MqttSink]:
    with MqttSink("127.0.0.1", broker.port, TOPIC) as sink:
        wait_for(lambda: sink.state().connected)
        yield sink


def test_messages_arrive_in_order(broker, sink):
    subscriber = Subscriber(broker.port)
    for sequence in range(1, 201):
        sink.publish(make_message(sequence))
        wait_for(lambda sequence=sequence: sink.state().sent >= sequence - 30)
    wait_for(lambda: len(subscriber.messages) == 200)
    assert [message["sequence"] for message in subscriber.messages] == list(range(1, 201))
    assert subscriber.messages[-1]["targets"][0]["position_m"] == [200.0, 1.0, 0.5]
    subscriber.close()


def test_a_late_subscriber_gets_the_latest_until_it_expires(broker, sink):
    def latest() -> list[int]:
        """Numbers of what a subscriber gets who comes now."""
        subscriber = Subscriber(broker.port)
        time.sleep(0.3)
        subscriber.close()
        return [message["sequence"] for message in subscriber.messages]

    sink.publish(make_message(1))
    wait_for(lambda: latest() == [1], what="targets for who comes late")
    # The broker itself forgets the targets, even if nobody is left to withdraw them. It counts
    # whole seconds: targets of one second may be gone at once.
    sink.publish(make_message(2, valid_for_s=1.0))
    wait_for(lambda: latest() == [], what="end of the targets")
    assert sink.state().sent == 2, "nothing was published to withdraw them"


def vanish(sink: MqttSink) -> None:
    """A connection that breaks without a farewell is what the broker sees of a killed process."""
    sink._client.loop_stop()
    sink._client._sock_close()


def test_the_broker_withdraws_the_targets_of_a_program_that_vanished(broker):
    sink = MqttSink("127.0.0.1", broker.port, TOPIC, origin=Origin("test", "abc", replay=True))
    with sink:
        wait_for(lambda: sink.state().connected)
        subscriber = Subscriber(broker.port)
        sink.publish(make_message(1))
        wait_for(lambda: subscriber.messages)
        vanish(sink)
        wait_for(lambda: len(subscriber.messages) == 2, what="last will")
    targets, gone = subscriber.messages
    assert gone["status"] == "offline"
    assert not gone["valid"]
    # Of the session that it ends, and with no time or number that could be older than what it
    # withdraws.
    assert (gone["session"], gone["replay"], gone["transform_id"]) == (
        targets["session"],
        True,
        "abc",
    )
    assert (gone["sequence"], gone["published_ns"], gone["valid_until_ns"]) == (None, None, None)
    jsonschema.validate(
        gone, json.loads((files("stereo_ore") / "schema" / "targets-1.json").read_text())
    )
    late = Subscriber(broker.port)
    wait_for(lambda: late.messages)
    assert late.messages == [gone]
    late.close()
    subscriber.close()


def test_targets_expire_in_the_broker_and_their_absence_does_not(broker, sink):
    subscriber = Subscriber(broker.port)
    sink.publish(make_message(1, valid_for_s=30.0))
    sink.publish(make_message(2, status="degraded"))
    wait_for(lambda: len(subscriber.messages) == 2)
    assert 25 < subscriber.expiries[0] <= 30
    assert subscriber.expiries[1] is None
    subscriber.close()


def test_a_connection_that_comes_back_replaces_offline_without_a_new_frame(broker, monkeypatch):
    monkeypatch.setattr(mqtt, "RECONNECT_S", (1, 1))
    monkeypatch.setattr(mqtt, "GREETING_S", 0.2)
    with MqttSink("127.0.0.1", broker.port, TOPIC, origin=Origin("test")) as sink:
        wait_for(lambda: sink.state().connected)
        sink.publish(make_message(7))
        wait_for(lambda: sink.state().sent == 1)
        subscriber = Subscriber(broker.port)
        sink._client._sock.shutdown(socket.SHUT_RDWR)
        wait_for(
            lambda: "offline" in [message["status"] for message in subscriber.messages],
            what="last will",
        )
        wait_for(lambda: subscriber.messages[-1]["sequence"] == 7, what="message")
        assert subscriber.messages[-1]["valid"]
        subscriber.close()


def test_a_birth_is_announced_before_the_first_frame(broker, monkeypatch):
    monkeypatch.setattr(mqtt, "GREETING_S", 0.1)
    with MqttSink("127.0.0.1", broker.port, TOPIC, origin=Origin("test", replay=True)) as sink:
        wait_for(lambda: sink.state().sent == 1)
        seen: list[dict[str, Any]] = []
        client = Client(CallbackAPIVersion.VERSION2, protocol=MQTTProtocolVersion.MQTTv5)
        client.on_connect = lambda client, *_: client.subscribe(TOPIC)
        client.on_message = lambda client, data, message: seen.append(json.loads(message.payload))
        client.connect("127.0.0.1", broker.port)
        client.loop_start()
        wait_for(lambda: seen)
        assert (seen[0]["status"], seen[0]["session"], seen[0]["replay"]) == (
            "starting",
            "test",
            True,
        )
        client.disconnect()
        client.loop_stop()


@pytest.mark.parametrize(
    "settings", ["retain_available false\n", "max_qos 0\n", "retain_available false\nmax_qos 0\n"]
)
@pytest.mark.parametrize("qos", [0, 1])
def test_a_broker_that_can_do_less_is_served(tmp_path, settings, qos, monkeypatch):
    monkeypatch.setattr(mqtt, "RECONNECT_S", (1, 1))
    with (
        broker_with(tmp_path, settings) as broker,
        MqttSink("127.0.0.1", broker.port, TOPIC, qos=qos, origin=Origin("test")) as sink,
    ):
        wait_for(lambda: sink.state().connected, what="connection")
        subscriber = Subscriber(broker.port)
        for sequence in range(1, 21):
            sink.publish(make_message(sequence))
        wait_for(lambda: len(subscriber.messages) == 20)
        assert [message["sequence"] for message in subscriber.messages] == list(range(1, 21))
        assert ("without retained" in sink.state().detail) == ("retain" in settings)
        late = Subscriber(broker.port)
        time.sleep(0.3)
        assert len(late.messages) == ("retain" not in settings)
        vanish(sink)
        wait_for(lambda: subscriber.messages[-1]["status"] == "offline", what="last will")
        late.close()
        subscriber.close()


def test_a_broker_of_small_packets_gets_the_best_targets_that_fit(tmp_path):
    with (
        broker_with(tmp_path, "max_packet_size 1500\n") as broker,
        MqttSink("127.0.0.1", broker.port, TOPIC) as sink,
    ):
        wait_for(lambda: sink.state().connected)
        subscriber = Subscriber(broker.port)
        sink.publish(make_message(1, ores=16))
        sink.publish(make_message(2, ores=1))
        wait_for(lambda: len(subscriber.messages) == 2)
        cut, whole = subscriber.messages
        assert [target["id"] for target in cut["targets"]] == list(
            range(1, len(cut["targets"]) + 1)
        )
        assert 1 < len(cut["targets"]) < 16
        assert (cut["reasons"], whole["reasons"]) == (["TARGETS_LEFT_OUT"], [])
        assert sink.state().connected
        sink.publish(make_message(3, frame="x" * 2000))
        wait_for(lambda: "no message fits" in sink.state().alarm, what="alarm")
        assert (sink.state().connected, sink.state().dropped) == (True, 1)
        subscriber.close()


def test_a_broker_that_is_stopped_and_started_costs_no_record_and_publishing_resumes(
    broker, tmp_path, monkeypatch
):
    from test_serve_watch import put_pair, watch

    monkeypatch.setattr(mqtt, "RECONNECT_S", (1, 1))
    inbox, out = tmp_path / "in", tmp_path / "out"
    inbox.mkdir()
    count = 0

    def frames(number: int) -> None:
        nonlocal count
        for _ in range(number):
            put_pair(inbox, count)
            count += 1
        wait_for(lambda: len(names_in(out / "frames.jsonl.part")) == count, what="records")

    with running(
        watch(inbox), out, [sink := MqttSink("127.0.0.1", broker.port, TOPIC)], valid_for_s=0.5
    ):
        subscriber = Subscriber(broker.port)
        frames(20)
        wait_for(lambda: subscriber.messages and subscriber.messages[-1]["index"] == 19)
        broker.stop()
        wait_for(lambda: not sink.state().connected)
        frames(200)
        time.sleep(0.6)
        broker.start()
        wait_for(
            lambda: sink.state().connected and subscriber.subscriptions == 2, what="connection"
        )
        at_outage = len(subscriber.messages)
        frames(20)
        wait_for(lambda: subscriber.messages[-1]["index"] == 239, what="message after the outage")
    subscriber.close()
    assert names_in(out / "frames.jsonl") == [f"{index:06d}" for index in range(240)]
    assert sink.state().dropped > 0, "the queue is bounded"
    stale = [
        m for m in subscriber.messages[at_outage:] if m["index"] is not None and m["index"] < 220
    ]
    assert not any(message["valid"] for message in stale), (
        "what waited too long goes without its targets"
    )
    numbers = [message["sequence"] for message in subscriber.messages if message["sequence"]]
    assert numbers == sorted(set(numbers))


def test_without_a_broker_nothing_is_delayed_and_the_end_comes_soon():
    start = time.monotonic()
    with MqttSink("127.0.0.1", free_port(), TOPIC) as sink:
        for sequence in range(1, 1001):
            sink.publish(make_message(sequence))
        assert time.monotonic() - start < 5
        assert not sink.state().connected
        assert sink.state().dropped >= 1000 - 66
    assert time.monotonic() - start < 8


def make_authority(folder: Path) -> tuple[Path, Path]:
    """A certificate for 127.0.0.1 that vouches for itself, and its key."""
    pytest.importorskip("cryptography", reason="cryptography is not installed")
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "broker")])
    now = datetime.now(UTC)
    builder = (
        x509.CertificateBuilder().subject_name(name).issuer_name(name).public_key(key.public_key())
    )
    builder = builder.serial_number(1).not_valid_before(now - DAY).not_valid_after(now + DAY)
    address = x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address("127.0.0.1"))])
    builder = builder.add_extension(address, False).add_extension(
        x509.BasicConstraints(True, None), True
    )
    certificate, secret = folder / "broker.pem", folder / "broker.key"
    certificate.write_bytes(
        builder.sign(key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)
    )
    form = (
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )
    secret.write_bytes(key.private_bytes(*form))
    secret.chmod(0o644)
    return certificate, secret


def test_a_broker_with_tls_and_users(tmp_path):
    if shutil.which("mosquitto_passwd") is None:
        pytest.skip("mosquitto_passwd is not installed")
    certificate, key = make_authority(tmp_path)
    passwords = tmp_path / "passwords"
    subprocess.run(
        ["mosquitto_passwd", "-b", "-c", passwords, "arm", "secret"],
        check=True,
        capture_output=True,
    )
    passwords.chmod(0o644)
    tmp_path.chmod(0o755)
    broker = Broker(tmp_path)
    secured = (
        f"user root\nallow_anonymous false\npassword_file {passwords}\ncertfile"
        f" {certificate}\nkeyfile {key}\n"
    )
    broker.config.write_text(f"listener {broker.port} 127.0.0.1\n{secured}")
    broker.start()
    try:
        for password, connected in (("secret", True), ("wrong", False)):
            with MqttSink(
                "127.0.0.1", broker.port, TOPIC, MqttLogin("arm", password, certificate)
            ) as sink:
                sink.publish(make_message(1))
                wait_for(
                    lambda sink=sink: sink.state().sent or "Not authorized" in sink.state().detail,
                    what="answer",
                )
                assert sink.state().connected == connected
    finally:
        broker.stop()


def test_an_authority_that_is_none_is_an_error(tmp_path):
    (tmp_path / "ca.pem").write_text("nothing")
    with pytest.raises(OutputError, match=r"ca\.pem.*no certificate"):
        MqttSink("127.0.0.1", 1883, TOPIC, MqttLogin("arm", "secret", tmp_path / "ca.pem"))
    assert "secret" not in repr(MqttLogin("arm", "secret"))
