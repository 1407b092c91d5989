"""Targets on an OPC UA server; the nodes are in `opcua_model`."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from stereo_ore.errors import MissingExtraError
from stereo_ore.plant.listening import listen
from stereo_ore.plant.sinks.base import Outbox, SinkState
from stereo_ore.plant.sinks.message import Message, Origin, notice
from stereo_ore.plant.sinks.opcua_access import Users, guard
from stereo_ore.plant.sinks.opcua_model import (
    CONTROL,
    MODEL,
    NAMESPACE,
    NO_TIME,
    PAYLOAD,
    POSTURE,
    WRITTEN_FOLDERS,
    Variable,
)
from stereo_ore.plant.sinks.opcua_nodeset import nodeset
from stereo_ore.plant.sinks.opcua_posture import PostureDesk, TakePosture
from stereo_ore.plant.sinks.supervisor import Supervisor
from stereo_ore.version import __version__

if TYPE_CHECKING:
    from asyncua import Node, Server, ua

APPLICATION_URI = "urn:stereo-ore:server"
_PRODUCT_URI = "urn:stereo-ore"
PATH = "/stereo-ore"
HEARTBEAT_S = 0.5


@dataclass(frozen=True)
class OpcUaSecurity:
    """Server certificate and key, trusted client certificates (a folder), passwords by user; None:
    any.
    """

    certificate: Path
    private_key: Path
    trusted: Path | None = None
    users: Mapping[str, str] | None = field(default=None, repr=False)


class OpcUaSink:
    """Serves targets at ``opc.tcp://host:port/stereo-ore`` from a thread with its own event loop.

    Clients can write nothing but the two nodes below ``Acknowledgement``, and those below
    ``Posture`` where somebody takes what is written there.

    Parameters
    ----------
    host, port
        Where to listen.
    security : OpcUaSecurity, optional
        Without it connections are open and not encrypted: for this machine only, which the settings
        see to.
    origin : Origin
        What all messages share.
    take_posture : TakePosture, optional
        Where the arm's postures go that clients write.
    """

    def __init__(
        self,
        host: str,
        port: int,
        security: OpcUaSecurity | None = None,
        origin: Origin = Origin(),  # noqa: B008
        take_posture: TakePosture | None = None,
    ) -> None:
        try:
            import asyncua  # noqa: F401
        except ImportError:
            raise MissingExtraError("asyncua", "opcua") from None
        self.url = f"opc.tcp://{host}:{port}{PATH}"
        self._host, self._port, self._security = host, port, security
        self._take_posture = take_posture
        self._desk: PostureDesk | None = None
        self._outbox = Outbox()
        self._latest = notice(0, origin, "starting")
        self._sent = 0
        self._acknowledged = (0, 0)
        self._server: Server | None = None
        self._supervisor = Supervisor(
            f"OPC UA at {self.url}", self._serve, lambda: self._outbox.finished
        )

    def __enter__(self) -> Self:
        listen(self._host, self._port, "opcua").close()
        self._supervisor.start("opcua", "Are certificate and key what they should be?")
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._outbox.close()
        self._supervisor.join()

    def publish(self, message: Message) -> None:
        """Hand the message to the server's thread."""
        self._outbox.put(message)

    def state(self) -> SinkState:
        """Connected clients, messages written, what the arm acknowledged last and what became of
        its posture, and whether the server is in order.
        """
        binary = self._server.bserver if self._server else None
        clients = len(binary.clients) if binary else 0
        sequence, target = self._acknowledged
        detail = (
            f"acknowledged: message {sequence}, ore {target}"
            if sequence
            else "nothing acknowledged"
        )
        detail += f"; {self._desk.told}" if self._desk else ""
        count = self._sent, self._outbox.dropped
        watched = self._supervisor.alarm, self._supervisor.restarts
        return SinkState("OPC UA", self.url, clients > 0, clients, *count, detail, *watched)

    async def _serve(self) -> None:
        """One life of the server: it ends when the outbox is finished, or with the fault of any of
        its tasks.
        """
        server = await _make_server(self.url, self._security)
        nodes = await _add_nodes(server)
        await self._open(server, nodes)
        await self._write(server, nodes, self._latest.current())
        async with server:
            self._server = server
            self._supervisor.up()
            async with asyncio.TaskGroup() as tasks:
                beating = tasks.create_task(self._beat(server, nodes))
                while not self._outbox.finished:
                    message = await asyncio.to_thread(self._take)
                    if message is not None:
                        await self._write(server, nodes, message)
                        self._sent += 1
                beating.cancel()
            # Subscriptions publish at their own pace: what was written last must still reach them.
            await asyncio.sleep(HEARTBEAT_S)

    async def _open(self, server: Server, nodes: Mapping[str, Node]) -> None:
        """Let clients write what somebody wants to know, and no more."""
        self._desk = None
        if self._take_posture is not None:
            self._desk = PostureDesk(server, nodes, self._take_posture)
        else:
            for variable in POSTURE:
                await nodes[variable.name].set_read_only()
        writable = {nodes[v.name].nodeid: v for v in MODEL if v.folder in WRITTEN_FOLDERS}
        guard(server, writable, self._desk)

    def _take(self) -> Message | None:
        """The next message; it is kept, for a server that fails before it has written it."""
        message = self._outbox.get(HEARTBEAT_S)
        self._latest = message or self._latest
        return message

    async def _write(self, server: Server, nodes: Mapping[str, Node], message: Message) -> None:
        """All values of a message, in the order of the model and with one timestamp."""
        now = datetime.now(UTC)
        for variable in PAYLOAD:
            certain = variable.certain or message.valid
            value = _data_value(variable, variable.value(message), now, certain)
            await _write(server, nodes[variable.name], value)

    async def _beat(self, server: Server, nodes: Mapping[str, Node]) -> None:
        """Count the heartbeat up, and look for acknowledgements, as long as the server's loop
        runs.
        """
        heartbeat, *acknowledgements = CONTROL
        count = 0
        while True:
            count = (count + 1) % 2**32
            await _write(
                server, nodes[heartbeat.name], _data_value(heartbeat, count, datetime.now(UTC))
            )
            self._supervisor.beat()
            sequence, target = (
                _whole_number(server, nodes[variable.name]) for variable in acknowledgements
            )
            self._acknowledged = sequence, target
            await asyncio.sleep(HEARTBEAT_S)


