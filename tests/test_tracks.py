"""Lumps followed through the frames of a run: numbers, means, confirmed targets, what came and
went."""

import json
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest
from conftest import small_spec
from hypothesis import given, settings
from hypothesis import strategies as st

from stereo_ore.chain import Chain
from stereo_ore.config import Config
from stereo_ore.config.models import OrderConfig
from stereo_ore.errors import ConfigError
from stereo_ore.io.parameters import load_config
from stereo_ore.io.record_check import record_fault
from stereo_ore.lab import synth
from stereo_ore.lab.synth.sensor import Sensor
from stereo_ore.runs.driver import frame_lines
from stereo_ore.runs.folder import FrameLines
from stereo_ore.runs.history import Watch
from stereo_ore.runs.tracks import PATIENCE, STILL_SHARE

Place = tuple[float, float, float]
HERE, THERE = (0.0, 0.0, 2.0), (0.5, 0.2, 2.0)
OPENING_M = 0.3


def lump(at: Place, size: float = 0.4, pixels: int = 1000, sigma: float = 0.01) -> dict[str, Any]:
    """An entry of a record: a cube of `size` [m], which is struck from above."""
    x, y, z = at
    point = {"camera": [x, y, z], "arm": None}
    oversize = None if abs(size / OPENING_M - 1) < 0.03 else size > OPENING_M
    return {
        "pixels": pixels, "cut": False, "carries": [], "carried_by": [], "track": None,
        "surface_centroid": {"camera": [x, y, z], "arm": None},
        "centre_of_gravity": {"camera": [x, y, z + 0.1], "arm": None, "sigma_m": [sigma] * 3},
        "volume_m3": size**3, "volume_bounds_m3": [size**3] * 2, "size_m": [size] * 3,
        "box": {"camera": {"centre": [x, y, z + 0.1],
                           "axes": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]},
                "extent_m": [size] * 3},
        "oversize": oversize, "strike": {"point": point, "score": 0.5},
        "reasons": [{"code": "PASSES", "detail": ""}] if oversize is False else [],
    }  # fmt: skip


def frame(*lumps: dict[str, Any], status: str = "ok", withheld: Sequence[str] = ()) -> FrameLines:
    """The lines of a frame; what does not pass is a target."""
    ores = [{"id": id} | entry for id, entry in enumerate(lumps, 1)]
    given = status == "ok" and not withheld
    targets = [ore["id"] for ore in ores if given and ore["oversize"] is not False]
    record = {
        "status": status, "reasons": [], "withheld": list(withheld), "ores": ores,
        "targets": targets, "tracks": {"started": [], "ended": []},
        "grizzly": {"normal": [0.0, 0.0, -1.0], "openings_m": [OPENING_M]},
        "counts": {"pixels": 1, "disparities": 1, "ores": len(ores), "targets": len(targets)},
    }  # fmt: skip
    return FrameLines(json.dumps(record), "{}", "{}")


def watching(confirm: str = "1 of 1", earlier: Sequence[FrameLines] = ()) -> Watch:
    return Watch(Config(order=OrderConfig(confirm=confirm)), earlier=earlier)


def followed(frames: Sequence[FrameLines], confirm: str = "1 of 1") -> list[dict[str, Any]]:
    watch = watching(confirm)
    return [json.loads(watch.judge(each).record) for each in frames]


def numbers(record: dict[str, Any]) -> list[int]:
    return [ore["track"]["number"] for ore in record["ores"]]


def codes(ore: dict[str, Any]) -> list[str]:
    return [reason["code"] for reason in ore["reasons"]]


def events(records: Sequence[dict[str, Any]], kind: str) -> list[tuple[int, int, str]]:
    return [
        (place, event["track"], event["code"])
        for place, record in enumerate(records)
        for event in record["tracks"][kind]
    ]


