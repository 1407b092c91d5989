"""``stereo-ore doctor``: whether this machine is ready to serve."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stereo_ore.cli.options import ModbusPort, MqttPort, OpcUaPort, SinksFile, TcpPort


def register(app: typer.Typer) -> None:
    """Add the verb to the command line."""
    app.command()(doctor)


def doctor(
    watch: Annotated[Path | None, typer.Option(help="Inbox, as `serve` is given it.")] = None,
    calib: Annotated[Path | None, typer.Option(help="Calibration.")] = None,
    site: Annotated[Path | None, typer.Option(help="Site file.")] = None,
    config: Annotated[Path | None, typer.Option(help="File of parameters.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the results.")] = None,
    sinks: SinksFile = None,
    opcua: OpcUaPort = None,
    mqtt: MqttPort = None,
    tcp: TcpPort = None,
    modbus: ModbusPort = None,
    page: Annotated[int | None, typer.Option(min=0, max=65535, help="Live page's port.")] = None,
) -> None:
    """Check installation, clock, disk, files, ports and a built-in frame; code 3 for a fault.

    Give it the options that `serve` is to be given. Nothing is changed.

    Example: `stereo-ore doctor --watch inbox --calib calib/zed2_hd720.yaml --site site.yaml --out
    live --opcua 4840`
    """
    from stereo_ore.cli import EXIT_QUALITY
    from stereo_ore.plant.doctor import Plan, examine

    given = {"opcua": opcua, "mqtt": mqtt, "tcp": tcp, "modbus": modbus}
    ports = tuple((name, port) for name, port in given.items() if port is not None)
    faults = 0
    for finding in examine(Plan(calib, site, config, watch, out, sinks, ports, page)):
        typer.echo(f"{finding.verdict:8} {finding.check}: {finding.text}")
        faults += finding.verdict == "fault"
    if faults:
        typer.echo(f"{faults} fault{'s' * (faults != 1)}", err=True)
        raise typer.Exit(EXIT_QUALITY)
