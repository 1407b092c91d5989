"""``stereo-ore serve``: frames as they arrive, targets to the arm's side."""

from __future__ import annotations

import hashlib
import logging
import re
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stereo_ore.cli.options import (
    Clouds,
    FoxglovePort,
    LeftTopic,
    MaxSkew,
    ModbusPort,
    ModelsFolder,
    MqttPort,
    OpcUaPort,
    Overlays,
    Overwrite,
    ParameterFile,
    RightTopic,
    Settings,
    SinksFile,
    SiteFile,
    TcpPort,
    ValidFor,
    parameters_of,
)
from stereo_ore.cli.ros2 import Ros2Out, live_view, open_live, topics_out

if TYPE_CHECKING:
    from stereo_ore.plant.frames import LiveSource
    from stereo_ore.plant.live_folder import LiveFolder
    from stereo_ore.plant.loop import Process
    from stereo_ore.plant.retention import Retention
    from stereo_ore.plant.sinks.base import TargetSink
    from stereo_ore.plant.sinks.message import Origin
    from stereo_ore.types import StereoCalibration

_log = logging.getLogger(__name__)

RECENT = 1000
"""Frames of a run that goes on, by which the next is judged."""
_ONE_SOURCE = "give one of SOURCE, --watch, --camera and --ros2"
"""What is wrong with none of them, and with two."""


class Age(StrEnum):
    """What tells the age of a frame in a watched folder."""

    FILES = "files"
    ARRIVAL = "arrival"


@dataclass(frozen=True)
class Folder:
    """A folder that is watched: how many of its frames may wait, and whether its files' times are
    trusted.
    """

    path: Path
    queue: int
    trust_times: bool


@dataclass(frozen=True)
class Live:
    """What a live run is made of."""

    source: LiveSource
    process: Process
    folder: LiveFolder
    consumers: list[TargetSink]
    origin: Origin
    valid_for_s: float
    fault: Callable[[], str] = str
    retention: Retention | None = None


def register(app: typer.Typer) -> None:
    """Add the verb to the command line."""
    app.command()(serve)


