"""``bench speed``: costs of a frame, growth of the filters, memory, tables."""

import json
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from stereo_ore.cli import app, load_verbs
from stereo_ore.errors import ConfigError
from stereo_ore.lab import synth
from stereo_ore.lab.bench import growth, memory, speed, speed_tables
from stereo_ore.lab.bench.growth import GrowthRow

STAGES = [
    "read", "rectify", "match", "register", "cloud", "voxels", "filter", "surface", "grizzly",
    "foreign", "segment", "fines", "solids",
    "strikes", "ores", "health", "record", "files",
]  # fmt: skip


@pytest.fixture(scope="module")
def cost(synth_folder: Path) -> speed.FrameCost:
    return speed.measure_speed("VGA", speed.make_scene(synth_folder, "VGA"), True, rounds=2)


def test_a_frame_is_the_sum_of_its_stages(cost: speed.FrameCost) -> None:
    assert list(cost.stages_ms) == STAGES
    assert all(ms > 0 for ms in cost.stages_ms.values())
    whole = sum(cost.stages_ms[name] for name in STAGES[:-1])
    assert cost.frame_ms == pytest.approx(whole, rel=0.3)
    after = sum(cost.stages_ms[name] for name in STAGES[3:-1])
    assert cost.after_ms == pytest.approx(after, rel=0.3)
    assert cost.counts["targets"] > 0


def test_ratios_are_to_the_plain_matchers_with_as_near_a_limit(cost: speed.FrameCost) -> None:
    assert cost.disparities == 64
    assert set(cost.plain_ms) == {"3WAY", "SGBM"}
    for name, ms in cost.plain_ms.items():
        assert cost.frame_ratio[name] == pytest.approx(cost.frame_ms / ms, rel=0.5)
        assert cost.after_ratio[name] < cost.frame_ratio[name]


@pytest.mark.skipif(not memory.STATM.exists(), reason="memory is measured on Linux only")
def test_memory_is_that_of_the_process(cost: speed.FrameCost) -> None:
    assert cost.peak_mb is not None
    assert 50 < cost.peak_mb < 2000
    assert max(cost.stage_peaks_mb.values()) <= cost.peak_mb
    assert set(cost.stage_peaks_mb) <= set(STAGES)


@pytest.mark.skipif(not memory.STATM.exists(), reason="memory is measured on Linux only")
def test_a_short_peak_is_seen() -> None:
    def work() -> None:
        big = np.ones(25_000_000)
        time.sleep(0.05)
        del big
        time.sleep(0.02)

    before = set(threading.enumerate())
    samples = memory.sampled(work)
    peak = memory.peak_mb(samples)
    assert peak is not None
    assert 180 < peak - samples[0][1] / 1e6 < 260
    assert set(threading.enumerate()) <= before


def test_peaks_belong_to_the_stage_they_fall_into() -> None:
    samples = [
        (t, int(size * 1e6))
        for t, size in ((10.0, 1), (10.05, 7), (10.15, 3), (10.25, 9), (10.4, 99))
    ]
    stages = {"first": 100.0, "second": 100.0, "third": 100.0}
    assert memory.stage_peaks_mb(samples, 10.0, stages) == {"first": 7, "second": 3, "third": 9}
    assert memory.stage_peaks_mb([], 10.0, stages) == {}


