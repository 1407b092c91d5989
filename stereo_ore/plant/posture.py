"""The arm's posture as it comes: its side connects over TCP and writes a line a posture."""

from __future__ import annotations

import logging
import socket
import threading
from bisect import bisect_right
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import TracebackType
from typing import Self

from stereo_ore.errors import ConfigError
from stereo_ore.io.posture import MOST_LINE_BYTES, parse_posture, recorded_postures
from stereo_ore.plant.listening import connections, listen, stop_listening
from stereo_ore.types import F64, Posture, Postures, Site

_log = logging.getLogger(__name__)

REMEMBERED = 1000
"""Postures that are kept: more than arrive while a frame is worked on."""
_WAITING = 4
"""Connections that may wait for the one that writes."""


@contextmanager
def postures_of(site: Site) -> Iterator[Postures | None]:
    """What tells of the arm's posture: a file, or lines as they come; None without one."""
    link = site.posture
    if link is None or link.listen is None or site.T_arm_camera is None:
        yield recorded_postures(site)
        return
    with PostureServer(*link.listen, site.T_arm_camera) as server:
        yield server


class PostureServer:
    """Listens on `host`:`port` for one writer at a time; the newest connection takes its place.

    A line that is no posture ends the connection, and is told: what it was to say is not known.

    Parameters
    ----------
    host, port
        Where to listen; port 0 takes a free one, see `port`.
    T_arm_camera : (4, 4) array
        Of the site.
    """

    def __init__(self, host: str, port: int, T_arm_camera: F64) -> None:
        self.host, self.port, self._T = host, port, T_arm_camera
        self._told: deque[Posture] = deque(maxlen=REMEMBERED)
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

    def around(self, stamp_ns: int) -> tuple[Posture, ...]:
        """The last posture at or before a time and the first after it, where there are any."""
        with self._lock:
            told = list(self._told)
        after = bisect_right([posture.stamp_ns for posture in told], stamp_ns)
        return tuple(told[max(after - 1, 0) : after + 1])

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
                    self._add(parse_posture(line, self._T, f"posture from {address}"))
        except ConfigError as fault:
            _log.warning("%s; the connection is closed", fault)
        except OSError as fault:
            _log.info("posture from %s: %s", address, fault)

    def _add(self, posture: Posture) -> None:
        with self._lock:
            if self._told and posture.stamp_ns <= self._told[-1].stamp_ns:
                # The arm's clock was set back: what was told before is of another time.
                self._told.clear()
            self._told.append(posture)
