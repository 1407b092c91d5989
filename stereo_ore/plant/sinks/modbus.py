"""Targets on a Modbus TCP server; the registers are in `modbus_table`."""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from stereo_ore.errors import MissingExtraError, OutputError
from stereo_ore.plant.listening import REMEDY, listen
from stereo_ore.plant.sinks.base import SinkState
from stereo_ore.plant.sinks.message import Message, Origin, notice
from stereo_ore.plant.sinks.modbus_table import (
    ACKNOWLEDGEMENT,
    ACKNOWLEDGEMENT_WORDS,
    READABLE_WORDS,
    acknowledged,
    words,
)
from stereo_ore.plant.sinks.supervisor import Supervisor

if TYPE_CHECKING:
    from pymodbus.constants import ExcCodes

_log = logging.getLogger(__name__)

MODBUS_HEARTBEAT_S = 0.5
FUNCTIONS = (3, 4, 6, 16, 22, 23)
"""Read registers of either kind; write one, several, bits of one; write and read. There are no
coils."""
MODBUS_CONSUMERS = 16
IDLE_S = 10.0
"""A master that has asked nothing for this time gives its place to one waiting."""

_Network = ipaddress.IPv4Network | ipaddress.IPv6Network


class ModbusSink:
    """Serves the latest targets at `host`:`port`, to every device number; only the acknowledgement
    can be written.

    Registers are made when they are read, so the remaining time is that of the answer, and one
    request is never torn.

    Parameters
    ----------
    host, port
        Where to listen.
    clients : sequence of networks
        Addresses that may connect; empty: any, for a server on this machine only.
    origin : Origin
        What messages share, for the time before the first.
    """

    def __init__(
        self,
        host: str,
        port: int,
        clients: Sequence[_Network] = (),
        origin: Origin = Origin(),  # noqa: B008
    ) -> None:
        try:
            import pymodbus  # noqa: F401
        except ImportError:
            raise MissingExtraError("pymodbus", "modbus") from None
        self.address = f"{host}:{port}"
        self._host, self._port, self._clients = host, port, tuple(clients)
        self._latest = notice(0, origin, "starting")
        self._sent = self._refused = self._beats = 0
        self._closed = False
        self._registers: list[int] = []
        self._asked: dict[asyncio.Transport, float] = {}
        self._supervisor = Supervisor(
            f"Modbus TCP at {self.address}", self._serve, lambda: self._closed
        )

    def __enter__(self) -> Self:
        listen(self._host, self._port, "modbus").close()
        self._supervisor.start("modbus", REMEDY)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._closed = True
        self._supervisor.join()

    def publish(self, message: Message) -> None:
        """Make the message the one that is read from now on."""
        self._latest = message
        self._sent += 1

    def state(self) -> SinkState:
        """Connected masters, messages shown, what the arm acknowledged last, and whether the server
        is in order.
        """
        clients = len(self._asked)
        written = self._registers[ACKNOWLEDGEMENT : ACKNOWLEDGEMENT + ACKNOWLEDGEMENT_WORDS]
        sequence, target = acknowledged(written) if written else (0, 0)
        detail = (
            f"acknowledged: message {sequence}, ore {target}"
            if sequence
            else "nothing acknowledged"
        )
        detail += f"; {self._refused} connections refused" if self._refused else ""
        watched = self._supervisor.alarm, self._supervisor.restarts
        return SinkState(
            "Modbus TCP", self.address, clients > 0, clients, self._sent, 0, detail, *watched
        )

    async def _serve(self) -> None:
        """One life of the server."""
        from pymodbus.server import ModbusTcpServer
        from pymodbus.simulator import DataType, SimData, SimDevice

        registers = DataType.REGISTERS
        table = [
            SimData(0, values=0, count=READABLE_WORDS, datatype=registers, readonly=True),
            SimData(ACKNOWLEDGEMENT, values=0, count=ACKNOWLEDGEMENT_WORDS, datatype=registers),
        ]
        server = ModbusTcpServer(
            SimDevice(0, simdata=table, action=self._access), address=(self._host, self._port)
        )
        server.callback_new_connection = self._guarded(server.callback_new_connection)
        await server.serve_forever(background=True)
        try:
            self._supervisor.up()
            while not self._closed:
                if not server.is_active():
                    raise OutputError("no longer listens", key="modbus")
                self._beats += 1
                self._supervisor.beat()
                await asyncio.sleep(MODBUS_HEARTBEAT_S)
            # Masters poll: what was published last must still reach them.
            await asyncio.sleep(MODBUS_HEARTBEAT_S)
        finally:
            await server.shutdown()
            self._asked.clear()

    async def _access(
        self,
        function: int,
        start: int,
        address: int,
        count: int,
        registers: list[int],
        values: list[int] | None,
    ) -> ExcCodes | None:
        """Fill the table in for a request, just before it is answered."""
        from pymodbus.constants import ExcCodes

        if function not in FUNCTIONS:
            return ExcCodes.ILLEGAL_FUNCTION
        self._registers = registers
        if values is None:
            registers[:READABLE_WORDS] = words(self._latest, self._beats)
        return None

    def _guarded(self, make: Callable[[], Any]) -> Callable[[], Any]:
        """Handlers of connections that are noted while they last, and ended at once where they are
        not welcome.
        """

        def handler() -> Any:
            made = make()
            accept, take, leave = made.connection_made, made.data_received, made.connection_lost

            def connection_made(transport: asyncio.Transport) -> None:
                accept(transport)
                if self._welcome(transport.get_extra_info("peername")[0]):
                    self._asked[transport] = time.monotonic()
                else:
                    self._refused += 1
                    transport.abort()

            def data_received(data: bytes) -> None:
                if made.transport in self._asked:
                    self._asked[made.transport] = time.monotonic()
                    take(data)

            def connection_lost(fault: Exception | None) -> None:
                self._asked.pop(made.transport, None)
                leave(fault)

            made.connection_made, made.data_received = connection_made, data_received
            made.connection_lost = connection_lost
            return made

        return handler

    def _welcome(self, peer: str) -> bool:
        address = ipaddress.ip_address(peer.partition("%")[0])
        if self._clients and not any(address in network for network in self._clients):
            _log.warning("Modbus TCP: %s is not among modbus.clients: refused", peer)
            return False
        if len(self._asked) < MODBUS_CONSUMERS:
            return True
        longest = min(self._asked, key=lambda transport: self._asked[transport])
        if time.monotonic() - self._asked[longest] < IDLE_S:
            _log.warning(
                "Modbus TCP: %d masters are connected, %s is refused", MODBUS_CONSUMERS, peer
            )
            return False
        _log.warning("Modbus TCP: a master that asks nothing makes room for %s", peer)
        del self._asked[longest]
        longest.abort()
        return True
