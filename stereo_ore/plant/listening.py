"""A TCP socket of this program that others connect to."""

from __future__ import annotations

import logging
import socket
from collections.abc import Iterator

from stereo_ore.errors import OutputError

_log = logging.getLogger(__name__)

REMEDY = (
    "Is another program listening there? Ports below 1024 need a right to them"
    " (CAP_NET_BIND_SERVICE)"
)


def listen(host: str, port: int, key: str, waiting: int | None = None) -> socket.socket:
    """Listen at an address; port 0 takes a free one.

    Parameters
    ----------
    host, port
        Where to listen.
    key : str
        The setting that names the address, for the error.
    waiting : int, optional
        Connections that may wait to be accepted.

    Raises
    ------
    OutputError
        Where that can't be.
    """
    try:
        return socket.create_server((host, port), backlog=waiting)
    except OSError as fault:
        raise OutputError(
            f"can't listen on {host}:{port}: {fault.strerror}",
            key=key,
            remedy=REMEDY,
        ) from None


def connections(server: socket.socket) -> Iterator[tuple[socket.socket, tuple[str, int]]]:
    """Who connects, with the address it comes from, until `stop_listening`."""
    while True:
        try:
            yield server.accept()
        except OSError:
            return


def stop_listening(server: socket.socket) -> None:
    """Close the socket; a thread that waits for connections ends."""
    # A thread that waits in accept() is not woken by close() alone.
    try:
        server.shutdown(socket.SHUT_RDWR)
    except OSError:
        _log.debug("the listening socket can't be shut down on this system")
    server.close()