def serve(
    source: Annotated[
        Path | None, typer.Argument(help="A recording, served as if it were live.")
    ] = None,
    watch: Annotated[
        Path | None, typer.Option("--watch", help="Folder in which frames appear.")
    ] = None,
    camera: Annotated[
        int | None, typer.Option("--camera", min=0, help="UVC camera, both eyes side by side.")
    ] = None,
    ros2: Annotated[
        bool, typer.Option("--ros2", help="Topics of a camera's ROS 2 driver.")
    ] = False,
    left_topic: LeftTopic = None,
    right_topic: RightTopic = None,
    max_skew_ms: MaxSkew = 5.0,
    calib: Annotated[
        Path | None,
        typer.Option("--calib", help="Calibration of the camera; bags and topics have their own."),
    ] = None,
    out: Annotated[
        Path, typer.Option("--out", help="Folder for the results; a run in it goes on.")
    ] = ...,  # type: ignore[assignment]
    site: SiteFile = None,
    config: ParameterFile = None,
    settings: Settings = None,
    models: ModelsFolder = None,
    sinks: SinksFile = None,
    opcua: OpcUaPort = None,
    mqtt: MqttPort = None,
    tcp: TcpPort = None,
    modbus: ModbusPort = None,
    ros2_out: Ros2Out = False,
    foxglove: FoxglovePort = None,
    size: Annotated[
        str | None,
        typer.Option(
            metavar="WxH",
            help="Pixels of one eye, for a calibration file of several; default: as seen.",
        ),
    ] = None,
    page: Annotated[
        int | None, typer.Option(min=0, max=65535, help="Live page on this loopback port.")
    ] = None,
    page_name: Annotated[
        list[str] | None,
        typer.Option(
            "--page-name",
            help="Name under which a reverse proxy on this machine shows the live page.",
        ),
    ] = None,
    valid_for: ValidFor = 5.0,
    queue: Annotated[
        int,
        typer.Option(
            min=0,
            help="Frames that may wait; with more the newest is next and older ones are recorded"
            " as skipped. 0: none is skipped.",
        ),
    ] = 2,
    age: Annotated[
        Age,
        typer.Option(
            help="Frames of --watch are as old as their names and files say, or as their arrival:"
            " for a share whose clock is another.",
        ),
    ] = Age.FILES,
    keep: Annotated[
        list[str] | None,
        typer.Option(
            "--keep",
            metavar="KIND=LIMIT",
            help="Remove older ones of clouds, overlays, pictures, records or inbox:"
            " clouds=7d,20GB. Repeatable.",
        ),
    ] = None,
    clouds: Clouds = True,
    overlays: Overlays = True,
    overwrite: Overwrite = False,
) -> None:
    """Frames as they arrive → records, and targets to the arm's side; stop with Ctrl-C.

    Each frame is recorded before it is published. Targets expire by themselves. Stopped or killed,
    the same command goes on where it was.

    Example: `stereo-ore serve --watch inbox --calib calib/zed2_hd720.yaml --site site.yaml --out
    live --opcua 4840`
    """
    from stereo_ore.chain import Chain
    from stereo_ore.cli.run import announce
    from stereo_ore.io.posture import recorded_postures
    from stereo_ore.io.site import load_site
    from stereo_ore.plant.live_files import LiveFiles
    from stereo_ore.plant.live_folder import LiveFolder
    from stereo_ore.plant.loop import processing
    from stereo_ore.plant.posture import live_postures, posture_server, written_by_opcua
    from stereo_ore.plant.retention import Retention, parse_limits
    from stereo_ore.plant.sinks.message import Origin, new_session, transform_id
    from stereo_ore.plant.sinks.settings import load_sinks, open_sinks, with_ros2
    from stereo_ore.plant.watch import FolderWatch
    from stereo_ore.runs.driver import Driver
    from stereo_ore.runs.history import Watch
    from stereo_ore.runs.identity import InputFiles, description, write_inputs
    from stereo_ore.types import Site

    limits = parse_limits(keep or ())
    consumer_settings = load_sinks(
        sinks, opcua=opcua, mqtt=mqtt, tcp=tcp, modbus=modbus, foxglove=foxglove
    )
    consumer_settings = with_ros2(consumer_settings) if ros2_out else consumer_settings
    parameters = parameters_of(config, settings, models)
    eye, most = _size(size), parameters.source.max_pixels
    watched = Folder(watch, queue, age is Age.FILES) if watch else None
    if ros2:
        _only_topics(source, watch, camera)
        frames, calibration = open_live((left_topic, right_topic), max_skew_ms, calib, eye, most)
    else:
        frames, calibration = _open(source, watched, camera, calib, eye, most)
    place = load_site(site) if site else Site()
    told = live_postures(place)
    chain = Chain(calibration, place, parameters, told or recorded_postures(place))
    announce(chain)
    origin = Origin(new_session(), transform_id(chain.site.T_arm_camera))
    consumers = open_sinks(consumer_settings, origin, written_by_opcua(place, told))
    consumers += topics_out(
        consumer_settings, live_view(out, chain, valid_for, getattr(frames, "frame_id", ""))
    )
    inputs = InputFiles(calib, site, config)
    about = description(frames.name, chain, inputs, **_own_calibration(ros2, calib, calibration))
    with (
        _alone(watch),
        posture_server(place, told),
        LiveFolder(
            out, about, lambda: write_inputs(out, chain, inputs), overwrite=overwrite
        ) as folder,
    ):
        watcher = Watch(parameters, chain.site, folder.recent(RECENT))
        files = LiveFiles(out, clouds=clouds, overlays=overlays)
        process = processing(Driver(chain, files, unattended=True), watcher)
        live = Live(frames, process, folder, consumers, origin, valid_for)
        live = replace(live, fault=lambda: folder.alarm or files.room.fault)
        if limits:
            done = frames.inbox.handled if isinstance(frames, FolderWatch) else tuple
            live = replace(live, retention=Retention(out, limits, done))
        run_live(live, page, page_name or ())


