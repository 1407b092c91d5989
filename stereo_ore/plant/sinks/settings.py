"""Which consumers get the targets: the sinks file, and what of it may leave this machine."""

from __future__ import annotations

import ipaddress
import os
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field, IPvAnyNetwork

from stereo_ore.config.validation import validate
from stereo_ore.errors import ConfigError
from stereo_ore.io.yaml_io import load_yaml, read_text
from stereo_ore.plant.posture import PostureInbox
from stereo_ore.plant.sinks.base import TargetSink
from stereo_ore.plant.sinks.message import Origin

LOOPBACK = "127.0.0.1"
Port = Annotated[int, Field(ge=1, le=65535)]


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class _Address(_Section):
    """A consumer at an address, which is this machine's unless a section says what guards it."""

    guards: ClassVar[tuple[str, ...]] = ()
    """Keys that must be given for an address beyond this machine; none: there is no such."""
    listens: ClassVar[bool] = True
    """Whether this program listens at the address."""

    host: str = LOOPBACK
    port: Annotated[int, Field(ge=0, le=65535)]


class OpcUaSettings(_Address):
    """An OPC UA server; beyond this machine only with certificate, key and users."""

    guards = ("certificate", "private_key", "users")
    port: Port = 4840
    certificate: Path | None = None
    private_key: Path | None = None
    trusted: Path | None = None
    users: Path | None = None


class MqttSettings(_Address):
    """A broker; beyond this machine only with TLS and a user."""

    guards = ("authority", "users")
    listens = False
    port: Port = 1883
    topic: str = Field("stereo_ore/targets", min_length=1, pattern=r"^[^+#\x00]+$")
    qos: Literal[0, 1] = 0
    authority: Path | None = None
    users: Path | None = None


class TcpSettings(_Address):
    """JSON lines; they are neither encrypted nor guarded, so they never leave this machine."""

    port: Annotated[int, Field(ge=0, le=65535)] = 5020


class ModbusSettings(_Address):
    """Modbus TCP, which knows neither users nor encryption; beyond this machine only for the
    clients that are named.
    """

    guards = ("clients",)
    port: Port = 502
    clients: tuple[IPvAnyNetwork, ...] = ()


class FoxgloveSettings(_Address):
    """A WebSocket for Foxglove, which never leaves this machine."""

    port: Annotated[int, Field(ge=0, le=65535)] = 8765


class Ros2Settings(_Section):
    """Topics of ROS 2, which knows neither users nor encryption: they stay on this machine unless
    ROS's own variables say otherwise.

    Without `camera_frame` it is called as the driver's images call it.
    """

    namespace: str = Field("stereo_ore", pattern=r"^/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*$")
    camera_frame: str | None = Field(None, pattern=r"^[A-Za-z_][\w/]*$")
    arm_frame: str = Field("arm_base_link", pattern=r"^[A-Za-z_][\w/]*$")


class SinksSettings(_Section):
    """All consumers; a section that is not given is off."""

    format: Literal["stereo_ore/sinks"] = "stereo_ore/sinks"
    version: Literal[1] = 1
    opcua: OpcUaSettings | None = None
    mqtt: MqttSettings | None = None
    tcp: TcpSettings | None = None
    modbus: ModbusSettings | None = None
    ros2: Ros2Settings | None = None
    foxglove: FoxgloveSettings | None = None


def load_sinks(path: Path | None, **ports: int | None) -> SinksSettings:
    """Settings of a file (None: no consumer), with consumers on this machine added by their port.

    Raises
    ------
    ConfigError
        For unknown keys, values out of range, and addresses beyond this machine without their
        safeguards.
    """
    data: dict[str, Any] = {} if path is None else load_yaml(path, ConfigError)
    given = {
        name: {"host": LOOPBACK, "port": port} for name, port in ports.items() if port is not None
    }
    origin = path or Path("command line")
    settings = validate(SinksSettings, {**data, **given}, origin, ConfigError)
    settings = _resolve(settings, path.parent if path else Path())
    _check_addresses(settings, origin)
    return settings


def with_ros2(settings: SinksSettings) -> SinksSettings:
    """The same consumers and topics of ROS 2, as the file has them or as they are by default."""
    return (
        settings
        if settings.ros2
        else settings.model_copy(update={"ros2": Ros2Settings.model_validate({})})
    )


def addresses(settings: SinksSettings) -> dict[str, _Address]:
    """The consumers that have an address, by their section's name."""
    return {name: part for name, part in settings if isinstance(part, _Address)}


