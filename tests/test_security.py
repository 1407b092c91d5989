"""What the command opens and what it tells: no port unasked, this machine only, no password
anywhere."""

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from live import free_port, names_in, wait_for
from runs import quarter_scene

from stereo_ore.errors import ConfigError
from stereo_ore.plant.sinks.settings import load_sinks

linux = pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
LISTENING = "0A"
SECRET = "correct-horse-battery"
WRONG = "wrong-horse-battery"


def sockets(pid: int) -> set[tuple[str, str]]:
    """Local addresses and states of the TCP and UDP sockets of a process and its children."""
    children = Path(f"/proc/{pid}/task/{pid}/children")
    found = set()
    for child in children.read_text().split() if children.exists() else ():
        found |= sockets(int(child))
    try:
        links = [os.readlink(file) for file in Path(f"/proc/{pid}/fd").iterdir()]
    except OSError:
        return found
    inodes = {match[1] for link in links if (match := re.fullmatch(r"socket:\[(\d+)\]", link))}
    for table in ("tcp", "tcp6", "udp", "udp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            words = line.split()
            if words[9] in inodes:
                found.add((words[1].partition(":")[0], words[3]))
    return found


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scene")
    quarter_scene(folder)
    return folder


def files(scene: Path) -> list[str]:
    return ["--calib", str(scene / "calibration.yaml"), "--site", str(scene / "site.yaml")]


@linux
def test_a_run_opens_no_socket(scene: Path, tmp_path: Path) -> None:
    recording = tmp_path / "recording"
    recording.mkdir()
    for index in range(4):
        for eye in ("left", "right"):
            shutil.copy(scene / f"{eye}.png", recording / f"{eye}{index}.png")
    command = [
        "stereo-ore",
        "-q",
        "run",
        str(recording),
        *files(scene),
        "--out",
        str(tmp_path / "out"),
    ]
    seen, looks = set(), 0
    with subprocess.Popen([*command, "--workers", "2"], stdout=subprocess.DEVNULL) as process:
        while process.poll() is None:
            seen |= sockets(process.pid)
            looks += 1
            time.sleep(0.05)
    assert process.returncode == 0
    assert looks > 10
    assert seen == set()


@contextmanager
def serving(scene: Path, folder: Path, *more: str) -> Iterator[tuple[subprocess.Popen[str], Path]]:
    """The real `serve` on a folder with one frame; stopped at the end."""
    inbox = folder / "inbox"
    inbox.mkdir()
    command = [
        "stereo-ore",
        "-v",
        "serve",
        "--watch",
        str(inbox),
        *files(scene),
        "--out",
        str(folder / "out"),
        *more,
    ]
    with (
        (folder / "log").open("w") as log,
        subprocess.Popen(command, stdout=log, stderr=log, text=True) as process,
    ):
        for eye in ("left", "right"):
            shutil.copy(scene / f"{eye}.png", inbox / f"{eye}0.png")
        try:
            part = folder / "out" / "frames.jsonl.part"
            wait_for(lambda: names_in(part) or process.poll() is not None, 60, what="frame")
            assert process.poll() is None, (folder / "log").read_text()
            yield process, folder / "log"
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait(30)


@linux
def test_serve_listens_nowhere_unless_asked(scene: Path, tmp_path: Path) -> None:
    with serving(scene, tmp_path) as (process, _):
        assert sockets(process.pid) == set()


@linux
def test_what_is_asked_for_listens_on_this_machine_only(scene: Path, tmp_path: Path) -> None:
    pytest.importorskip("asyncua", reason="asyncua is not installed")
    pytest.importorskip("pymodbus", reason="pymodbus is not installed")
    ports = "--opcua", str(free_port()), "--modbus", str(free_port())
    with serving(scene, tmp_path, "--tcp", "0", "--page", "0", *ports) as (process, _):
        listening = [address for address, state in sockets(process.pid) if state == LISTENING]
        assert listening == ["0100007F"]
        count = sum(
            LISTENING in line.split()[3] and line.split()[9] in inodes_of(process.pid)
            for line in Path("/proc/net/tcp").read_text().splitlines()[1:]
        )
        assert count == 4


def inodes_of(pid: int) -> set[str]:
    links = [os.readlink(file) for file in Path(f"/proc/{pid}/fd").iterdir()]
    return {match[1] for link in links if (match := re.fullmatch(r"socket:\[(\d+)\]", link))}


def test_no_password_is_written_or_logged(scene: Path, tmp_path: Path) -> None:
    pytest.importorskip("asyncua", reason="asyncua is not installed")
    pytest.importorskip("paho.mqtt", reason="paho-mqtt is not installed")
    from asyncua import ua
    from asyncua.sync import Client
    from test_opcua import make_certificate, secured_client

    certificate, key = make_certificate(tmp_path, "server")
    mine, my_key = make_certificate(tmp_path, "arm")
    users = tmp_path / "users"
    users.write_text(f"arm:{SECRET}\n")
    users.chmod(0o600)
    port = free_port()
    (tmp_path / "sinks.yaml").write_text(
        f"opcua: {{port: {port}, certificate: {certificate.name}, private_key: {key.name}, users:"
        f" users}}\nmqtt: {{port: {free_port()}, users: users}}\n"
    )
    url = f"opc.tcp://127.0.0.1:{port}/stereo-ore"
    with serving(scene, tmp_path, "--sinks", str(tmp_path / "sinks.yaml"), "--page", "0") as (
        _,
        log,
    ):
        with secured_client(url, mine, my_key, "arm", SECRET) as connection:
            assert connection.nodes.objects.get_children()
        with pytest.raises(ua.UaError), secured_client(url, mine, my_key, "arm", WRONG):
            pass
        # Without a user, and without encryption, nobody gets in.
        with pytest.raises(ua.UaError), secured_client(url, mine, my_key, None, ""):
            pass
        with pytest.raises((ua.UaError, ConnectionError, TimeoutError)), Client(url, timeout=5):
            pass
    users.unlink()
    written = [log, *(file for file in (tmp_path / "out").rglob("*") if file.is_file())]
    assert len(written) > 6
    for file in written:
        data = file.read_bytes()
        assert SECRET.encode() not in data, file
        assert WRONG.encode() not in data, file


@pytest.mark.parametrize(
    "text", [f"mqtt: {{password: {SECRET}}}", f"opcua: {{users: {{arm: {SECRET}}}}}"]
)
def test_a_password_in_the_wrong_place_is_not_repeated(text: str, tmp_path: Path) -> None:
    file = tmp_path / "sinks.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError) as error:
        load_sinks(file)
    assert SECRET not in str(error.value)
