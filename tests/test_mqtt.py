"""MQTT against a real mosquitto; skipped where it is not installed (Debian: apt-get install mosquitto)."""

import ipaddress
import json
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from live import free_port, make_message, names_in, running, wait_for

pytest.importorskip("paho.mqtt.client", reason="paho-mqtt is not installed")

from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion

from stereo_ore.errors import OutputError
from stereo_ore.plant.sinks import mqtt
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
        self.config.write_text(f"listener {self.port} 127.0.0.1\nallow_anonymous true\npersistence false\n")
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        command = [str(MOSQUITTO), "-c", str(self.config)]
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        wait_for(self.listens, what="broker")

    def listens(self) -> bool:
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", self.port)) == 0

    def stop(self) -> None:
        if self.process:
            self.process.kill()
            self.process.wait()
        self.process = None


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
        self.client.on_message = lambda client, data, message: self.messages.append(json.loads(message.payload))
        self.client.reconnect_delay_set(1, 1)
        self.client.connect_async("127.0.0.1", port)
        self.client.loop_start()
        wait_for(lambda: self.subscriptions)

    def _subscribed(self, *_: object) -> None:
        self.subscriptions += 1

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
    sink.publish(make_message(1, valid_for_s=1.0))
    wait_for(lambda: sink.state().sent == 1)
    first = Subscriber(broker.port)
    wait_for(lambda: first.messages)
    first.close()
    # The broker itself forgets the targets, even if nobody is left to withdraw them.
    time.sleep(2.2)
    late = Subscriber(broker.port)
    time.sleep(0.3)
    assert late.messages == []
    late.close()


def test_the_broker_withdraws_the_targets_of_a_program_that_vanished(broker):
    sink = MqttSink("127.0.0.1", broker.port, TOPIC)
    with sink:
        wait_for(lambda: sink.state().connected)
        subscriber = Subscriber(broker.port)
        sink.publish(make_message(1))
        wait_for(lambda: subscriber.messages)
        # A connection that breaks without a farewell is what the broker sees of a killed process.
        sink._client.loop_stop()
        sink._client._sock_close()
        wait_for(lambda: len(subscriber.messages) == 2, what="last will")
    assert subscriber.messages[1]["status"] == "offline"
    assert not subscriber.messages[1]["valid"]
    subscriber.close()


def test_a_broker_that_is_stopped_and_started_costs_no_record_and_publishing_resumes(broker, tmp_path, monkeypatch):
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

    with running(watch(inbox), out, [sink := MqttSink("127.0.0.1", broker.port, TOPIC)], valid_for_s=0.5):
        subscriber = Subscriber(broker.port)
        frames(20)
        wait_for(lambda: subscriber.messages and subscriber.messages[-1]["index"] == 19)
        broker.stop()
        wait_for(lambda: not sink.state().connected)
        frames(200)
        time.sleep(0.6)
        broker.start()
        wait_for(lambda: sink.state().connected and subscriber.subscriptions == 2, what="connection")
        at_outage = len(subscriber.messages)
        frames(20)
        wait_for(lambda: subscriber.messages[-1]["index"] == 239, what="message after the outage")
    subscriber.close()
    assert names_in(out / "frames.jsonl") == [f"{index:06d}" for index in range(240)]
    assert sink.state().dropped > 0, "the queue is bounded"
    stale = [m for m in subscriber.messages[at_outage:] if m["index"] is not None and m["index"] < 220]
    assert not any(message["valid"] for message in stale), "what waited too long goes without its targets"
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
    builder = x509.CertificateBuilder().subject_name(name).issuer_name(name).public_key(key.public_key())
    builder = builder.serial_number(1).not_valid_before(now - DAY).not_valid_after(now + DAY)
    address = x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address("127.0.0.1"))])
    builder = builder.add_extension(address, False).add_extension(x509.BasicConstraints(True, None), True)
    certificate, secret = folder / "broker.pem", folder / "broker.key"
    certificate.write_bytes(builder.sign(key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM))
    form = serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    secret.write_bytes(key.private_bytes(*form))
    secret.chmod(0o644)
    return certificate, secret


def test_a_broker_with_tls_and_users(tmp_path):
    if shutil.which("mosquitto_passwd") is None:
        pytest.skip("mosquitto_passwd is not installed")
    certificate, key = make_authority(tmp_path)
    passwords = tmp_path / "passwords"
    subprocess.run(["mosquitto_passwd", "-b", "-c", passwords, "arm", "secret"], check=True, capture_output=True)
    passwords.chmod(0o644)
    tmp_path.chmod(0o755)
    broker = Broker(tmp_path)
    secured = f"user root\nallow_anonymous false\npassword_file {passwords}\ncertfile {certificate}\nkeyfile {key}\n"
    broker.config.write_text(f"listener {broker.port} 127.0.0.1\n{secured}")
    broker.start()
    try:
        for password, connected in (("secret", True), ("wrong", False)):
            with MqttSink("127.0.0.1", broker.port, TOPIC, MqttLogin("arm", password, certificate)) as sink:
                sink.publish(make_message(1))
                wait_for(lambda sink=sink: sink.state().sent or "Not authorized" in sink.state().detail, what="answer")
                assert sink.state().connected == connected
    finally:
        broker.stop()


def test_an_authority_that_is_none_is_an_error(tmp_path):
    (tmp_path / "ca.pem").write_text("nothing")
    with pytest.raises(OutputError, match=r"ca\.pem.*no certificate"):
        MqttSink("127.0.0.1", 1883, TOPIC, MqttLogin("arm", "secret", tmp_path / "ca.pem"))
    assert "secret" not in repr(MqttLogin("arm", "secret"))
