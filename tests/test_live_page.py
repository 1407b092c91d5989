"""The operator's page: what it answers, to whom, and that it says when it is stale, in a real
browser too."""

import html
import json
import re
import shutil
import socket
import subprocess
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from http.client import HTTPResponse
from importlib.resources import files
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from live import ListSink, free_port, make_record, wait_for

from stereo_ore.errors import OutputError
from stereo_ore.plant.page import LivePage
from stereo_ore.plant.publisher import Publisher
from stereo_ore.plant.status import PlantStatus

BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)


class Source:
    name = "test"

    def frames(self, start: Any, stop: Any) -> Iterator[Any]:
        return iter(())

    def state(self) -> str:
        return "watching <inbox>"


class Live:
    """A page with the run behind it."""

    def __init__(self, folder: Path, publisher: Publisher, names: tuple[str, ...] = ()) -> None:
        self.folder, self.publisher = folder, publisher
        self.status = PlantStatus(Source(), publisher)
        self.page = LivePage(0, self.status, folder, names)

    def add(self, index: int, **changes: Any) -> None:
        record = make_record(index, **changes)
        picture = self.folder / "overlays" / f"{record['frame']}.png"
        picture.parent.mkdir(exist_ok=True)
        cv2.imwrite(str(picture), np.full((40, 60, 3), index, np.uint8))
        self.publisher.publish(record, 0.0)
        self.status.add(record)

    def get(self, path: str = "", **headers: str) -> tuple[int, bytes]:
        request = urllib.request.Request(self.page.url + path, headers=headers)
        try:
            with urllib.request.urlopen(request, timeout=5) as answer:
                return answer.status, answer.read()
        except urllib.error.HTTPError as fault:
            with fault:
                return fault.code, fault.read()

    def state(self) -> dict[str, Any]:
        return json.loads(self.get("state.json")[1])


@pytest.fixture
def live(tmp_path: Path) -> Iterator[Live]:
    with Publisher([ListSink()], valid_for_s=2.0) as publisher:
        live = Live(tmp_path, publisher)
        with live.page:
            yield live


def test_the_state_before_the_first_frame(live):
    state = live.state()
    assert state["age_s"] is None
    assert state["message"]["status"] == "starting"
    assert not state["message"]["valid"]
    assert live.get("overlay.png")[0] == 404


def test_the_state_tells_frames_targets_age_and_sinks(live):
    for index in range(3):
        live.add(index)
        time.sleep(0.05)
    live.add(3, status="failed")
    live.add(4)
    state = live.state()
    assert (state["last_frame"]["frame"], state["frames"]) == ("000004", {"ok": 4, "failed": 1})
    assert state["age_s"] < 2
    assert 0 < state["valid_s"] <= 2.0
    assert [target["id"] for target in state["message"]["targets"]] == [1, 2]
    assert state["frame_rate_hz"] > 0
    assert state["source"] == "watching <inbox>"
    assert state["sinks"][0]["sent"] == 5


def test_targets_are_gone_when_they_have_expired(live):
    live.add(0)
    wait_for(lambda: not live.state()["message"]["valid"], what="expiry")
    wait_for(lambda: live.state()["message"]["status"] == "expired", what="withdrawal")
    state = live.state()
    assert (state["valid_s"], state["message"]["targets"], state["message"]["status"]) == (
        0.0,
        [],
        "expired",
    )


def test_the_overlay_is_that_of_the_latest_frame(live):
    for index in (7, 200):
        live.add(index)
        picture = cv2.imdecode(
            np.frombuffer(live.get(f"overlay.png?{index}")[1], np.uint8), cv2.IMREAD_COLOR
        )
        assert picture[0, 0, 0] == index


def test_a_name_with_a_path_in_it_reads_no_other_file(live):
    (live.folder / "secret.png").write_bytes(b"secret")
    live.status.add(make_record(0, frame="../secret"))
    assert live.get("overlay.png")[0] == 404


def ask(live: Live, request: str) -> tuple[int, dict[str, str], bytes]:
    """Status, headers and content of the answer to the bytes of a request."""
    with socket.create_connection(("127.0.0.1", live.page.port), timeout=5) as connection:
        connection.sendall(request.encode())
        answer = HTTPResponse(connection, method=request.partition(" ")[0])
        answer.begin()
        with answer:
            return (
                answer.status,
                {key.lower(): value for key, value in answer.getheaders()},
                answer.read(),
            )


@pytest.mark.parametrize(
    "host",
    [
        "localhost",
        "127.0.0.1",
        "localhost:8080",
        "127.0.0.1:80",
        "LOCALHOST",
        "[::1]",
        "[::1]:8080",
    ],
)
def test_this_machine_is_known_with_and_without_a_port(live, host):
    for path in ("/", "/state.json", "http://localhost/state.json", "/health", "/metrics"):
        assert ask(live, f"GET {path} HTTP/1.1\r\nHost: {host}\r\n\r\n")[0] == 200


