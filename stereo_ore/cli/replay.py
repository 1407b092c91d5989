"""``stereo-ore replay``: recorded results to the arm's side, marked as a replay."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from stereo_ore.cli.options import (
    FoxglovePort,
    ModbusPort,
    MqttPort,
    OpcUaPort,
    SinksFile,
    TcpPort,
    ValidFor,
)
from stereo_ore.cli.ros2 import Ros2Out, topics_out


def register(app: typer.Typer) -> None:
    """Add the verb to the command line."""
    app.command()(replay)


def replay(
    folder: Annotated[Path, typer.Argument(help="Folder of a run.")],
    rate: Annotated[
        float | None, typer.Option(min=0.01, help="Frames a second; default: as recorded.")
    ] = None,
    speed: Annotated[float, typer.Option(min=0.01, help="Times the recorded speed.")] = 1.0,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print the messages at once, send nothing.")
    ] = False,
    sinks: SinksFile = None,
    opcua: OpcUaPort = None,
    mqtt: MqttPort = None,
    tcp: TcpPort = None,
    modbus: ModbusPort = None,
    ros2_out: Ros2Out = False,
    foxglove: FoxglovePort = None,
    valid_for: ValidFor = 5.0,
) -> None:
    """Publish the targets of a recorded run again, as `serve` does; every message says that it is a
    replay.

    Example: `stereo-ore replay out --rate 2 --opcua 4840`
    """
    from stereo_ore.plant.publisher import Publisher
    from stereo_ore.plant.replay import frames, saved_transform, schedule
    from stereo_ore.plant.ros2.view import View
    from stereo_ore.plant.sinks.message import Origin, message, new_session, transform_id
    from stereo_ore.plant.sinks.settings import load_sinks, open_sinks, with_ros2

    settings = load_sinks(sinks, opcua=opcua, mqtt=mqtt, tcp=tcp, modbus=modbus, foxglove=foxglove)
    settings = with_ros2(settings) if ros2_out else settings
    origin = Origin(new_session(), transform_id(saved_transform(folder)), replay=True)
    if dry_run:
        for sequence, record in enumerate(frames(folder), 1):
            typer.echo(message(record, sequence, origin, age_s=0.0, valid_for_s=valid_for).line())
        return
    consumers = open_sinks(settings, origin)
    if settings.ros2 is not None or settings.foxglove is not None:
        consumers += topics_out(settings, View.of_folder(folder, valid_for))
    if not consumers:
        raise typer.BadParameter(
            "name a consumer: --opcua, --mqtt, --modbus, --tcp, --ros2-out, --foxglove or --sinks;"
            " or --dry-run"
        )
    with Publisher(consumers, valid_for, origin) as publisher:
        start = time.monotonic()
        for due_s, record in schedule(folder, rate, speed):
            time.sleep(max(0.0, start + due_s - time.monotonic()))
            publisher.publish(record, age_s=0.0)
            publisher.show_files(record)
        # The last targets run out as they would have.
        time.sleep(valid_for)
