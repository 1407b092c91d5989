"""The files of one frame: filtered cloud, overlay and, where wanted, stage arrays and a picture in
space.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from stereo_ore.draw import overlay, scene_picture
from stereo_ore.draw.images import encode_png
from stereo_ore.io.atomic import write_bytes
from stereo_ore.runs.folder import FrameLines
from stereo_ore.transforms import transform_points
from stereo_ore.types import F64, I32, U8, FrameResult, PointCloud, Rig, VoxelCloud

NPZ_LEVEL = 1
"""Of zlib: as small as the usual 6 within a few per cent, in half the time."""

CLOUD_FIELDS = (
    *((name, "<f4") for name in "xyz"),
    *((name, "u1") for name in ("red", "green", "blue")),
    ("ore_id", "<i4"),
    ("score", "<f4"),
)
OTHER_NAMES = {"scalar_ore_id": "ore_id", "scalar_score": "score", "quality": "score"}
"""Columns that CloudCompare and MeshLab take by these names only."""

ARM_CLOUDS = "arm_clouds"
"""Folder of the clouds in the arm's frame."""

PLY_TYPES = {"<f4": "float", "u1": "uchar", "<i4": "int"}


@dataclass(frozen=True)
class FrameFiles:
    """Writes the files of each frame below `folder`; clouds once more in the arm's frame where
    `T_arm_camera` is given.
    """

    folder: Path
    save_stages: bool = False
    pictures: bool = False
    clouds: bool = True
    overlays: bool = True
    T_arm_camera: F64 | None = None

    def write(self, result: FrameResult) -> None:
        """Write what the frame has and what is wanted: nothing for a frame that could not be read.

        Of the overlay only the ground, which waits under a temporary name for `draw`.
        """
        if self.overlays and (ground := overlay.draw_ground(result)) is not None:
            write_bytes(self._ground(result.name), encode_png(ground, 0))
        if self.pictures and (picture := scene_picture.draw_scene(result)) is not None:
            write_bytes(self.folder / "pictures" / f"{result.name}.png", encode_png(picture))
        if result.filtered is not None and (self.clouds or self.T_arm_camera is not None):
            self._write_clouds(result.name, cloud_table(result))
        if self.save_stages and result.disparity is not None:
            write_bytes(self.folder / "stages" / f"{result.name}.npz", stages_npz(result))

    def draw(self, lines: FrameLines, rig: Rig) -> None:
        """Make the overlay of a frame whose lines its predecessors have judged: lumps and targets
        on its ground.
        """
        if not self.overlays or lines.outlines is None:
            return
        record = json.loads(lines.record)
        ground = self._ground(record["frame"])
        image = cv2.imdecode(np.fromfile(ground, np.uint8), cv2.IMREAD_COLOR)
        picture = np.asarray(image, np.uint8)
        overlay.draw_lumps(picture, rig, lines.outlines, record)
        write_bytes(self.folder / "overlays" / f"{record['frame']}.png", encode_png(picture))
        ground.unlink()

    def _ground(self, name: str) -> Path:
        """Where an overlay's ground waits; what a killed run leaves there `remove_leftovers`
        takes away.
        """
        return self.folder / "overlays" / f".{name}.ground.tmp"

    def _write_clouds(self, name: str, table: npt.NDArray[np.void]) -> None:
        if self.clouds:
            write_bytes(self.folder / "clouds" / f"{name}.ply", cloud_ply(table))
        if self.T_arm_camera is not None:
            data = cloud_ply(_moved(table, self.T_arm_camera), "arm frame")
            write_bytes(self.folder / ARM_CLOUDS / f"{name}.ply", data)


def cloud_table(result: FrameResult) -> npt.NDArray[np.void]:
    """Kept voxels (M,) with the fields x y z [m], red green blue, ore_id (0 = screen and rest),
    score.

    Empty for a frame that did not reach the filter.
    """
    fields = list(CLOUD_FIELDS)
    cloud, voxels, filtered = result.cloud, result.voxels, result.filtered
    if cloud is None or voxels is None or filtered is None:
        return np.zeros(0, fields)
    keep = filtered.keep
    table = np.zeros(int(keep.sum()), fields)
    table["x"], table["y"], table["z"] = voxels.xyz[keep].T
    table["blue"], table["green"], table["red"] = voxel_colour(cloud, voxels)[keep].T
    table["ore_id"], table["score"] = _voxel_ids(result)[keep], filtered.score[keep]
    return table


def _moved(table: npt.NDArray[np.void], T: F64) -> npt.NDArray[np.void]:
    """A copy of a `cloud_table` in another frame."""
    places = np.stack([table[axis] for axis in "xyz"], -1).astype(np.float64)
    copy = table.copy()
    copy["x"], copy["y"], copy["z"] = transform_points(T, places).T
    return copy


def cloud_ply(table: npt.NDArray[np.void], frame: str = "rectified left camera") -> bytes:
    """Binary PLY of a `cloud_table`, with ore_id and score once more as `OTHER_NAMES`; `frame` is
    what its coordinates are in.
    """
    fields = [*CLOUD_FIELDS, *((name, "<f4") for name in OTHER_NAMES)]
    whole = np.empty(len(table), fields)
    for name, _ in fields:
        whole[name] = table[OTHER_NAMES.get(name, name)]
    properties = [f"property {PLY_TYPES[kind]} {name}" for name, kind in fields]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment stereo_ore: metres, {frame}",
    ]
    header += [f"element vertex {len(table)}", *properties, "end_header", ""]
    return "\n".join(header).encode() + whole.tobytes()


def voxel_colour(cloud: PointCloud, voxels: VoxelCloud) -> U8:
    """Mean BGR colour (M, 3) of each voxel's points."""
    sums = [np.bincount(voxels.inverse, cloud.bgr[:, channel], len(voxels)) for channel in range(3)]
    return np.rint(np.stack(sums, 1) / voxels.count[:, None]).astype(np.uint8)


def _voxel_ids(result: FrameResult) -> I32:
    """Ore id (M,) of each voxel: that of its last point."""
    assert result.cloud is not None, "a frame with voxels has a cloud"
    assert result.voxels is not None, "called for frames with voxels"
    ids = np.zeros(len(result.voxels), np.int32)
    if result.ore_map is not None:
        ids[result.voxels.inverse] = result.ore_map.labels.ravel()[result.cloud.pixel]
    return ids


def stages_npz(result: FrameResult) -> bytes:
    """Arrays between the stages, as design.md names them; those not reached are empty."""
    voxels, filtered, disparity = result.voxels, result.filtered, result.disparity
    assert disparity is not None, "called for frames with a disparity"
    shape = disparity.values.shape
    arrays: dict[str, npt.NDArray[Any]] = {
        "disparity": disparity.values,
        "voxel_xyz": voxels.xyz if voxels else np.zeros((0, 3), np.float32),
        "keep": filtered.keep if filtered else np.zeros(0, bool),
        "score": filtered.score if filtered else np.zeros(0, np.float32),
        "ore_id": _voxel_ids(result) if voxels else np.zeros(0, np.int32),
        "ore_map": result.ore_map.labels if result.ore_map else np.zeros(shape, np.int16),
    }
    return npz(arrays)


def npz(arrays: Mapping[str, npt.NDArray[Any]]) -> bytes:
    """An ``.npz`` file of arrays; `np.savez_compressed` knows only one, slow, level of
    compression.
    """
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=NPZ_LEVEL) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, array, allow_pickle=False)
    return buffer.getvalue()