@pytest.mark.parametrize("path", ["/", "/state.json", "/metrics", "/health", "/nothing"])
def test_head_is_get_without_content(live, path):
    live.add(0)
    get, head = (
        ask(live, f"{method} {path} HTTP/1.1\r\nHost: localhost\r\n\r\n")
        for method in ("GET", "HEAD")
    )
    assert get[0] == head[0] == (404 if path == "/nothing" else 200)
    assert head[1]["content-type"] == get[1]["content-type"]
    assert (int(get[1]["content-length"]), head[2]) == (len(get[2]), b"")
    refused = ask(live, f"HEAD {path} HTTP/1.1\r\nHost: evil.example\r\n\r\n")
    assert refused[0] == 403


def test_names_of_a_proxy_are_known_when_they_are_given(tmp_path):
    with Publisher([ListSink()], valid_for_s=2.0) as publisher:
        live = Live(tmp_path, publisher, ("Vision.plant",))
        with live.page:
            for host, code in (
                ("vision.plant", 200),
                ("vision.plant:8443", 200),
                ("vision.plant.evil", 403),
            ):
                assert live.get("state.json", Host=host)[0] == code


def listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


NGINX = shutil.which("nginx") or shutil.which("nginx", path="/usr/sbin")


@pytest.mark.skipif(
    NGINX is None, reason="nginx is not installed (Debian: apt-get install nginx-light)"
)
@pytest.mark.parametrize("host", ["$host", "$proxy_host", "$http_host"])
def test_behind_nginx_on_this_machine(live, tmp_path, host):
    """Below a path of its own, with each of the Host headers that people configure."""
    port, folder = free_port(), tmp_path / "nginx"
    folder.mkdir()
    temporary = "".join(
        f"{kind}_temp_path {folder};"
        for kind in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    )
    proxy = f"proxy_pass {live.page.url}; proxy_set_header Host {host};"
    server = f"server {{ listen 127.0.0.1:{port}; location /ore/ {{ {proxy} }} }}"
    http = f"http {{ access_log off; {temporary} {server} }}"
    (folder / "nginx.conf").write_text(
        f"daemon off; master_process off; pid {folder}/pid; events {{}} {http}"
    )
    command = [str(NGINX), "-c", str(folder / "nginx.conf"), "-e", str(folder / "log")]
    with subprocess.Popen(command) as nginx:
        try:
            wait_for(lambda: listens(port), what="nginx")
            live.add(3)
            for path, content in (
                ("", b"<!doctype html>"),
                ("state.json", b"{"),
                ("overlay.png?3", b"\x89PNG"),
            ):
                with urllib.request.urlopen(
                    f"http://localhost:{port}/ore/{path}", timeout=5
                ) as answer:
                    assert answer.read().startswith(content)
        finally:
            nginx.terminate()


@pytest.mark.parametrize(
    "host",
    [
        "evil.example",
        "evil.example:80",
        "192.168.0.1",
        "",
        "localhost.evil",
        "a@localhost:x",
        "[::2]",
        "[",
        ":80",
    ],
)
def test_other_names_for_this_machine_are_refused(live, host):
    assert live.get("state.json", Host=host)[0] == 403


@pytest.mark.parametrize("path", ["../run.json", "overlays/000000.png", "x", "state.json/x"])
def test_nothing_else_is_served(live, path):
    assert live.get(path)[0] == 404


def test_a_port_in_use_is_an_error(live):
    with (
        pytest.raises(OutputError, match="another program"),
        LivePage(live.page.port, live.status, live.folder),
    ):
        pass


def test_the_page_loads_nothing_from_elsewhere():
    page = (files("stereo_ore.plant") / "page.html").read_text()
    assert not re.search(r"https?://|//cdn|@import", page)
    assert "innerHTML" not in page


def rendered(live: Live, wait_ms: int, profile: Path) -> str:
    """Text of the page after a while, as a browser shows it."""
    options = [
        "--headless=new",
        "--no-sandbox",
        "--disable-gpu",
        f"--user-data-dir={profile}",
        "--dump-dom",
    ]
    command = [str(BROWSER), *options, f"--virtual-time-budget={wait_ms}", live.page.url]
    dom = subprocess.run(command, capture_output=True, text=True, timeout=90, check=True).stdout
    return html.unescape(re.sub(r"<(script|style)\b.*?</\1>", "", dom, flags=re.DOTALL))


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no chromium is installed")
def test_in_a_browser_it_shows_targets_and_says_loudly_when_stale(live, tmp_path):
    live.publisher.valid_for_s = 60.0
    live.add(0)
    shown = rendered(live, 2000, tmp_path / "profile")
    assert "2 targets valid for" in shown
    assert "watching <inbox>" in shown
    assert 'class="valid"' in shown
    live.publisher.valid_for_s = 0.2
    live.add(1)
    time.sleep(0.5)
    shown = rendered(live, 2000, tmp_path / "profile")
    assert "STALE: no frame for" in shown
    assert 'class="stale"' in shown
