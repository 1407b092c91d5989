"""The stereo benchmark: readers against broken files, figures against hand-made errors, the quality
it must show."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereo_ore.cli import launch
from stereo_ore.errors import SourceError
from stereo_ore.lab.bench import equal_density, stereo, stereo_sets
from stereo_ore.types import RectifiedPair, Region


def write_pfm(path: Path, values: np.ndarray, order: str = "<") -> None:
    scale = "-1.0" if order == "<" else "1.0"
    header = f"Pf\n{values.shape[1]} {values.shape[0]}\n{scale}\n".encode()
    path.write_bytes(header + values[::-1].astype(f"{order}f4").tobytes())


@pytest.fixture
def middlebury(tmp_path: Path, flat_plane_pair) -> Path:
    folder = tmp_path / "Plane"
    folder.mkdir()
    for name, image in (
        ("im0.png", flat_plane_pair.pair.left),
        ("im1.png", flat_plane_pair.pair.right),
    ):
        cv2.imwrite(str(folder / name), image)
    truth = flat_plane_pair.disparity.copy()
    truth[:, :40] = np.inf
    write_pfm(folder / "disp0GT.pfm", truth)
    (folder / "calib.txt").write_text(
        "cam0=[300 0 240.5; 0 300 159; 0 0 1]\ncam1=[300 0 240.5; 0 300 159; 0 0 1]\n"
        "doffs=0\nbaseline=120\nwidth=480\nheight=320\nndisp=64\n"
    )
    return folder


@pytest.mark.parametrize("order", ["<", ">"])
def test_pfm_of_either_byte_order_reads_top_row_first(order: str, tmp_path: Path) -> None:
    values = np.arange(12, dtype=np.float32).reshape(3, 4)
    values[1, 2] = np.inf
    write_pfm(tmp_path / "a.pfm", values, order)
    np.testing.assert_array_equal(stereo_sets.read_pfm(tmp_path / "a.pfm"), values)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"Pf\n4 3\n-1\n\0\0",
        b"PF\n1 1\n-1\n" + bytes(12),
        b"P5\n1 1\n255\n\0",
        b"Pf\nx y\n-1\n",
    ],
    ids=["empty", "torn", "colour", "pgm", "no size"],
)
def test_broken_pfm_files_are_named(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "b.pfm").write_bytes(content)
    with pytest.raises(SourceError, match=r"b\.pfm"):
        stereo_sets.read_pfm(tmp_path / "b.pfm")
    with pytest.raises(SourceError, match=r"absent\.pfm"):
        stereo_sets.read_pfm(tmp_path / "absent.pfm")


def test_a_set_is_recognised_and_unknown_truth_is_left_out(middlebury: Path) -> None:
    (data,) = stereo_sets.find_sets(middlebury.parent)
    assert data.name == "Plane"
    assert np.isnan(data.truth[:, :40]).all()
    assert np.isfinite(data.truth[:, 40:]).all()
    assert data.region.num_disparities > np.nanmax(data.truth)


def test_a_folder_without_sets_and_a_set_without_images_are_errors(
    tmp_path: Path, middlebury: Path
) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(SourceError, match="no stereo pair"):
        list(stereo_sets.find_sets(tmp_path / "empty"))
    (middlebury / "im1.png").write_bytes(b"torn")
    with pytest.raises(SourceError, match=r"im1\.png"):
        list(stereo_sets.find_sets(middlebury))


def test_figures_are_those_of_hand_made_errors(flat_plane_pair) -> None:
    rig = replace(flat_plane_pair.pair.rig, width=5, height=2)
    image = np.zeros((2, 5, 3), np.uint8)
    truth = np.full((2, 5), 10, np.float32)
    truth[1, 4] = np.nan
    disparity = truth + np.array([[0.1, 0.3, -0.2, 1.5, 3.0], [np.nan, 0, 0, 0, 5]], np.float32)
    seen = np.zeros((2, 5), bool)
    seen[0] = True
    data = stereo_sets.StereoSet(
        "x", RectifiedPair(image, image, rig), truth, Region(0, 0, 5, 2, 0, 16), seen
    )
    everything, both = stereo._rows(data, "m", disparity, 7.0)
    assert (everything.scope, both.scope) == ("all", "seen")
    assert everything.density == pytest.approx(100 * 8 / 9)
    assert everything.bad1 == pytest.approx(100 * 3 / 9)
    assert everything.bad2 == pytest.approx(100 * 2 / 9)
    assert both.bad2_found == pytest.approx(20)
    assert both.median == pytest.approx(0.3, abs=1e-5)
    assert both.bias == pytest.approx(0.1, abs=1e-5)
    assert "| x | m | 88.9 |" in stereo.stereo_markdown([everything, both])


def test_the_command_writes_both_forms(
    middlebury: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as done:
        launch(
            ["bench", "stereo", str(middlebury), "--repeats", "1", "--out", str(tmp_path / "out")]
        )
    assert done.value.code == 0
    document = json.loads((tmp_path / "out/bench-stereo.json").read_text())
    rows, (sure,) = document["matchers"], document["confidence"]
    assert sure["auc"] is None or sure["auc"] > 0.9  # hardly a pixel is wrong by more than one
    assert sure["true"][9] > 0.99
    assert document["equal_density"] == []
    assert [row["matcher"] for row in rows] == list(stereo.MATCHERS)
    assert rows[0]["bad1"] < 2
    assert rows[0]["median"] < rows[1]["median"]
    assert capsys.readouterr().out.strip() == (tmp_path / "out/bench-stereo.md").read_text().strip()


@pytest.mark.parametrize("name", ["Teddy", "Recycle", "Rocks1"])
def test_real_pairs_have_fewer_bad_pixels_than_opencvs_matchers(
    name: str, shared_data: Path
) -> None:
    (data,) = (
        data for data in stereo_sets.find_sets(shared_data / "stereo_gt") if data.name == name
    )
    bad = {}
    for matcher in ("stereo-ore", "SGBM", "SGBM+WLS"):
        error = np.abs(stereo.MATCHERS[matcher](data) - data.truth)[np.isfinite(data.truth)]
        bad[matcher] = (~(error <= 2)).mean()
    assert bad["stereo-ore"] < bad["SGBM"]
    assert bad["stereo-ore"] < bad["SGBM+WLS"]


@pytest.mark.parametrize(
    ("name", "wrong", "median"), [("large_05", 1.0, 0.10), ("raw_01_large", 2.0, 0.10)]
)
def test_ore_of_path_traced_scenes_is_measured_to_a_tenth_of_a_pixel(
    name: str, wrong: float, median: float, shared_data: Path
) -> None:
    data = stereo_sets.traced_sets(shared_data / "scenes_dev" / name)
    assert data.ore is not None
    error = (stereo.ours(data) - data.truth)[data.ore]
    assert 100 * np.isfinite(error).mean() >= 98
    assert 100 * (~(np.abs(error) <= 1)).mean() <= wrong
    assert np.nanmedian(np.abs(error)) <= median
    assert abs(np.nanmedian(error)) <= 0.05


def test_curves_are_read_between_their_points_and_below_them() -> None:
    curve = [(0.8, 0.3, 0.25), (0.6, 0.45, 0.42)]
    assert equal_density.read_at(curve, 0.7) == pytest.approx((0.375, 0.335))
    assert equal_density.read_at(curve, 0.3) == pytest.approx((0.725, 0.71))
    assert equal_density.read_at(curve, 0.9) == pytest.approx((0.3, 0.25))


def test_the_surest_pixels_come_first_and_equal_ones_together() -> None:
    truth = np.array([[5, 5, 5, 5, np.nan]], np.float32)
    values = np.array([[5.5, 9, 6.5, np.nan, 5]], np.float32)
    sure = np.array([[0.9, 0.5, 0.5, np.nan, 0.1]], np.float32)
    points = equal_density.points_by_confidence(values, sure, truth)
    np.testing.assert_allclose(points, [(0.25, 0.75, 0.75), (0.75, 0.75, 0.5)])
    nothing = equal_density.points_by_confidence(np.full_like(values, np.nan), sure, truth)
    assert nothing == [(0.0, 1.0, 1.0)]


def test_a_peer_counts_at_its_best_setting_for_each_measure() -> None:
    def row(name: str, setting: str, one: float, two: float) -> equal_density.Compared:
        return equal_density.Compared(name, "HH", setting, 0.8, (0.2, 0.1), (one, two), 0.9)

    rows = [
        row("a", "x", 0.21, 0.15),
        row("b", "x", 0.19, 0.15),
        row("a", "y", 0.3, 0.08),
        row("b", "y", 0.3, 0.11),
    ]
    one, two = equal_density.verdicts(rows)
    assert (one.setting, one.won, two.setting, two.won) == ("x", 1, "y", 1)
    assert one.difference == pytest.approx(0, abs=1e-9)
    assert two.difference == pytest.approx(0.5)
    assert "| HH (x) | bad-1 | +0.00 | 1 of 2 | 0.900 (0.900) |" in equal_density.density_markdown(
        rows
    )


@pytest.mark.slow
def test_the_grid_compares_every_peer(middlebury: Path) -> None:
    (data,) = stereo_sets.find_sets(middlebury)
    rows = list(stereo.beside_peers(data))
    assert {row.peer for row in rows} == {"3WAY", "HH", "WLS"}
    assert all(0 <= row.peers[1] <= row.peers[0] <= 1 for row in rows)
    assert max(row.rms_ratio for row in rows) < 1
