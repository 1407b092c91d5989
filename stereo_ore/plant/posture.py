"""The arm's posture as it comes: its side connects over TCP and writes a line a posture, or writes
variables of the OPC UA server (`sinks/opcua_posture`).
"""

from __future__ import annotations

import logging
import socket
import threading
from bisect import bisect_right
from collections import deque
from contextlib import AbstractContextManager, nullcontext, suppress
from types import TracebackType
from typing import Any, Self

from stereo_ore.errors import ConfigError
from stereo_ore.io.posture import MOST_LINE_BYTES, parse_posture, read_posture
from stereo_ore.plant.listening import connections, listen, stop_listening
from stereo_ore.types import F64, Posture, Site

_log = logging.getLogger(__name__)

REMEMBERED = 1000
"""Postures that are kept: more than arrive while a frame is worked on."""
_WAITING = 4
"""Connections that may wait for the one that writes."""


class PostureInbox:
    """The newest postures, told and asked for by different threads.

    Parameters
    ----------
    T_arm_camera : (4, 4) array
        Of the site.
    """

    def __init__(self, T_arm_camera: F64) -> None:
        self._T = T_arm_camera
        self._told: deque[Posture] = deque(maxlen=REMEMBERED)
        self._lock = threading.Lock()

    def around(self, stamp_ns: int) -> tuple[Posture, ...]:
        """The last posture at or before a time and the first after it, where there are any."""
        with self._lock:
            told = list(self._told)
        after = bisect_right([posture.stamp_ns for posture in told], stamp_ns)
        return tuple(told[max(after - 1, 0) : after + 1])

    def take_line(self, line: bytes, where: str) -> None:
        """Take in a posture as a line of JSON; ConfigError, naming `where`, for any other."""
        self._add(parse_posture(line, self._T, where))

    def take(self, data: Any, where: str) -> None:
        """Take in what such a line holds; ConfigError, naming `where`, for what is no posture."""
        self._add(read_posture(data, self._T, where))

    def _add(self, posture: Posture) -> None:
        with self._lock:
            if self._told and posture.stamp_ns <= self._told[-1].stamp_ns:
                # The arm's clock was set back: what was told before is of another time.
                self._told.clear()
            self._told.append(posture)


def live_postures(site: Site) -> PostureInbox | None:
    """Where postures of a site's arm come in while it works; None where they do not."""
    link = site.posture
    if link is None or link.file is not None or site.T_arm_camera is None:
        return None
    return PostureInbox(site.T_arm_camera)


def written_by_opcua(site: Site, inbox: PostureInbox | None) -> PostureInbox | None:
    """The inbox, where the site has the OPC UA server fill it."""
    return inbox if site.posture is not None and site.posture.opcua else None


def posture_server(site: Site, inbox: PostureInbox | None) -> AbstractContextManager[object]:
    """What listens for lines of postures, not yet entered, where the site has an address for it."""
    link = site.posture
    if inbox is None or link is None or link.listen is None:
        return nullcontext()
    return PostureServer(*link.listen, inbox)


class PostureServer:
    """Listens on `host`:`port` for one writer at a time; the newest connection takes its place.

    A line that is no posture ends the connection, and is told: what it was to say is not known.

    Parameters
    ----------
    host, port
        Where to listen; port 0 takes a free one, see `port`.
    inbox : PostureInbox
        Takes in what is told.
    """

    def __init__(self, host: str, port: int, inbox: PostureInbox) -> None:
        self.host, self.port, self._inbox = host, port, inbox
        self._lock = threading.Lock()
        self._writer: socket.socket | None = None

    def __enter__(self) -> Self:
        self._server = listen(self.host, self.port, "posture.listen", _WAITING)
        self.port = self._server.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True, name="posture").start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        stop_listening(self._server)
        self._replace(None)

    def _accept(self) -> None:
        for connection, address in connections(self._server):
            self._replace(connection)
            arguments = (connection, f"{address[0]}:{address[1]}")
            threading.Thread(target=self._read, args=arguments, daemon=True).start()

    def _replace(self, writer: socket.socket | None) -> None:
        """Cut off the writer so far."""
        with self._lock:
            earlier, self._writer = self._writer, writer
        if earlier is not None:
            with suppress(OSError):
                earlier.shutdown(socket.SHUT_RDWR)

    def _read(self, connection: socket.socket, address: str) -> None:
        try:
            with connection, connection.makefile("rb") as lines:
                while line := lines.readline(MOST_LINE_BYTES + 1):
                    self._inbox.take_line(line, f"posture from {address}")
        except ConfigError as fault:
            _log.warning("%s; the connection is closed", fault)
        except OSError as fault:
            _log.info("posture from %s: %s", address, fault)