async def _write(server: Server, node: Node, value: ua.DataValue) -> None:
    """Set a value, or raise: a value left as it was beside new ones would be a torn message."""
    from asyncua import ua

    status = await server.iserver.aspace.write_attribute_value(
        node.nodeid, ua.AttributeIds.Value, value
    )
    status.check()


def _data_value(
    variable: Variable, value: Any, now: datetime, certain: bool = True
) -> ua.DataValue:
    """A value of the model; Uncertain keeps the value for the client, where Bad would make it
    null.
    """
    from asyncua import ua

    variant = ua.Variant(value, ua.VariantType[variable.type], is_array=isinstance(value, list))
    status = ua.StatusCode(ua.StatusCodes.Good if certain else ua.StatusCodes.Uncertain)
    return ua.DataValue(variant, StatusCode=status, SourceTimestamp=now, ServerTimestamp=now)


def _whole_number(server: Server, node: Node) -> int:
    """What a client has written last; 0 for anything but a whole number of good quality."""
    from asyncua import ua

    value = server.iserver.aspace.read_attribute_value(node.nodeid, ua.AttributeIds.Value)
    good = value.StatusCode is None or value.StatusCode.is_good()
    return value.Value.Value if good and type(value.Value.Value) is int else 0


async def _make_server(url: str, security: OpcUaSecurity | None) -> Server:
    from asyncua import Server, ua

    server = Server(user_manager=Users(security.users if security else None))
    # Certificates first: a wrong one shows before the standard's thousands of nodes are made.
    if security is not None:
        await server.load_certificate(security.certificate)
        await server.load_private_key(security.private_key)
    await server.init()
    server.set_endpoint(url)
    server.set_server_name("stereo-ore")
    await server.set_build_info(
        _PRODUCT_URI, "stereo-ore", "stereo-ore", __version__, __version__, NO_TIME
    )
    await server.set_application_uri(APPLICATION_URI)
    with_users = security is not None and security.users is not None
    server.set_identity_tokens(
        [ua.UserNameIdentityToken if with_users else ua.AnonymousIdentityToken]
    )
    kind = ua.SecurityPolicyType
    server.set_security_policy(
        [kind.Basic256Sha256_SignAndEncrypt if security else kind.NoSecurity]
    )
    if security is not None and security.trusted is not None:
        server.set_certificate_validator(await _validator(security.trusted))
    return server


async def _validator(trusted: Path) -> Any:
    """Accepts clients whose certificate is in the folder, within its dates and for its use."""
    from asyncua.crypto.truststore import TrustStore
    from asyncua.crypto.validator import CertificateValidator, CertificateValidatorOptions

    store = TrustStore([trusted], [])
    await store.load()
    options = (
        CertificateValidatorOptions.TRUSTED_VALIDATION | CertificateValidatorOptions.PEER_CLIENT
    )
    return CertificateValidator(options, store)


async def _add_nodes(server: Server) -> dict[str, Node]:
    """The nodes of the model by name, made from the NodeSet2 file that other tools import."""
    from asyncua import ua

    namespace = await server.register_namespace(NAMESPACE)
    await server.import_xml(xmlstring=nodeset())
    names = {v.name: f"StereoOre.{v.folder}.{v.name}" for v in MODEL}
    nodes = {name: server.get_node(ua.NodeId(id, namespace)) for name, id in names.items()}
    now, nothing = datetime.now(UTC), notice(0, Origin(), "starting")
    for variable in (*CONTROL, *POSTURE):
        value = _data_value(variable, variable.value(nothing), now, variable.certain)
        await _write(server, nodes[variable.name], value)
    return nodes
