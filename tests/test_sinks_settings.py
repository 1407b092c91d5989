"""The sinks file: what may leave this machine, and under which safeguards."""

from pathlib import Path

import pytest

from stereo_ore.errors import ConfigError
from stereo_ore.plant.sinks.settings import is_loopback, load_sinks, open_sinks, read_users


def write_settings(folder: Path, text: str) -> Path:
    file = folder / "sinks.yaml"
    file.write_text(f"format: stereo_ore/sinks\nversion: 1\n{text}\n")
    return file


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("opcua: {host: 0.0.0.0}", "certificate"),
        ("opcua: {host: 192.168.1.5, certificate: a, private_key: b}", "users"),
        ("mqtt: {host: broker.example}", "authority"),
        ("tcp: {host: 0.0.0.0}", "tunnel"),
        ("tcp: {prot: 1}", "did you mean port"),
        ("tcp: {port: 70000}", "65535"),
        ("opcua: {certificate: a}", "belong together"),
        ("opcua: {users: a}", "encryption"),
        ("mqtt: {topic: 'a/#'}", "topic"),
    ],
)
def test_settings_that_would_be_unsafe_or_are_wrong_are_refused(tmp_path, text, says):
    file = write_settings(tmp_path, text)
    with pytest.raises(ConfigError, match=says) as fault:
        load_sinks(file)
    assert str(file) in str(fault.value)


def test_settings_name_files_beside_them(tmp_path):
    text = "opcua: {host: 0.0.0.0, certificate: server.der, private_key: server.pem, users: users}"
    pytest.importorskip("asyncua", reason="asyncua is not installed")
    settings = load_sinks(write_settings(tmp_path, text), tcp=0)
    assert settings.opcua.certificate == tmp_path / "server.der"
    assert settings.tcp.host == "127.0.0.1"
    (tmp_path / "users").write_text("arm:secret\n")
    (tmp_path / "users").chmod(0o644)
    with pytest.raises(ConfigError, match="chmod 600"):
        open_sinks(settings)
    (tmp_path / "users").chmod(0o600)
    assert [type(sink).__name__ for sink in open_sinks(settings)] == ["OpcUaSink", "TcpSink"]


@pytest.mark.parametrize("text", ["", "arm\n", "arm:\n", ":x\n"])
def test_a_file_of_users_that_can_not_be_used(tmp_path, text):
    file = tmp_path / "users"
    file.write_text(text)
    file.chmod(0o600)
    with pytest.raises(ConfigError, match="user"):
        read_users(file)


@pytest.mark.parametrize(
    ("host", "loopback"),
    [("127.0.0.1", True), ("127.3.2.1", True), ("::1", True), ("localhost", True), ("0.0.0.0", False), ("plc", False)],
)
def test_only_this_machine_is_loopback(host, loopback):
    assert is_loopback(host) is loopback


def test_without_settings_there_is_no_consumer():
    assert open_sinks(load_sinks(None)) == []
