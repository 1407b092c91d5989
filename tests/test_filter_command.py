"""``stereo-ore filter``: the installed command on cloud files."""

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from stereo_ore.cli import app, load_verbs
from stereo_ore.errors import StereoOreError
from stereo_ore.io import clouds
from stereo_ore.lab import synth


@pytest.fixture(scope="module")
def noisy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    xyz, noise = synth.paper_cloud(3)
    columns = {axis: xyz[:, i] for i, axis in enumerate("xyz")} | {"red": noise.astype(np.uint8)}
    path = tmp_path_factory.mktemp("clouds") / "noisy.ply"
    clouds.write(path, clouds.from_columns(columns))
    return path


def command(*arguments: object) -> None:
    load_verbs()
    result = CliRunner().invoke(app, ["-q", "filter", *map(str, arguments)])
    if isinstance(result.exception, StereoOreError):
        raise result.exception
    assert result.exit_code == 0, result.output


def test_keeps_columns_and_splits_the_cloud_in_two(noisy: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    out, noise, scores, picture = (
        tmp_path / name for name in ("out.pcd", "noise.csv", "scores.npz", "factors.png")
    )
    command(noisy, out, "--keep-noise", noise, "--scores", scores, "--picture", picture)
    kept, removed = clouds.read(out), clouds.read(noise)
    assert len(kept) + len(removed) == 18_809
    assert kept["red"].mean() < 0.03 < 0.9 < removed["red"].mean()
    with np.load(scores) as arrays:
        assert arrays["keep"].sum() == len(kept)
        assert arrays["score"].shape == (18_809,)
    assert picture.stat().st_size > 10_000
    assert (tmp_path / "factors-kept.png").stat().st_size > 10_000


def test_millimetres_are_asked_for_and_then_right(noisy: Path, tmp_path: Path) -> None:
    xyz = clouds.xyz(clouds.read(noisy))
    path = tmp_path / "mm.xyz"
    clouds.write(path, clouds.from_array(xyz * 1000, path))
    with pytest.raises(StereoOreError, match=r"are they millimetres.*--unit mm"):
        command(path, tmp_path / "out.ply")
    radius = ("--method", "radius", "--set", "radius_m=0.012", "--set", "n=4")
    command(path, tmp_path / "mm.ply", "--unit", "mm", *radius)
    command(noisy, tmp_path / "m.ply", *radius)
    in_mm, in_m = (clouds.xyz(clouds.read(tmp_path / name)) for name in ("mm.ply", "m.ply"))
    assert 0 < abs(len(in_mm)) < 18_809
    assert abs(len(in_mm) - len(in_m)) <= 3
    assert np.ptp(in_mm[:, 0]) > 500


def test_far_origin_costs_nothing(noisy: Path, tmp_path: Path) -> None:
    xyz = clouds.xyz(clouds.read(noisy))[:5000]
    for name, shift in (("near.npy", 0.0), ("far.npy", 4.0e6)):
        clouds.write(tmp_path / name, clouds.from_array(xyz + shift, tmp_path / name))
        command(tmp_path / name, tmp_path / f"out-{name}", "--unit", "m")
    near, far = (clouds.read(tmp_path / f"out-{name}") for name in ("near.npy", "far.npy"))
    assert abs(len(near) - len(far)) <= 5


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--method", "papr"), "did you mean paper"),
        (("--set", "treshold=0.4"), "did you mean threshold"),
        (("--set", "threshold"), "not of the form"),
        (("--unit", "inch"), "Use m, cm or mm"),
        (("--scores", "scores.doc"), "no known cloud format"),
    ],
)
def test_bad_options(noisy: Path, tmp_path: Path, arguments: tuple[str, ...], words: str) -> None:
    with pytest.raises(StereoOreError, match=words):
        command(noisy, tmp_path / "out.ply", *arguments)
    assert not (tmp_path / "out.ply").exists()


def test_a_cloud_that_is_nearly_emptied_is_warned_of_with_a_remedy(
    noisy: Path, tmp_path: Path
) -> None:
    load_verbs()
    said = {}
    for method in ("paper", "adaptive"):
        result = CliRunner().invoke(
            app, ["filter", str(noisy), str(tmp_path / "out.ply"), "--method", method]
        )
        assert result.exit_code == 0, result.output
        said[method] = " ".join(result.output.split())
    assert "% of the cloud is gone" in said["paper"]
    assert "a milder --set R=1.4" in said["paper"]
    assert "is gone" not in said["adaptive"]


def test_empty_cloud(tmp_path: Path) -> None:
    path = tmp_path / "empty.npy"
    np.save(path, np.zeros((0, 3)))
    command(path, tmp_path / "out.npy")
    assert len(clouds.read(tmp_path / "out.npy")) == 0


def test_the_input_is_not_replaced(noisy: Path) -> None:
    before = noisy.read_bytes()
    with pytest.raises(StereoOreError, match="is the input"):
        command(noisy, noisy)
    assert noisy.read_bytes() == before
