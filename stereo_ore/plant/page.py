"""The operator's live page, and what monitors ask: for this machine, and for a reverse proxy on
it.
"""

from __future__ import annotations

import json
import logging
import re
import threading
from collections.abc import Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from types import TracebackType
from typing import Any, Self
from urllib.parse import urlsplit

from stereo_ore.errors import OutputError
from stereo_ore.plant.listening import REMEDY
from stereo_ore.plant.monitor import CONTENT_TYPE, health, metrics
from stereo_ore.plant.sinks.settings import LOOPBACK
from stereo_ore.plant.status import PlantStatus

_log = logging.getLogger(__name__)

HOST = re.compile(r"(?:\[([0-9a-f:.]+)\]|([^:/@\[\]]+))(?::\d*)?", re.ASCII)
LOOPBACK_NAMES = frozenset((LOOPBACK, "localhost", "::1"))

POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src 'self';"
    " connect-src 'self'"
)


class LivePage:
    """Serves ``/``, ``/state.json``, ``/overlay.png``, ``/health`` and ``/metrics`` on a port of
    the loopback address.

    Parameters
    ----------
    port : int
        0 takes a free one, see `port`.
    status : Status
        What to show.
    folder : Path
        Results, for the overlays and the room on the disk.
    names : sequence of str
        Names beside ``localhost`` under which a reverse proxy on this machine is reached.
    """

    def __init__(
        self, port: int, status: PlantStatus, folder: Path, names: Sequence[str] = ()
    ) -> None:
        self.port = port
        self._status, self._folder = status, folder
        self._names = LOOPBACK_NAMES | {name.lower() for name in names}

    @property
    def url(self) -> str:
        """Where to look."""
        return f"http://{LOOPBACK}:{self.port}/"

    def __enter__(self) -> Self:
        about = {"status": self._status, "folder": self._folder, "names": self._names}
        handler = type("Handler", (_Handler,), about)
        try:
            self._server = ThreadingHTTPServer((LOOPBACK, self.port), handler)
        except OSError as fault:
            problem = f"can't listen on {LOOPBACK}:{self.port}: {fault.strerror}"
            raise OutputError(problem, key="page", remedy=REMEDY) from None
        self.port = self._server.server_address[1]
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(0.1,), daemon=True, name="page"
        )
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class _Handler(BaseHTTPRequestHandler):
    status: PlantStatus
    folder: Path
    names: frozenset[str]
    timeout = 10

    def do_GET(self) -> None:
        """Answer with what the path names."""
        # A page of another site can't read ours, even when its name is made to resolve to this
        # machine.
        if _host(self.headers.get("Host", "")) not in self.names:
            self._answer(403, "text/plain", b"this page is for the machine it runs on\n")
            return
        match urlsplit(self.path).path:
            case "/":
                page = files("stereo_ore.plant").joinpath("page.html").read_bytes()
                self._answer(200, "text/html; charset=utf-8", page)
            case "/state.json":
                self._json(200, self.status.json())
            case "/health":
                verdict = health(self.status, self.folder)
                self._json(503 if verdict["status"] == "alarm" else 200, verdict)
            case "/metrics":
                self._answer(200, CONTENT_TYPE, metrics(self.status, self.folder).encode())
            case "/overlay.png" if picture := self._overlay():
                self._answer(200, "image/png", picture)
            case _:
                self._answer(404, "text/plain", b"nothing here\n")

    def do_HEAD(self) -> None:
        """Answer as to GET, without the content."""
        self.do_GET()

    def _json(self, code: int, content: Any) -> None:
        self._answer(code, "application/json", json.dumps(content).encode())

    def _overlay(self) -> bytes | None:
        name = self.status.last_frame
        overlay = self.folder / "overlays" / f"{name}.png"
        return overlay.read_bytes() if name and overlay.is_file() else None

    def _answer(self, code: int, kind: str, body: bytes) -> None:
        self.send_response(code)
        headers = {
            "Content-Type": kind,
            "Content-Length": str(len(body)),
            "Cache-Control": "no-store",
        }
        headers |= {"Content-Security-Policy": POLICY, "X-Content-Type-Options": "nosniff"}
        for key, value in headers.items():
            self.send_header(key, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        _log.debug(format, *args)


def _host(header: str) -> str | None:
    """The name or address in a Host header, with or without port (RFC 9110, 7.2); None for one that
    is none.
    """
    found = HOST.fullmatch(header.strip().lower())
    return found and (found[1] or found[2])
