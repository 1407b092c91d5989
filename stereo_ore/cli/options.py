"""Options that several verbs have."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from stereo_ore.config import Config

SiteFile = Annotated[
    Path | None, typer.Option("--site", help="Site: arm, working volume, grizzly.")
]
ParameterFile = Annotated[
    Path | None, typer.Option("--config", help="Parameters that differ from the defaults.")
]
Settings = Annotated[list[str] | None, typer.Option("--set", help="One parameter: key.sub=value.")]
ModelsFolder = Annotated[
    Path | None,
    typer.Option("--models", help="Folder of the network of lumps, not the shipped one."),
]
Clouds = Annotated[
    bool, typer.Option("--clouds/--no-clouds", help="Write clouds/FRAME.ply, filtered.")
]
Overlays = Annotated[
    bool, typer.Option("--overlays/--no-overlays", help="Write overlays/FRAME.png.")
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace a different run in --out.")]
LeftTopic = Annotated[
    str | None,
    typer.Option("--left-topic", help="Image topic of the left eye; default: as drivers name it."),
]
RightTopic = Annotated[
    str | None, typer.Option("--right-topic", help="Image topic of the right eye.")
]
MaxSkew = Annotated[
    float,
    typer.Option("--max-skew-ms", min=0, help="Largest difference of the stamps of a pair [ms]."),
]

SinksFile = Annotated[
    Path | None, typer.Option("--sinks", help="File of consumers: addresses, certificates, users.")
]
OpcUaPort = Annotated[
    int | None,
    typer.Option("--opcua", min=1, max=65535, help="Serve OPC UA on this loopback port."),
]
MqttPort = Annotated[
    int | None, typer.Option("--mqtt", min=1, max=65535, help="Port of a broker on this machine.")
]
TcpPort = Annotated[
    int | None,
    typer.Option("--tcp", min=0, max=65535, help="Serve JSON lines on this loopback port."),
]
ModbusPort = Annotated[
    int | None,
    typer.Option("--modbus", min=1, max=65535, help="Serve Modbus TCP on this loopback port."),
]
FoxglovePort = Annotated[
    int | None,
    typer.Option(
        "--foxglove", min=0, max=65535, help="Show clouds, ores, targets to Foxglove on this port."
    ),
]
ValidFor = Annotated[
    float,
    typer.Option("--valid-for", min=0.1, max=60, help="Seconds for which a frame's targets hold."),
]


def parameters_of(
    config: Path | None, settings: Sequence[str] | None, models: Path | None, *more: str
) -> Config:
    """Parameters of a file, of ``--set`` and of options that are short for one.

    Raises
    ------
    ConfigError
        For what is unknown or out of range.
    """
    from stereo_ore.io.parameters import load_config

    own = [f"models.lumps={json.dumps(str(models))}"] if models else []
    return load_config(config, [*(settings or ()), *own, *more])
