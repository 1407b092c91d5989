"""``stereo-ore serve``: frames as they arrive, targets to the arm's side."""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from stereo_ore.pipeline import Context
    from stereo_ore.plant.frames import LiveSource
    from stereo_ore.plant.loop import Process
    from stereo_ore.plant.sinks.base import TargetSink
    from stereo_ore.plant.sinks.message import Origin
    from stereo_ore.runs.folder import RunFolder

log = logging.getLogger(__name__)

SinksFile = Annotated[Path | None, typer.Option("--sinks", help="File of consumers: addresses, certificates, users.")]
OpcUaPort = Annotated[int | None, typer.Option("--opcua", min=1, max=65535, help="Serve OPC UA on this loopback port.")]
MqttPort = Annotated[int | None, typer.Option("--mqtt", min=1, max=65535, help="Port of a broker on this machine.")]
TcpPort = Annotated[int | None, typer.Option("--tcp", min=0, max=65535, help="Serve JSON lines on this loopback port.")]
ValidFor = Annotated[
    float, typer.Option("--valid-for", min=0.1, max=60, help="Seconds for which a frame's targets hold.")
]


def register(app: typer.Typer) -> None:
    """Add the verb to the command line."""
    app.command()(serve)


def serve(
    source: Annotated[Path | None, typer.Argument(help="A recording, served as if it were live.")] = None,
    watch: Annotated[Path | None, typer.Option("--watch", help="Folder in which frames appear.")] = None,
    camera: Annotated[int | None, typer.Option("--camera", min=0, help="UVC camera, both eyes side by side.")] = None,
    calib: Annotated[Path, typer.Option("--calib", help="Calibration of the camera.")] = ...,  # type: ignore[assignment]
    out: Annotated[Path, typer.Option("--out", help="Folder for the results; a run in it goes on.")] = ...,  # type: ignore[assignment]
    site: Annotated[Path | None, typer.Option(help="Site: arm, working volume, grizzly.")] = None,
    config: Annotated[Path | None, typer.Option(help="Parameters that differ from the defaults.")] = None,
    settings: Annotated[list[str] | None, typer.Option("--set", help="One parameter: key.sub=value.")] = None,
    sinks: SinksFile = None,
    opcua: OpcUaPort = None,
    mqtt: MqttPort = None,
    tcp: TcpPort = None,
    page: Annotated[int | None, typer.Option(min=0, max=65535, help="Live page on this loopback port.")] = None,
    valid_for: ValidFor = 5.0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a different run in --out.")] = False,
) -> None:
    """Frames as they arrive → records, and targets to the arm's side; stop with Ctrl-C.

    Each frame is recorded before it is published. Targets expire by themselves. Stopped or killed, the same command
    goes on where it was.

    Example: `stereo-ore serve --watch inbox --calib calib/zed2_hd720.yaml --site site.yaml --out live --opcua 4840`
    """
    from stereo_ore.plant.processing import Processor
    from stereo_ore.plant.sinks.message import Origin, transform_id
    from stereo_ore.plant.sinks.settings import load_sinks, open_sinks
    from stereo_ore.runs.folder import RunFolder
    from stereo_ore.runs.frame_files import FrameFiles
    from stereo_ore.runs.history import Watch

    consumers = open_sinks(load_sinks(sinks, opcua=opcua, mqtt=mqtt, tcp=tcp))
    context = _context(calib, site, config, settings or [])
    frames = _open(source, watch, camera, context)
    description = _description(frames.name, context, {"calib": calib, "site": site, "config": config})
    with RunFolder(out, description, resume=not overwrite, overwrite=overwrite) as folder:
        _write_inputs(out, context, site)
        origin = Origin(transform_id=transform_id(context.site.T_arm_camera))
        processor = Processor(context, FrameFiles(out), Watch(context.config.health, folder.earlier()))
        run_live(frames, processor, folder, consumers, origin, valid_for, page)


def run_live(
    source: LiveSource,
    process: Process,
    folder: RunFolder,
    consumers: list[TargetSink],
    origin: Origin,
    valid_for_s: float,
    page: int | None,
) -> None:
    """Serve until a signal or the end of the source; then give the folder its final names."""
    from stereo_ore.plant.loop import serve as serve_frames
    from stereo_ore.plant.page import LivePage
    from stereo_ore.plant.publisher import Publisher
    from stereo_ore.plant.status import Status

    stop = threading.Event()
    with Publisher(consumers, valid_for_s, origin) as publisher, _signals(stop), ExitStack() as stack:
        status = Status(source, publisher)
        if page is not None:
            typer.echo(f"live page: {stack.enter_context(LivePage(page, status, folder.folder)).url}", err=True)
        for state in publisher.states():
            log.info("%s: %s", state.name, state.address)
        done = serve_frames(source, process, folder, publisher, status, stop)
    folder.finish()
    typer.echo(f"{done} frames: {folder.folder}")


@contextmanager
def _signals(stop: threading.Event) -> Iterator[None]:
    """Ctrl-C and termination end the run after the frame in work; a second one at once."""

    def handle(number: int, frame: Any) -> None:
        log.warning("stopping after the frame in work")
        stop.set()
        signal.signal(number, signal.default_int_handler)

    earlier = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, action in earlier.items():
            signal.signal(number, action)


def _context(calib: Path, site: Path | None, config: Path | None, settings: list[str]) -> Context:
    from stereo_ore import pipeline
    from stereo_ore.io.calibration import load
    from stereo_ore.io.parameters import load_config
    from stereo_ore.io.site import load_site
    from stereo_ore.types import Site

    place = load_site(site) if site else Site()
    if place.T_arm_camera is None:
        log.warning("no arm_from_camera in a site file: frames are recorded, but no target is ever published as valid")
    return pipeline.make_context(load(calib), place, load_config(config, settings))


def _open(source: Path | None, watch: Path | None, camera: int | None, context: Context) -> LiveSource:
    from stereo_ore.io.recordings import limit_pixels, open_source
    from stereo_ore.plant.camera import open_camera
    from stereo_ore.plant.frames import Recording
    from stereo_ore.plant.watch import FolderWatch

    max_pixels = context.config.source.max_pixels
    match source, watch, camera:
        case Path(), None, None:
            return Recording(limit_pixels(open_source(source), max_pixels))
        case None, Path(), None:
            return FolderWatch(watch, max_pixels=max_pixels, eye_size=context.calibration.image_size)
        case None, None, int():
            return open_camera(camera, context.calibration.image_size)
    raise typer.BadParameter("give one of SOURCE, --watch and --camera")


def _description(source: str, context: Context, files: dict[str, Path | None]) -> dict[str, Any]:
    """What the run is made from; the same after a restart, so that it may go on."""
    from stereo_ore.runs.batch import sha256
    from stereo_ore.runs.folder import versions

    return {
        "schema": "stereo_ore/run/1",
        "versions": versions(),
        "source": source,
        "parameters": context.config.model_dump(mode="json"),
        "files": {key: {"path": str(path), "sha256": sha256(path)} for key, path in files.items() if path},
    }


def _write_inputs(out: Path, context: Context, site: Path | None) -> None:
    from stereo_ore.io.atomic import write_bytes, write_text
    from stereo_ore.io.calibration import dump
    from stereo_ore.io.parameters import dump_config

    write_text(out / "config.yaml", dump_config(context.config))
    write_text(out / "calibration.yaml", dump(context.calibration))
    if site:
        write_bytes(out / "site.yaml", site.read_bytes())
