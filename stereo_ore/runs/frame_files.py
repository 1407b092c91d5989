"""The files of one frame: filtered cloud, overlay and, where wanted, stage arrays and a picture in space."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from stereo_ore.draw import overlay, scene_picture
from stereo_ore.io.atomic import write_bytes
from stereo_ore.types import I32, U8, FilterResult, FrameResult, PointCloud, VoxelCloud

PNG_SETTINGS = [
    cv2.IMWRITE_PNG_COMPRESSION, 1,
    cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_DEFAULT,
    # Trying all filters a row, as OpenCV 5 does unasked, doubles the time and saves nothing; OpenCV 4.10 has one only.
    *((cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP) if hasattr(cv2, "IMWRITE_PNG_FILTER") else ()),
]  # fmt: skip
"""Fast rather than small: an overlay is looked at, then thrown away."""

NPZ_LEVEL = 1
"""Of zlib: as small as the usual 6 within a few per cent, in half the time."""

PLY_FIELDS = (
    *((name, "<f4", "float") for name in "xyz"),
    *((name, "u1", "uchar") for name in ("red", "green", "blue")),
    ("ore_id", "<i4", "int"),
    ("score", "<f4", "float"),
    ("scalar_ore_id", "<f4", "float"),
    ("scalar_score", "<f4", "float"),
    ("quality", "<f4", "float"),
)
"""Columns of a cloud. The last three repeat ore_id and score under the names that CloudCompare and MeshLab take."""


@dataclass(frozen=True)
class FrameFiles:
    """Writes the files of each frame below `folder`."""

    folder: Path
    save_stages: bool = False
    pictures: bool = False
    clouds: bool = True
    overlays: bool = True

    def write(self, result: FrameResult) -> None:
        """Write what the frame has and what is wanted: nothing for a frame that could not be read."""
        if self.overlays:
            self._write_image("overlays", result.name, overlay.draw(result))
        if self.pictures:
            self._write_image("pictures", result.name, scene_picture.draw(result))
        if self.clouds and result.cloud is not None and result.voxels is not None and result.filtered is not None:
            data = cloud_ply(result.cloud, result.voxels, result.filtered, _voxel_ids(result))
            write_bytes(self.folder / "clouds" / f"{result.name}.ply", data)
        if self.save_stages and result.disparity is not None:
            write_bytes(self.folder / "stages" / f"{result.name}.npz", stages_npz(result))

    def _write_image(self, kind: str, name: str, image: U8 | None) -> None:
        if image is not None:
            encoded = cv2.imencode(".png", image, PNG_SETTINGS)[1]
            write_bytes(self.folder / kind / f"{name}.png", encoded.tobytes())


def cloud_ply(cloud: PointCloud, voxels: VoxelCloud, filtered: FilterResult, ore_id: I32) -> bytes:
    """Binary PLY of the kept voxels: x y z [m], red green blue, ore_id (0 = screen and rest), score, and both again."""
    keep = filtered.keep
    table = np.zeros(int(keep.sum()), [(name, kind) for name, kind, _ in PLY_FIELDS])
    table["x"], table["y"], table["z"] = voxels.xyz[keep].T
    table["blue"], table["green"], table["red"] = voxel_colour(cloud, voxels)[keep].T
    table["ore_id"] = table["scalar_ore_id"] = ore_id[keep]
    table["score"] = table["scalar_score"] = table["quality"] = filtered.score[keep]
    properties = [f"property {kind} {name}" for name, _, kind in PLY_FIELDS]
    header = ["ply", "format binary_little_endian 1.0", "comment stereo_ore: metres, rectified left camera"]
    header += [f"element vertex {len(table)}", *properties, "end_header", ""]
    return "\n".join(header).encode() + table.tobytes()


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
    """An ``.npz`` file of arrays; `np.savez_compressed` knows only one, slow, level of compression."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=NPZ_LEVEL) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, array, allow_pickle=False)
    return buffer.getvalue()
