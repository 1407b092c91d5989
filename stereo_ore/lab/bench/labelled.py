"""Clouds whose noise is known: the published experiment's, and stereo clouds of scenes with true
depth.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from stereo_ore.chain import Chain
from stereo_ore.config import Config, FilterConfig
from stereo_ore.errors import CloudError
from stereo_ore.io import clouds, recordings
from stereo_ore.lab import evaluate, metrics, synth
from stereo_ore.lab.bench.scene_files import load_rig
from stereo_ore.lab.synth.paper_cloud import NOISE_SHARES, Direction
from stereo_ore.types import (
    F64,
    I32,
    Mask,
    Site,
    StereoCalibration,
    StereoPair,
    VoxelCloud,
    single_voxels,
)

DIRECTIONS: tuple[Direction, ...] = ("isotropic", "normal", "ray")
TUNING_SEED = 100
"""Seeds from here on are for tuning; seeds below it are for reporting."""


@dataclass(frozen=True)
class LabelledCloud:
    """A cloud, which of its points are noise, which of them belong to bars, and which can be
    judged.

    The last two are None where that is not known, and where all can.
    """

    name: str
    cell: str
    voxels: VoxelCloud
    is_noise: Mask
    on_bar: Mask | None = None
    judged: Mask | None = None


def bare_cloud(xyz: npt.ArrayLike) -> VoxelCloud:
    """A cloud that no camera made, in voxels of one point each, from (M, 3) coordinates [m]."""
    return single_voxels(np.asarray(xyz, np.float32))


def paper_clouds(seeds: range) -> Iterator[LabelledCloud]:
    """The paper's protocol: three directions × three noise shares × seeds."""
    for seed in seeds:
        for direction in DIRECTIONS:
            for share in NOISE_SHARES:
                xyz, noise = synth.paper_cloud(seed, direction, share)
                cell = f"{direction}, {100 * share:.1f} %"
                yield LabelledCloud(f"{cell}, seed {seed}", cell, bare_cloud(xyz), noise)


def made_stereo(seed: int, family: str, size: str = "HD720") -> LabelledCloud:
    """The stereo cloud of a synthetic scene, as `run` would hand it to the filter."""
    made = synth.scene(seed, family, size)
    disparity = np.nan_to_num(made.disparity_px.astype(np.float64))
    return _stereo(
        made.spec.name,
        f"synth {family}",
        made.pair,
        made.calibration,
        made.site,
        disparity,
        made.instance,
    )


def scene_stereo(folder: Path) -> LabelledCloud:
    """The stereo cloud of a scene folder with truth, which stands in for missing calibration.yaml
    and site.yaml.
    """
    truth = evaluate.load_truth(folder)
    calib, site = load_rig(folder)
    pair = recordings.open_source(folder).read(0)
    return _stereo(folder.name, folder.name, pair, calib, site, truth.disparity, truth.instance)


def _stereo(
    name: str,
    cell: str,
    pair: StereoPair,
    calib: StereoCalibration,
    site: Site,
    true_disparity: F64,
    instance: I32,
) -> LabelledCloud:
    """The voxels of a frame; noise as `metrics.is_noise` says, from the true disparity (H, W), 0 =
    none.
    """
    chain = Chain(calib, site, Config(filter=FilterConfig(method="none")))
    grid, rig = chain(pair).voxels, chain.rig
    if grid is None:
        raise CloudError("gives no cloud", file=name)
    K = np.array([[rig.fx, 0, rig.cx], [0, rig.fy, rig.cy], [0, 0, 1]])
    noise = metrics.is_noise(grid.xyz, true_disparity, K, rig.fx * rig.baseline_m)
    u, v = np.rint(rig.project(grid.xyz)).astype(int).T
    inside = instance[np.clip(v, 0, rig.height - 1), np.clip(u, 0, rig.width - 1)]
    return LabelledCloud(name, cell, grid, noise, inside == 1)


def labelled_file(path: Path) -> LabelledCloud:
    """A cloud file [m] with a column ``noise``: anything but 0 is noise.

    Raises
    ------
    CloudError
        When the file can't be read or has no such column.
    """
    records = clouds.read(path)
    if "noise" not in (records.dtype.names or ()):
        raise CloudError(
            "has no column noise", file=path, remedy="Label its points: 0 surface, 1 noise"
        )
    xyz = clouds.xyz(records)
    return LabelledCloud(
        path.stem, path.stem, bare_cloud(xyz - np.nanmedian(xyz, axis=0)), records["noise"] != 0
    )
