"""A run on rerun's time line: overlay, disparity, clouds before and after the filter, lumps,
strikes, counts.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from stereo_ore.errors import MissingExtraError, OutputError
from stereo_ore.io import clouds
from stereo_ore.io.atomic import guarded
from stereo_ore.io.results import Results
from stereo_ore.types import Json

if TYPE_CHECKING:
    from rerun import RecordingStream

_RED, _GREEN, _AMBER, _CYAN, _WHITE = (
    (230, 60, 60),
    (90, 220, 110),
    (255, 180, 40),
    (60, 220, 255),
    (255, 255, 255),
)
_ARROW_LENGTH_M = 0.25
POINT_RADIUS_PX = 1.5


def save_view(results: Results, path: Path) -> Path:
    """Write the run as a rerun recording (``.rrd``), without a display.

    Frames are on the time line ``frame`` and, where they have stamps, on ``time``. Disparity,
    removed voxels and ore map are there when the run was made with ``--save-stages``.

    Raises
    ------
    MissingExtraError
        Without the rerun-sdk package.
    OutputError
        When the file can't be written.
    """
    records = results.records
    stream = _stream()
    guarded(path, lambda: path.parent.mkdir(parents=True, exist_ok=True))
    guarded(path, lambda: path.open("ab").close())
    stream.save(path, default_blueprint=_blueprint())
    _log(stream, results, records)
    stream.disconnect()
    return path


def open_view(results: Results) -> None:
    """Show the run in rerun's own window, which stays open.

    Raises
    ------
    MissingExtraError, OutputError
        Without the rerun-sdk package, or without a display.
    """
    records = results.records
    if sys.platform == "linux" and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        raise OutputError(
            "there is no display", remedy="Give --save FILE.rrd, and open that where there is one"
        )
    stream = _stream()
    stream.spawn(default_blueprint=_blueprint())
    _log(stream, results, records)
    stream.flush()


def _stream() -> RecordingStream:
    try:
        from rerun import RecordingStream
    except ImportError:
        raise MissingExtraError("rerun-sdk", "view") from None
    return RecordingStream("stereo-ore")


def _blueprint() -> Any:
    import rerun.blueprint as rrb

    pictures = rrb.Tabs(
        rrb.Spatial2DView(origin="/camera/overlay", name="overlay"),
        rrb.Spatial2DView(origin="/camera/disparity", name="disparity"),
        rrb.Spatial2DView(origin="/camera/ore_map", name="ore map"),
    )
    side = rrb.Vertical(
        pictures,
        rrb.TimeSeriesView(origin="/counts", name="counts"),
        rrb.TextLogView(origin="/status", name="status"),
    )
    return rrb.Horizontal(
        rrb.Spatial3DView(origin="/world", name="rectified left camera [m]"), side
    )


def _log(stream: RecordingStream, results: Results, records: tuple[Json, ...]) -> None:
    import rerun as rr

    stream.log("world", rr.ViewCoordinates.RDF, static=True)
    if rig := results.rig:
        lens = rr.Pinhole(
            focal_length=(rig.fx, rig.fy),
            principal_point=(rig.cx, rig.cy),
            resolution=(rig.width, rig.height),
        )
        stream.log("world/camera", lens, static=True)
    for record in records:
        stream.reset_time()
        stream.set_time("frame", sequence=record["index"])
        if record["stamp_ns"] is not None:
            stream.set_time("time", timestamp=np.datetime64(record["stamp_ns"], "ns"))
        # What a frame lacks must not be shown from the frame before.
        for path in ("world/frame", "camera"):
            stream.log(path, rr.Clear(recursive=True))
        _log_frame(stream, results, record)


def _log_frame(stream: RecordingStream, results: Results, record: Json) -> None:
    import rerun as rr

    frame = record["frame"]
    if overlay := results.overlay(frame):
        stream.log(
            "camera/overlay", rr.EncodedImage(contents=overlay.read_bytes(), media_type="image/png")
        )
    if (cloud := results.cloud(frame)) is not None:
        colours = np.stack([cloud[name] for name in ("red", "green", "blue")], 1)
        stream.log("world/frame/cloud", _points(clouds.xyz(cloud), colours))
    if stages := results.stages(frame):
        _log_stages(stream, stages)
    _log_ores(stream, record)
    for name, count in record["counts"].items():
        stream.log(f"counts/{name}", rr.Scalars(count))
    level = {"ok": "INFO", "failed": "ERROR"}.get(record["status"], "WARN")
    reasons = "; ".join(f"{reason['code']}: {reason['detail']}" for reason in record["reasons"])
    stream.log("status", rr.TextLog(f"{frame}: {record['status']} {reasons}".strip(), level=level))


def _log_stages(stream: RecordingStream, stages: Mapping[str, npt.NDArray[Any]]) -> None:
    import rerun as rr

    stream.log("camera/disparity", rr.DepthImage(np.nan_to_num(stages["disparity"]), meter=1.0))
    stream.log("camera/ore_map", rr.SegmentationImage(stages["ore_map"].astype(np.uint16)))
    stream.log("world/frame/removed", _points(stages["voxel_xyz"][~stages["keep"]], _RED))


def _log_ores(stream: RecordingStream, record: Json) -> None:
    import rerun as rr
    from scipy.spatial.transform import Rotation

    solids = [ore for ore in record["ores"] if ore["box"]]
    if solids:
        axes = np.array([ore["box"]["camera"]["axes"] for ore in solids], np.float64).transpose(
            0, 2, 1
        )
        axes[:, :, 2] *= np.sign(np.linalg.det(axes))[:, None]
        boxes = rr.Boxes3D(
            centers=[ore["box"]["camera"]["centre"] for ore in solids],
            half_sizes=np.array([ore["box"]["extent_m"] for ore in solids]) / 2,
            quaternions=Rotation.from_matrix(axes).as_quat(),
            colors=[{True: _RED, False: _GREEN, None: _AMBER}[ore["oversize"]] for ore in solids],
            labels=[_label(ore) for ore in solids],
        )
        stream.log("world/frame/ores", boxes)
        stream.log(
            "world/frame/centres",
            _points([ore["centre_of_gravity"]["camera"] for ore in solids], _CYAN, 6),
        )
    ranks = {id: rank for rank, id in enumerate(record["targets"], 1)}
    struck = [ore for ore in record["ores"] if ore["strike"] and ore["id"] in ranks]
    if struck:
        vectors = _ARROW_LENGTH_M * np.array(
            [ore["strike"]["direction"]["camera"] for ore in struck]
        )
        tips = np.array([ore["strike"]["point"]["camera"] for ore in struck])
        labels = [f"target {ranks[ore['id']]}" for ore in struck]
        stream.log(
            "world/frame/targets",
            rr.Arrows3D(origins=tips - vectors, vectors=vectors, colors=_WHITE, labels=labels),
        )


def _label(ore: Json) -> str:
    longest, middle, shortest = (1000 * length for length in ore["size_m"])
    return f"{ore['id']}: {longest:.0f} × {middle:.0f} × {shortest:.0f} mm"


def _points(xyz: Any, colours: Any, radius_px: float = POINT_RADIUS_PX) -> Any:
    import rerun as rr

    return rr.Points3D(
        np.asarray(xyz, np.float32), colors=colours, radii=rr.Radius.ui_points(radius_px)
    )
