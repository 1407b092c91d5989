"""The operator's live page: one HTML file and a JSON state, for this machine only."""

from __future__ import annotations

import json
import logging
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from stereo_ore.errors import OutputError
from stereo_ore.plant.sinks.settings import LOOPBACK
from stereo_ore.plant.status import Status

log = logging.getLogger(__name__)

POLICY = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src 'self'; connect-src 'self'"


class LivePage:
    """Serves ``/``, ``/state.json`` and ``/overlay.png`` on a port of the loopback address; port 0 takes a free one."""

    def __init__(self, port: int, status: Status, folder: Path) -> None:
        self.port = port
        self._status, self._folder = status, folder

    @property
    def url(self) -> str:
        """Where to look."""
        return f"http://{LOOPBACK}:{self.port}/"

    def __enter__(self) -> Self:
        handler = type("Handler", (_Handler,), {"status": self._status, "folder": self._folder})
        try:
            self._server = ThreadingHTTPServer((LOOPBACK, self.port), handler)
        except OSError as fault:
            remedy = "Is another program listening there?"
            problem = f"can't listen on {LOOPBACK}:{self.port}: {fault.strerror}"
            raise OutputError(problem, key="page", remedy=remedy) from None
        self.port = self._server.server_address[1]
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.1,), daemon=True, name="page")
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class _Handler(BaseHTTPRequestHandler):
    status: Status
    folder: Path
    timeout = 10

    def do_GET(self) -> None:
        # A page of another site can't read ours, even when its name is made to resolve to this machine.
        host = self.headers.get("Host", "").rpartition(":")[0]
        if host not in (LOOPBACK, "localhost"):
            self._answer(403, "text/plain", b"this page is for the machine it runs on\n")
            return
        path = self.path.partition("?")[0]
        if path == "/":
            self._answer(200, "text/html; charset=utf-8", files("stereo_ore.plant").joinpath("page.html").read_bytes())
        elif path == "/state.json":
            self._answer(200, "application/json", json.dumps(self.status.json()).encode())
        elif path == "/overlay.png" and (picture := self._overlay()):
            self._answer(200, "image/png", picture)
        else:
            self._answer(404, "text/plain", b"nothing here\n")

    def _overlay(self) -> bytes | None:
        name = self.status.last_frame
        overlay = self.folder / "overlays" / f"{name}.png"
        return overlay.read_bytes() if name and overlay.is_file() else None

    def _answer(self, code: int, kind: str, body: bytes) -> None:
        self.send_response(code)
        headers = {"Content-Type": kind, "Content-Length": str(len(body)), "Cache-Control": "no-store"}
        headers |= {"Content-Security-Policy": POLICY, "X-Content-Type-Options": "nosniff"}
        for key, value in headers.items():
            self.send_header(key, value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        log.debug(format, *args)