def run_live(live: Live, page: int | None, page_names: Sequence[str] = ()) -> None:
    """Serve until a signal or the end of the source; then give the folder its final names."""
    from stereo_ore.plant.loop import serve as serve_frames
    from stereo_ore.plant.page import LivePage
    from stereo_ore.plant.publisher import Publisher
    from stereo_ore.plant.status import PlantStatus

    stop = threading.Event()
    folder = live.folder
    with (
        Publisher(live.consumers, live.valid_for_s, live.origin) as publisher,
        _signals(stop),
        ExitStack() as stack,
    ):
        status = PlantStatus(live.source, publisher, live.fault)
        if page is not None:
            shown = stack.enter_context(LivePage(page, status, folder.folder, page_names))
            typer.echo(f"live page: {shown.url}", err=True)
        for state in publisher.states():
            _log.info("%s: %s", state.name, state.address)
        done = serve_frames(
            live.source, live.process, folder, publisher, status, stop, live.retention
        )
    folder.finish()
    typer.echo(f"{done} frames: {folder.folder}")


@contextmanager
def _signals(stop: threading.Event) -> Iterator[None]:
    """Ctrl-C and termination end the run after the frame in work; a second one at once."""

    def handle(number: int, frame: Any) -> None:
        _log.warning("stopping after the frame in work")
        stop.set()
        signal.signal(number, signal.default_int_handler)

    earlier = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, action in earlier.items():
            signal.signal(number, action)


def _alone(watch: Path | None) -> AbstractContextManager[object]:
    """Keep others from serving the same inbox; it may be one that nothing can be written to."""
    from stereo_ore.io.lock import FolderLock

    return FolderLock(watch) if watch else nullcontext()


def _open(
    source: Path | None,
    watch: Folder | None,
    camera: int | None,
    calib: Path | None,
    size: tuple[int, int] | None,
    max_pixels: int,
) -> tuple[LiveSource, StereoCalibration]:
    """Where frames come from, and the calibration for images of their size."""
    from stereo_ore.cli.recording import calibration_for
    from stereo_ore.io.calibration import load
    from stereo_ore.io.recordings import limit_pixels, open_source
    from stereo_ore.plant.camera import open_camera
    from stereo_ore.plant.frames import ReplayedRecording
    from stereo_ore.plant.watch import FolderWatch, first_size

    match source, watch, camera, calib:
        case Path(), None, None, _:
            recording = limit_pixels(open_source(source), max_pixels)
            return ReplayedRecording(recording), calibration_for(recording, calib, size)
        case None, Folder(folder, queue, trust), None, Path():
            calibration = load(calib, image_size=size, recorded_size=first_size(folder))
            frames = FolderWatch(
                folder,
                max_pixels=max_pixels,
                eye_size=calibration.image_size,
                queue=queue,
                trust_times=trust,
            )
            return frames, calibration
        case None, None, int(), Path():
            calibration = load(calib, image_size=size)
            return open_camera(camera, calibration.image_size), calibration
    if calib is None and source is None:
        raise typer.BadParameter("--calib is needed: only a bag can carry its own calibration")
    raise typer.BadParameter(_ONE_SOURCE)


def _only_topics(*others: object) -> None:
    if any(other is not None for other in others):
        raise typer.BadParameter(_ONE_SOURCE)


def _own_calibration(
    live: bool, calib: Path | None, calibration: StereoCalibration
) -> dict[str, str]:
    """What tells runs of one driver's topics apart whose calibration is theirs."""
    from stereo_ore.io.calibration import dump

    if not live or calib is not None:
        return {}
    return {"calibration_sha256": hashlib.sha256(dump(calibration).encode()).hexdigest()}


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    found = re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", text.strip().lower())
    if not found:
        raise typer.BadParameter(f"--size {text!r} is no WIDTHxHEIGHT, such as 1280x720")
    return int(found[1]), int(found[2])
