"""A server in a thread of its own that is watched: it is started again when it fails, and seen when
it hangs.
"""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections.abc import Callable, Coroutine
from typing import Any

from stereo_ore.errors import OutputError

_log = logging.getLogger(__name__)

STARTING_S = 60.0
RESTART_S = 1.0
SILENT_S = 2.0
"""A heartbeat older than this is an alarm."""


class Supervisor:
    """Runs the coroutine `serve` until `finished`; each end of it before that is a fault and
    followed by a new start.

    Parameters
    ----------
    name : str
        For messages.
    serve : callable
        One life of the server: calls `up` when it serves, and `beat` at least once a second from
        then on.
    finished : callable
        True when no further life is wanted.
    """

    def __init__(
        self,
        name: str,
        serve: Callable[[], Coroutine[Any, Any, None]],
        finished: Callable[[], bool],
    ) -> None:
        self.restarts = 0
        self._name, self._serve, self._finished = name, serve, finished
        self._ready = threading.Event()
        self._fault: Exception | None = None
        self._beaten = time.monotonic()
        self._thread = threading.Thread(target=self._run, daemon=True, name=name)

    def start(self, key: str, remedy: str) -> None:
        """Start, and wait until the server is up.

        Raises
        ------
        OutputError
            When it does not come up.
        """
        self._thread.start()
        if not self._ready.wait(STARTING_S) or self._fault:
            raise OutputError(
                f"can't serve {self._name}: {self._fault or 'no answer'}", key=key, remedy=remedy
            )

    def join(self) -> None:
        """Wait for the end."""
        self._thread.join()

    def up(self) -> None:
        """Tell that the server is there."""
        self.beat()
        self._fault = None
        self._ready.set()

    def beat(self) -> None:
        """Tell that the server's loop goes on."""
        self._beaten = time.monotonic()

    @property
    def alarm(self) -> str:
        """What is wrong with the server; empty while it serves."""
        if self._fault:
            return f"failed, starting again: {self._fault}"
        return f"no heartbeat for {self.silent_s:.0f} s" if self.silent_s > SILENT_S else ""

    @property
    def silent_s(self) -> float:
        """Age of the last heartbeat [s]."""
        return time.monotonic() - self._beaten

    def _run(self) -> None:
        while not self._finished():
            try:
                asyncio.run(self._serve())
            except Exception as fault:
                self._fault = _first(fault)
                _log.debug(self._name, exc_info=True)
                if not self._ready.is_set():
                    break
                self.restarts += 1
                _log.error("%s failed, starting again: %s", self._name, self._fault)
                time.sleep(RESTART_S)
        self._ready.set()


def _first(fault: BaseException) -> Exception:
    """What a group of tasks failed of."""
    while isinstance(fault, BaseExceptionGroup):
        fault = fault.exceptions[0]
    return fault if isinstance(fault, Exception) else RuntimeError(str(fault))