def test_a_lump_keeps_its_number_whatever_its_id() -> None:
    near = (0.01, 0.0, 2.01)
    records = followed(
        [frame(lump(HERE), lump(THERE)), frame(lump(THERE), lump(near)), frame(lump(HERE))]
    )
    assert [numbers(record) for record in records] == [[1, 2], [2, 1], [1]]
    assert [record["ores"][0]["track"]["frames"] for record in records] == [1, 2, 3]


def test_size_flag_and_centre_are_means_weighed_by_their_deviations() -> None:
    sure, unsure = lump(HERE, 0.31), lump((0.015, 0.0, 2.0), 0.28, sigma=0.02)
    *_, last = followed([frame(sure), frame(sure), frame(unsure)])
    (ore,) = last["ores"]
    share = 1 / (1 + 2 * 4)
    assert ore["size_m"][1] == pytest.approx(0.31 - share * 0.03, abs=1e-6)
    assert ore["centre_of_gravity"]["camera"][0] == pytest.approx(share * 0.015, abs=1e-6)
    assert ore["centre_of_gravity"]["sigma_m"][0] == pytest.approx(0.01 + share * 0.01, abs=1e-6)
    # Alone the last frame says that it passes; together they don't, and it stays a target.
    assert (ore["oversize"], codes(ore), last["targets"]) == (True, [], [1])


def test_no_centre_of_gravity_lags_behind_a_lump_that_slides() -> None:
    places = [0.015 * k for k in range(40)]
    records = followed([frame(lump((x, 0.0, 2.0))) for x in places])
    assert {n for record in records for n in numbers(record)} == {1}
    for x, record in zip(places, records, strict=True):
        (ore,) = record["ores"]
        assert abs(ore["centre_of_gravity"]["camera"][0] - x) < STILL_SHARE * 2.2


def test_a_flag_at_the_edge_of_the_margin_stays_as_it_is() -> None:
    edge = [0.311, 0.307, 0.310, 0.308, 0.307]
    flags = [r["ores"][0]["oversize"] for r in followed([frame(lump(HERE, s)) for s in edge])]
    assert flags == [True] * 5
    flags = [r["ores"][0]["oversize"] for r in followed([frame(lump(HERE, s)) for s in edge[1:]])]
    assert flags == [None] * 4


def test_a_lump_that_passes_after_all_says_so_and_is_no_target() -> None:
    sizes = [0.31] + [0.27] * 8
    records = followed([frame(lump(HERE, size)) for size in sizes])
    assert (records[0]["targets"], records[-1]["targets"]) == ([1], [])
    assert codes(records[-1]["ores"][0]) == ["PASSES"]


def test_a_target_was_seen_in_n_of_m_frames() -> None:
    flake = lump((0.0, 0.5, 1.5))
    shown = [[lump(HERE)], [lump(HERE), flake], [lump(HERE)], [], [lump(HERE)]]
    records = followed([frame(*lumps) for lumps in shown], "3 of 5")
    assert [record["targets"] for record in records] == [[], [], [1], [], [1]]
    assert codes(records[1]["ores"][1]) == ["NOT_CONFIRMED"]
    assert (records[1]["status"], records[1]["counts"]["targets"]) == ("ok", 0)
    assert followed([frame(lump(HERE))])[0]["targets"] == [1]


def test_a_lump_that_falls_apart_in_one_frame_is_held_where_something_lies() -> None:
    parts = lump((-0.1, 0, 2), 0.2, 400), lump((0.1, 0, 2), 0.2, 400)
    whole = [frame(lump(HERE))] * 3
    *_, split = followed([*whole, frame(*parts)], "2 of 3")
    assert split["targets"] == [3]
    assert (numbers(split)[2], codes(split["ores"][2])) == (1, ["HELD"])
    assert split["counts"]["ores"] == len(split["ores"]) == 3
    *_, gone = followed([*whole, frame(lump(THERE, 0.2))], "2 of 3")
    assert gone["targets"] == []
    assert followed([*whole, frame(*parts)])[-1]["targets"] == []


