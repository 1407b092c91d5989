"""`--like`: the sets of Open3D itself, and of other programs by their printed formulas."""

from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
from typer.testing import CliRunner

from stereo_ore.cli import app, load_verbs
from stereo_ore.config.filters import LofParams, RadiusParams, StatisticalParams
from stereo_ore.errors import ConfigError, StereoOreError
from stereo_ore.io import clouds
from stereo_ore.lab import synth
from stereo_ore.stages.filters import apply_like


def copies() -> np.ndarray:
    some = np.random.default_rng(0).normal(size=(300, 3))
    return np.vstack([some, *[some[:30]] * 12, some[30:60]])


CLOUDS = {
    "paper": synth.paper_cloud(1)[0][::5],
    "far origin": synth.paper_cloud(2)[0][::9] + np.array([4.0e5, 5.0e6, 300.0]),
    "lattice": np.indices((12, 12, 5)).reshape(3, -1).T * 0.1,
    "whole numbers": np.indices((9, 9, 3)).reshape(3, -1).T.astype(float),
    "copies": copies(),
    "few": np.eye(3),
}


def statistical(xyz: np.ndarray, program: str, k: int, ratio: float) -> set[int]:
    return set(np.flatnonzero(apply_like(program, xyz, StatisticalParams(k=k, ratio=ratio)).keep))


@pytest.mark.parametrize("name", CLOUDS)
@pytest.mark.parametrize("k", [1, 2, 9, 20])
@pytest.mark.parametrize("ratio", [0.1, 1.0, 2.0])
def test_open3d_statistical(name: str, k: int, ratio: float) -> None:
    theirs = o3d.geometry.PointCloud(
        o3d.utility.Vector3dVector(CLOUDS[name])
    ).remove_statistical_outlier(k, ratio)[1]
    assert statistical(CLOUDS[name], "open3d", k, ratio) == set(theirs)


@pytest.mark.parametrize("name", CLOUDS)
@pytest.mark.parametrize(
    ("n", "radius"), [(1, 0.01), (4, 0.1), (4, 0.02), (6, 0.1), (4, 1.0), (10, 1.5)]
)
def test_open3d_radius(name: str, n: int, radius: float) -> None:
    theirs = o3d.geometry.PointCloud(
        o3d.utility.Vector3dVector(CLOUDS[name])
    ).remove_radius_outlier(n, radius)[1]
    ours = apply_like("open3d", CLOUDS[name], RadiusParams(n=n, radius_m=radius)).keep
    assert set(np.flatnonzero(ours)) == set(theirs)


def plain_mean(x: np.ndarray, k: int) -> np.ndarray:
    """Mean distance to the k nearest others, by brute force in the precision of x."""
    away = x[:, None] - x
    square = away[..., 0] ** 2 + away[..., 1] ** 2 + away[..., 2] ** 2
    np.fill_diagonal(square, np.inf)
    distance = np.sqrt(np.sort(square, axis=1)[:, :k]).astype(float)
    return (distance.cumsum(1)[:, -1] / k).astype(x.dtype).astype(float)


@pytest.mark.parametrize("name", ["lattice", "copies", "whole numbers"])
@pytest.mark.parametrize(
    ("program", "itself", "freedom", "precision"),
    [("pcl", 0, 1, np.float32), ("cloudcompare", 1, 0, np.float32), ("cars", 0, 0, np.float64)],
)
def test_programs_that_keep_up_to_the_limit(
    name: str, program: str, itself: int, freedom: int, precision: type
) -> None:
    x = CLOUDS[name].astype(precision)
    for k in (2, 8, 9):
        mean = plain_mean(x, k - itself)
        for ratio in (0.1, 1.0):
            expected = set(np.flatnonzero(mean <= mean.mean() + ratio * mean.std(ddof=freedom)))
            found = statistical(CLOUDS[name], program, k, ratio)
            # Lattices have whole rows of points at the limit.
            close = np.flatnonzero(
                np.isclose(mean, mean.mean() + ratio * mean.std(ddof=freedom), rtol=1e-9)
            )
            assert found ^ expected <= set(close)


def test_the_same_set_by_each_programs_own_k() -> None:
    """Open3D's 9 are CloudCompare's 9, and the 8 of PCL and cars-filter, but for the deviation's
    degree of freedom."""
    xyz = CLOUDS["paper"]
    sets = [
        statistical(xyz, p, k, 1.0)
        for p, k in (("open3d", 9), ("cloudcompare", 9), ("pcl", 8), ("cars", 8))
    ]
    assert all(len(sets[0] ^ other) <= 2 for other in sets)
    assert len(sets[0] ^ statistical(xyz, "open3d", 8, 1.0)) > 2


def test_a_neighbour_at_exactly_the_radius() -> None:
    xyz = CLOUDS["whole numbers"]
    kept = {
        p: apply_like(p, xyz, RadiusParams(n=3, radius_m=1.0)).keep.mean()
        for p in ("open3d", "pcl")
    }
    assert kept == {"open3d": 0.0, "pcl": 1.0}


@pytest.mark.parametrize(
    ("program", "params", "words"),
    [
        ("open3b", StatisticalParams(), "Use open3d"),
        ("cars", RadiusParams(radius_m=1.0), "no radius filter"),
        ("pcl", RadiusParams(), "needs a radius"),
        ("pcl", LofParams(), "statistical or radius"),
    ],
)
def test_what_a_program_does_not_have(program: str, params: object, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        apply_like(program, CLOUDS["few"], params)


def test_the_command_keeps_what_open3d_keeps(tmp_path: Path) -> None:
    load_verbs()
    xyz, path = CLOUDS["paper"] * 1000, tmp_path / "mm.ply"
    clouds.write(path, clouds.from_array(xyz, path))
    arguments = [
        path,
        tmp_path / "out.npy",
        "--unit",
        "mm",
        "--method",
        "radius",
        "--like",
        "open3d",
    ]
    arguments += ["--set", "radius_m=0.03", "--set", "n=4"]
    result = CliRunner().invoke(app, ["-q", "filter", *map(str, arguments)])
    assert result.exit_code == 0, result.output
    theirs = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(xyz)).remove_radius_outlier(
        4, 30.0
    )[1]
    assert len(clouds.read(tmp_path / "out.npy")) == len(theirs)
    bad = CliRunner().invoke(
        app, ["-q", "filter", str(path), str(tmp_path / "o.ply"), "--unit", "mm", "--like", "pcl"]
    )
    assert isinstance(bad.exception, StereoOreError)
