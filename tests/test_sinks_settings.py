"""The sinks file: what may leave this machine, and under which safeguards."""

import csv
import json
import re
from pathlib import Path
from xml.etree import ElementTree

import jsonschema
import pytest
from live import make_message
from typer.testing import CliRunner

from stereo_ore.cli import app, load_verbs
from stereo_ore.errors import ConfigError
from stereo_ore.plant.sinks.modbus_table import HEAD_WORDS, SLOT_WORDS, rows
from stereo_ore.plant.sinks.opcua_model import CONTROL, PAYLOAD
from stereo_ore.plant.sinks.settings import (
    OpcUaSettings,
    is_loopback,
    load_sinks,
    open_sinks,
    read_users,
)


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
        ("foxglove: {host: 0.0.0.0}", "tunnel"),
        ("modbus: {host: 0.0.0.0}", "modbus.clients"),
        ("modbus: {clients: [10.1.0.0/99]}", "clients"),
        ("mqtt: {qos: 2}", "qos"),
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


def test_an_address_stays_on_this_machine_unless_its_section_says_what_guards_it(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(OpcUaSettings, "guards", ())
    file = write_settings(
        tmp_path, "opcua: {host: 0.0.0.0, certificate: a, private_key: b, users: c}"
    )
    with pytest.raises(ConfigError, match="not guarded"):
        load_sinks(file)


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


@pytest.mark.parametrize("text", ["arm:a b:c", "arm: a b:c", " arm : a b:c \n\n"])
def test_users_may_be_written_with_blanks(tmp_path, text):
    file = tmp_path / "users"
    file.write_text(text)
    file.chmod(0o600)
    assert read_users(file) == {"arm": "a b:c"}


def test_a_modbus_server_for_clients_that_are_named(tmp_path):
    pytest.importorskip("pymodbus", reason="pymodbus is not installed")
    text = "modbus: {host: 0.0.0.0, port: 1502, clients: [10.1.2.3, 10.2.0.0/16]}"
    settings = load_sinks(write_settings(tmp_path, text))
    assert [str(client) for client in settings.modbus.clients] == ["10.1.2.3/32", "10.2.0.0/16"]
    assert [type(sink).__name__ for sink in open_sinks(settings)] == ["ModbusSink"]


@pytest.mark.parametrize("text", ["", "arm\n", "arm:\n", ":x\n", "arm: \n"])
def test_a_file_of_users_that_can_not_be_used(tmp_path, text):
    file = tmp_path / "users"
    file.write_text(text)
    file.chmod(0o600)
    with pytest.raises(ConfigError, match="user"):
        read_users(file)


@pytest.mark.parametrize(
    ("host", "loopback"),
    [
        ("127.0.0.1", True),
        ("127.3.2.1", True),
        ("::1", True),
        ("localhost", True),
        ("0.0.0.0", False),
        ("plc", False),
    ],
)
def test_only_this_machine_is_loopback(host, loopback):
    assert is_loopback(host) is loopback


def test_without_settings_there_is_no_consumer():
    assert open_sinks(load_sinks(None)) == []


def printed(*words: str) -> str:
    load_verbs()
    result = CliRunner().invoke(app, ["config", *words])
    assert result.exit_code == 0, result.output
    return result.stdout


def test_what_other_programs_import_is_printed():
    model = ElementTree.fromstring(printed("opcua"))
    space = {"n": "http://opcfoundation.org/UA/2011/03/UANodeSet.xsd"}
    names = [node.get("NodeId") for node in model.findall("n:UAVariable", space)]
    assert "ns=1;s=StereoOre.Targets.Position" in names
    assert len(names) == len(set(names))
    lines = list(csv.DictReader(printed("modbus").splitlines()))
    assert {line["type"] for line in lines} == {"uint16", "uint32", "int32", "float32"}
    assert next(line for line in lines if line["name"] == "target_2.position_x")["address"] == "52"


def test_schemas_are_printed_and_fit():
    sinks = json.loads(printed("schema", "sinks"))
    jsonschema.validate({"opcua": {"port": 4840}, "modbus": {"clients": ["10.0.0.0/8"]}}, sinks)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate({"opcua": {"prot": 4840}}, sinks)
    jsonschema.validate(json.loads(make_message().line()), json.loads(printed("schema", "targets")))
    assert "voxel" in json.loads(printed("schema"))["properties"]
    assert json.loads(printed("schema", "frame"))["$id"] == "stereo_ore/frame/2"


def test_the_table_in_the_docs_is_that_of_the_program():
    text = (Path(__file__).parents[1] / "docs" / "plant.md").read_text(encoding="utf-8")
    addresses = {name: address for address, _, name, *_ in rows()}
    for name in ("version", "heartbeat", "valid", "remaining", "count", "status"):
        assert re.search(rf"\| {addresses[name]} \| uint16 \| `{name}`", text)
    assert f"{addresses['acknowledged_target']} | uint16 | `acknowledged_target`" in text
    for name in ("position", "direction"):
        first = addresses[f"target_1.{name}_x"] - HEAD_WORDS
        assert f"| + {first}, {first + 2}, {first + 4} | float32 | `{name}` x y z" in text
    assert f"prints all {len(rows())} of them" in text
    assert f"{HEAD_WORDS + 3 * SLOT_WORDS} registers from 0" in text
    for variable in (*PAYLOAD, *CONTROL):
        assert f"`{variable.name}`" in text


def test_the_sinks_file_in_the_docs_is_a_good_one(tmp_path):
    text = (Path(__file__).parents[1] / "docs" / "plant.md").read_text(encoding="utf-8")
    (tmp_path / "sinks.yaml").write_text(text.partition("```yaml\n")[2].partition("```")[0])
    settings = load_sinks(tmp_path / "sinks.yaml")
    assert (settings.mqtt.topic, settings.modbus.port) == ("plant/north/targets", 502)