def test_what_is_taken_away_and_put_in_is_told() -> None:
    shown = [[lump(HERE)]] * 3 + [[lump(THERE)]] * 5
    records = followed([frame(*lumps) for lumps in shown], "3 of 5")
    assert events(records, "started") == [(5, 2, "NEW_LUMP")]
    # A lump of the same size that comes as one goes is taken for the same.
    assert events(records, "ended") == [(7, 1, "MOVED")]
    emptied = followed([frame(lump(HERE))] + [frame(status="empty")] * PATIENCE)
    assert events(emptied, "ended") == [(PATIENCE, 1, "GONE")]


def test_a_broken_lump_ends_its_track() -> None:
    parts = lump((-0.12, 0, 2), 0.2, 400), lump((0.12, 0, 2), 0.2, 400)
    records = followed([frame(lump(HERE))] * 3 + [frame(*parts)] * 5, "3 of 5")
    assert events(records, "ended") == [(7, 1, "BROKEN")]
    assert numbers(records[-1]) == [2, 3]


def test_frames_that_are_not_good_neither_confirm_nor_end() -> None:
    bad = frame(status="degraded")
    records = followed([frame(lump(HERE)), *[bad] * 9, frame(lump(HERE))])
    assert numbers(records[-1]) == [1]
    assert events(records, "ended") == []
    assert records[1] == json.loads(bad.record)


def test_what_is_withheld_stays_withheld() -> None:
    sizes = [0.27] + [0.31] * 8
    records = followed([frame(lump(HERE, s), withheld=["NO_ARM_FRAME"]) for s in sizes])
    assert records[-1]["ores"][0]["oversize"] is not False
    assert all(record["targets"] == [] for record in records)


SHOWN = st.lists(
    st.lists(st.sampled_from([HERE, THERE, (0.02, 0.01, 2.0), (-0.5, 0.0, 1.5)]), max_size=3),
    max_size=20,
)


@given(SHOWN, st.integers(0, 20), st.sampled_from(["1 of 1", "2 of 3", "4 of 8"]))
@settings(deadline=None)
def test_a_run_that_is_continued_follows_as_one_that_never_stopped(
    shown: list[list[Place]], stop: int, confirm: str
) -> None:
    lines = [
        frame(*(lump(at, 0.29 + 0.01 * (k % 3), 1000 + k) for at in places))
        for k, places in enumerate(shown)
    ]
    watch = watching(confirm)
    whole = [watch.judge(each) for each in lines]
    later = watching(confirm, whole[:stop])
    assert [later.judge(each) for each in lines[stop:]] == whole[stop:]


@pytest.mark.parametrize("value", ["3", "0 of 5", "6 of 5", "3 of 101", "3of5", "true"])
def test_what_is_not_n_of_m_is_refused(value: str) -> None:
    with pytest.raises(ConfigError, match=r"order\.confirm"):
        load_config(None, [f"order.confirm={value}"])


def test_each_lump_of_a_still_scene_is_one_track_and_targets_do_not_flicker() -> None:
    spec = small_spec(5)
    scene = synth.scene(spec)
    chain = Chain(scene.calibration, scene.site)
    noisy = [replace(spec, sensor=replace(Sensor(), full_well=2000.0 + k)) for k in range(8)]
    frames = [
        frame_lines(chain(replace(synth.scene(each).pair, index=k)), scene.site, [])
        for k, each in enumerate(noisy)
    ]
    records = followed(frames, "3 of 5")
    assert all(record_fault(record) is None for record in records)
    assert {tuple(sorted(numbers(record))) for record in records} == {(1, 2, 3, 4)}
    steady = [[n for id in r["targets"] for n in numbers(r)[id - 1 : id]] for r in records]
    assert steady[:2] == [[], []]
    assert len({tuple(each) for each in steady[2:]}) == 1
    assert steady[2]
