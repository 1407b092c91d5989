"""Targets on an OPC UA server; the nodes are in `opcua_model`."""

from __future__ import annotations

import asyncio
import hmac
import logging
import socket
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from stereo_ore.errors import MissingExtraError, OutputError
from stereo_ore.plant.sinks.base import Outbox, SinkState
from stereo_ore.plant.sinks.message import Message, Origin, notice
from stereo_ore.plant.sinks.opcua_model import CONTROL, NAMESPACE, PAYLOAD, Variable

if TYPE_CHECKING:
    from asyncua import Node, Server, ua

log = logging.getLogger(__name__)

APPLICATION_URI = "urn:stereo-ore:server"
PATH = "/stereo-ore"
HEARTBEAT_S = 0.5
STARTING_S = 60.0
RESTART_S = 2.0
METRE = 5067858
"""UNECE code of the metre, as OPC UA's EUInformation wants it."""


@dataclass(frozen=True)
class OpcUaSecurity:
    """Server certificate and key, trusted client certificates (a folder), passwords by user; None: any."""

    certificate: Path
    private_key: Path
    trusted: Path | None = None
    users: Mapping[str, str] | None = field(default=None, repr=False)


class OpcUaSink:
    """Serves targets at ``opc.tcp://host:port/stereo-ore`` from a thread with its own event loop.

    Clients can write nothing but the two nodes below ``Acknowledgement``.

    Parameters
    ----------
    host, port
        Where to listen.
    security : OpcUaSecurity, optional
        Without it connections are open and not encrypted: for this machine only, which the settings see to.
    """

    def __init__(self, host: str, port: int, security: OpcUaSecurity | None = None) -> None:
        try:
            import asyncua  # noqa: F401
        except ImportError:
            raise MissingExtraError("asyncua", "opcua") from None
        self.url = f"opc.tcp://{host}:{port}{PATH}"
        self._host, self._port, self._security = host, port, security
        self._outbox = Outbox()
        self._ready = threading.Event()
        self._fault: Exception | None = None
        self._sent = 0
        self._acknowledged = (0, 0)
        self._server: Server | None = None
        self._thread = threading.Thread(target=self._run, daemon=True, name="opcua")

    def __enter__(self) -> Self:
        try:
            socket.create_server((self._host, self._port)).close()
        except OSError as fault:
            remedy = "Is another program listening there?"
            raise OutputError(f"can't serve {self.url}: {fault.strerror}", key="opcua", remedy=remedy) from None
        self._thread.start()
        if not self._ready.wait(STARTING_S) or self._fault:
            remedy = "Are certificate and key what they should be?"
            raise OutputError(f"can't serve {self.url}: {self._fault or 'no answer'}", key="opcua", remedy=remedy)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._outbox.close()
        self._thread.join()

    def publish(self, message: Message) -> None:
        """Hand the message to the server's thread."""
        self._outbox.put(message)

    def state(self) -> SinkState:
        """Connected clients, messages written, and what the arm acknowledged last."""
        binary = self._server.bserver if self._server else None
        clients = len(binary.clients) if binary else 0
        sequence, target = self._acknowledged
        detail = f"acknowledged: message {sequence}, ore {target}" if sequence else "nothing acknowledged"
        detail = f"failed: {self._fault}" if self._fault else detail
        return SinkState("OPC UA", self.url, clients > 0, clients, self._sent, self._outbox.dropped, detail)

    def _run(self) -> None:
        """Serve until the outbox is closed; a server that fails after it was up is started again."""
        while not self._outbox.finished:
            try:
                self._fault = None
                asyncio.run(self._serve())
            except Exception as fault:
                self._fault = fault
                log.debug("OPC UA server", exc_info=True)
                if not self._ready.is_set():
                    break
                log.error("OPC UA server failed, starting again: %s", fault)
                time.sleep(RESTART_S)
        self._ready.set()

    async def _serve(self) -> None:
        server = await _make_server(self.url, self._security)
        nodes = await _add_nodes(server)
        await self._write(server, nodes, notice(0, Origin(), "starting"))
        async with server:
            self._server = server
            self._ready.set()
            beating = asyncio.create_task(self._beat(server, nodes))
            while not self._outbox.finished:
                message = await asyncio.to_thread(self._outbox.get, HEARTBEAT_S)
                if message is not None:
                    await self._write(server, nodes, message)
                    self._sent += 1
            beating.cancel()
            # Subscriptions publish at their own pace: what was written last must still reach them.
            await asyncio.sleep(HEARTBEAT_S)

    async def _write(self, server: Server, nodes: Mapping[str, Node], message: Message) -> None:
        """All values of a message, in the order of the model and with one timestamp."""
        now = datetime.now(UTC)
        for variable in PAYLOAD:
            value = _data_value(variable, variable.value(message), now)
            await _write(server, nodes[variable.name], value)

    async def _beat(self, server: Server, nodes: Mapping[str, Node]) -> None:
        """Count the heartbeat up, and look for acknowledgements, as long as the server's loop runs."""
        from asyncua import ua

        count = 0
        while True:
            count = (count + 1) % 2**32
            value = ua.DataValue(ua.Variant(count, ua.VariantType.UInt32), SourceTimestamp=datetime.now(UTC))
            await _write(server, nodes["Heartbeat"], value)
            acknowledged = [await nodes[name].read_value() for name in ("AcknowledgedSequence", "AcknowledgedTarget")]
            self._acknowledged = acknowledged[0], acknowledged[1]
            await asyncio.sleep(HEARTBEAT_S)