def is_loopback(host: str) -> bool:
    """True for an address that only this machine can reach."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _resolve(settings: SinksSettings, folder: Path) -> SinksSettings:
    """Paths as seen from the file that names them."""

    def section(part: Any) -> Any:
        paths = {name: folder / value for name, value in part if isinstance(value, Path)}
        return part.model_copy(update=paths)

    return settings.model_copy(
        update={name: section(part) for name, part in settings if isinstance(part, _Section)}
    )


def _check_addresses(settings: SinksSettings, origin: Path) -> None:
    for name, part in addresses(settings).items():
        missing = [f"{name}.{key}" for key in part.guards if not getattr(part, key)]
        if is_loopback(part.host) or (part.guards and not missing):
            continue
        remedy = "It is not guarded: use 127.0.0.1 and a tunnel, or OPC UA"
        if missing:
            remedy = f"Give {', '.join(missing)}, or use 127.0.0.1"
        problem = f"{part.host} is beyond this machine"
        raise ConfigError(problem, file=origin, key=f"{name}.host", remedy=remedy)
    if settings.opcua and (settings.opcua.certificate is None) != (
        settings.opcua.private_key is None
    ):
        raise ConfigError(
            "certificate and private_key belong together",
            file=origin,
            key="opcua",
            remedy="Give both",
        )
    if settings.opcua and settings.opcua.users and settings.opcua.certificate is None:
        remedy = "Give opcua.certificate and opcua.private_key"
        raise ConfigError(
            "passwords need encryption", file=origin, key="opcua.users", remedy=remedy
        )


def read_users(path: Path) -> dict[str, str]:
    """Passwords by user from lines ``name:password``; the file must be readable by its owner only.

    Blanks around name and password are no part of them, so that ``name: password`` is what it looks
    like.
    """
    text = read_text(path, ConfigError)
    if os.name == "posix" and path.stat().st_mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise ConfigError(
            "holds passwords but others may read it", file=path, remedy=f"chmod 600 {path}"
        )
    users: dict[str, str] = {}
    for number, line in enumerate(text.splitlines(), 1):
        name, colon, password = (part.strip() for part in line.partition(":"))
        if line.strip() and not (name and colon and password):
            raise ConfigError(
                f"line {number} is not name:password", file=path, remedy="One user a line"
            )
        if line.strip():
            users[name] = password
    if not users:
        raise ConfigError("names no user", file=path, remedy="One line a user: name:password")
    return users


def open_sinks(
    settings: SinksSettings,
    origin: Origin = Origin(),  # noqa: B008
    postures: PostureInbox | None = None,
) -> list[TargetSink]:
    """A sink for each consumer in the settings, not yet entered.

    Parameters
    ----------
    settings : SinksSettings
        Which there are.
    origin : Origin
        What all messages will share.
    postures : PostureInbox, optional
        Takes in the arm's posture, which its side writes into the OPC UA server.

    Raises
    ------
    ConfigError
        For postures and no OPC UA server.
    """
    if postures is not None and settings.opcua is None:
        raise ConfigError(
            "the arm's posture is to be written into the OPC UA server, and there is none",
            key="posture.opcua",
            remedy="Give --opcua PORT, or a section opcua in the sinks file",
        )
    return [
        make(part, origin, postures)
        for name, make in MAKERS.items()
        if (part := getattr(settings, name)) is not None
    ]


def _opcua(settings: OpcUaSettings, origin: Origin, postures: PostureInbox | None) -> TargetSink:
    from stereo_ore.plant.sinks.opcua import OpcUaSecurity, OpcUaSink

    security = None
    if settings.certificate and settings.private_key:
        users = read_users(settings.users) if settings.users else None
        security = OpcUaSecurity(
            settings.certificate, settings.private_key, settings.trusted, users
        )
    take = None if postures is None else postures.take
    return OpcUaSink(settings.host, settings.port, security, origin, take)


def _mqtt(settings: MqttSettings, origin: Origin, _: PostureInbox | None) -> TargetSink:
    from stereo_ore.plant.sinks.mqtt import MqttLogin, MqttSink

    user, password = (
        next(iter(read_users(settings.users).items())) if settings.users else (None, None)
    )
    login = MqttLogin(user, password, settings.authority)
    return MqttSink(
        settings.host, settings.port, settings.topic, login, qos=settings.qos, origin=origin
    )


def _tcp(settings: TcpSettings, origin: Origin, _: PostureInbox | None) -> TargetSink:
    from stereo_ore.plant.sinks.tcp import TcpSink

    return TcpSink(settings.host, settings.port)


def _modbus(settings: ModbusSettings, origin: Origin, _: PostureInbox | None) -> TargetSink:
    from stereo_ore.plant.sinks.modbus import ModbusSink

    return ModbusSink(settings.host, settings.port, settings.clients, origin)


MAKERS: dict[str, Callable[[Any, Origin, PostureInbox | None], TargetSink]] = {
    "opcua": _opcua,
    "mqtt": _mqtt,
    "tcp": _tcp,
    "modbus": _modbus,
}
"""To add a consumer: its section in `SinksSettings` and its line here. An `_Address` without
`guards` stays on this machine."""