def test_where_the_system_does_not_tell_memory_is_not_measured(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    done: list[int] = []
    monkeypatch.setattr(memory, "STATM", Path("/nowhere"))
    assert memory.sampled(lambda: done.append(1)) == []
    assert done == [1]
    assert memory.peak_mb([]) is None


def test_filters_grow_and_the_slow_ones_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = growth.measure_growth([500, 5000], limit_s=1000)
    assert [(row.filter, row.points) for row in rows] == [
        (name, n) for n in (500, 5000) for name in growth.FILTERS
    ]
    assert all(row.seconds is not None and row.seconds > 0 for row in rows)
    monkeypatch.setattr(
        growth,
        "_in_own_process",
        lambda n, names: {f: GrowthRow(f, n, n / 1000, 1.0) for f in names},
    )
    rows = growth.measure_growth([1_000_000, 10_000_000], limit_s=12_000)
    assert [row.filter for row in rows if row.seconds is None] == [growth.LOF]
    rows = growth.measure_growth([1_000_000, 10_000_000], limit_s=11_000)
    assert [row.points for row in rows if row.seconds is None] == [10_000_000] * len(growth.FILTERS)


def test_the_cloud_is_a_surface_with_noise() -> None:
    cloud = growth.rough_surface(20_000)
    assert cloud.shape == (20_000, 3)
    surface = 0.05 * np.sin(cloud[:, 0] / 0.05) * np.cos(cloud[:, 1] / 0.07)
    assert np.mean(np.abs(cloud[:, 2] - surface) > 0.0015) == pytest.approx(
        growth.NOISE_SHARE, abs=0.03
    )
    np.testing.assert_array_equal(cloud, growth.rough_surface(20_000))


def test_tables_hold_every_figure(cost: speed.FrameCost) -> None:
    rows = [GrowthRow("a", 10_000, 1.0, 5.0), GrowthRow("b", 10_000, 2.0, None)]
    rows += [GrowthRow("a", 100_000, 12.5, 6.0), GrowthRow("b", 100_000, None, None)]
    machine = {"cores": 2, "processor": "x", "opencv": "5", "load": 0.1}
    text = speed_tables.speed_markdown([cost, cost], rows, machine)
    assert "| ms | VGA, site | VGA, site |" in text
    assert "| status | ok | ok |" in text
    for stage in STAGES[:-1]:
        assert f"\n| {stage} |" in text
    assert f"**{cost.frame_ratio['3WAY']:.2f}**" in text
    assert "| 100,000 | 12.5 (6) | – |" in text
    assert "| 10,000 → 100,000 | 1.00 | – |" in text
    assert speed_tables.speed_markdown([], rows[:2], machine).count("**") == 2


def test_the_picture_is_drawn(cost: speed.FrameCost, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    for frames in ([], [cost, cost]):
        path = tmp_path / f"{len(frames)}.png"
        speed_tables.draw_speed(
            frames, [GrowthRow("a", 10, 1.0, 5.0), GrowthRow("a", 100, None, None)], path
        )
        assert path.stat().st_size > 10_000


def test_an_unknown_size_is_refused_before_the_work(tmp_path: Path) -> None:
    load_verbs()
    fault = (
        CliRunner()
        .invoke(app, ["bench", "speed", "--out", str(tmp_path / "x"), "--size", "HD7"])
        .exception
    )
    assert isinstance(fault, ConfigError)
    assert "HD720" in str(fault)
    assert not (tmp_path / "x").exists()


@pytest.mark.slow
def test_the_command_writes_everything(tmp_path: Path) -> None:
    load_verbs()
    readme, out = tmp_path / "README.md", tmp_path / "bench"
    readme.write_text("<!-- bench speed -->\n<!-- /bench speed -->\n")
    words = [
        "bench",
        "speed",
        "--out",
        str(out),
        "--size",
        "VGA",
        "--rounds",
        "1",
        "--points",
        "10000",
    ]
    result = CliRunner().invoke(app, [*words, "--readme", str(readme)])
    assert result.exit_code == 0, result.output
    document = json.loads((out / "bench-speed.json").read_text())
    assert [(frame["size"], frame["site"]) for frame in document["frames"]] == [
        ("VGA", True),
        ("VGA", False),
    ]
    assert {row["points"] for row in document["growth"]} == {10_000}
    assert "VGA, no site" in readme.read_text()
    assert (out / "bench-speed.png").stat().st_size > 10_000


@pytest.mark.slow
def test_a_scene_is_made_where_there_is_none(tmp_path: Path) -> None:
    folder = speed.make_scene(tmp_path / "VGA", "VGA")
    before = (folder / "left.png").stat().st_mtime_ns
    assert speed.make_scene(folder, "VGA") == folder
    assert (folder / "left.png").stat().st_mtime_ns == before
    assert synth.SIZES["VGA"][:2] == (672, 376)