async def _write(server: Server, node: Node, value: ua.DataValue) -> None:
    """Set a value, or raise: a value left as it was beside new ones would be a torn message."""
    from asyncua import ua

    status = await server.iserver.aspace.write_attribute_value(node.nodeid, ua.AttributeIds.Value, value)
    status.check()


def _data_value(variable: Variable, value: Any, now: datetime) -> ua.DataValue:
    from asyncua import ua

    kind = ua.VariantType[variable.type]
    variant = ua.Variant(value, kind, is_array=isinstance(value, list))
    return ua.DataValue(variant, SourceTimestamp=now, ServerTimestamp=now)


async def _make_server(url: str, security: OpcUaSecurity | None) -> Server:
    from asyncua import Server, ua

    server = Server(user_manager=_Users(security.users if security else None))
    # Certificates first: a wrong one shows before the standard's thousands of nodes are made.
    if security is not None:
        await server.load_certificate(security.certificate)
        await server.load_private_key(security.private_key)
    await server.init()
    server.set_endpoint(url)
    server.set_server_name("stereo-ore")
    await server.set_application_uri(APPLICATION_URI)
    with_users = security is not None and security.users is not None
    server.set_identity_tokens([ua.UserNameIdentityToken if with_users else ua.AnonymousIdentityToken])
    kind = ua.SecurityPolicyType
    server.set_security_policy([kind.Basic256Sha256_SignAndEncrypt if security else kind.NoSecurity])
    if security is not None and security.trusted is not None:
        server.set_certificate_validator(await _validator(security.trusted))
    return server


async def _validator(trusted: Path) -> Any:
    """Accepts clients whose certificate is in the folder, within its dates and for its use."""
    from asyncua.crypto.truststore import TrustStore
    from asyncua.crypto.validator import CertificateValidator, CertificateValidatorOptions

    store = TrustStore([trusted], [])
    await store.load()
    options = CertificateValidatorOptions.TRUSTED_VALIDATION | CertificateValidatorOptions.PEER_CLIENT
    return CertificateValidator(options, store)


async def _add_nodes(server: Server) -> dict[str, Node]:
    """Folders and variables by name."""
    from asyncua import ua

    namespace = await server.register_namespace(NAMESPACE)
    root = await server.nodes.objects.add_object(ua.NodeId("StereoOre", namespace), f"{namespace}:StereoOre")
    folders = {}
    for name in ("Result", "Targets", "Acknowledgement"):
        folders[name] = await root.add_object(ua.NodeId(f"StereoOre.{name}", namespace), f"{namespace}:{name}")
    nodes = {}
    empty = notice(0, Origin(), "starting")
    for variable in (*PAYLOAD, *CONTROL):
        id = ua.NodeId(f"StereoOre.{variable.folder}.{variable.name}", namespace)
        value = _data_value(variable, variable.value(empty), datetime.now(UTC)).Value
        node = await folders[variable.folder].add_variable(id, f"{namespace}:{variable.name}", value)
        await _describe(node, variable, namespace)
        nodes[variable.name] = node
    return nodes


async def _describe(node: Node, variable: Variable, namespace: int) -> None:
    """Description, frame and unit as properties, and write access where the arm has it."""
    from asyncua import ua

    text = ua.DataValue(ua.Variant(ua.LocalizedText(variable.text), ua.VariantType.LocalizedText))
    await node.write_attribute(ua.AttributeIds.Description, text)
    if variable.name in ("Position", "Direction"):
        await node.add_property(namespace, "Frame", "arm")
    if variable.unit:
        code = METRE if variable.unit == "m" else -1
        unit = ua.EUInformation(
            NamespaceUri="http://www.opcfoundation.org/UA/units/un/cefact",
            UnitId=code,
            DisplayName=ua.LocalizedText(variable.unit),
        )
        await node.add_property(ua.NodeId(f"{node.nodeid.Identifier}.Unit", namespace), "0:EngineeringUnits", unit)
    if variable.folder == "Acknowledgement":
        await node.set_writable()


class _Users:
    """Who may connect: anybody without a list of users, else those on it with their password. Nobody is an admin."""

    def __init__(self, passwords: Mapping[str, str] | None) -> None:
        self._passwords = passwords

    def get_user(
        self, iserver: Any, username: str | None = None, password: str | None = None, certificate: Any = None
    ) -> Any:
        from asyncua.server.user_managers import User, UserRole

        if self._passwords is None:
            return User(role=UserRole.User)
        expected = self._passwords.get(username or "")
        if expected is None or not hmac.compare_digest(expected.encode(), (password or "").encode()):
            log.warning("OPC UA: login refused")
            return None
        return User(role=UserRole.User, name=username)
