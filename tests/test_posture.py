"""The arm's posture, from a file and over TCP: its parts are no ore, and an old one gives no
target."""

import json
import socket
import time
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from conftest import small_spec

from stereo_ore.chain import Chain
from stereo_ore.cli import launch
from stereo_ore.config import Config, ForeignConfig
from stereo_ore.errors import ConfigError, OutputError
from stereo_ore.io.posture import PostureFile, parse_posture, recorded_postures
from stereo_ore.io.site import load_site, save_site
from stereo_ore.lab import synth
from stereo_ore.lab.synth.foreign import TOOL
from stereo_ore.plant.posture import (
    PostureInbox,
    PostureServer,
    live_postures,
    posture_server,
    written_by_opcua,
)
from stereo_ore.runs.driver import frame_lines
from stereo_ore.stages.foreign import arm_places
from stereo_ore.types import Capsule, FrameResult, PostureLink, Site

SCENE = Path(__file__).parents[1] / "data" / "paper_03"
ROD = {"name": "boom", "from_m": [0, 0, 1], "to_m": [0, 1, 1], "radius_m": 0.2}
T = np.array([[0.0, 1, 0, 1], [1, 0, 0, 2], [0, 0, -1, 3], [0, 0, 0, 1]])
NOW = 10**18


def line(stamp_ns: int, *bodies: dict[str, Any]) -> bytes:
    told = {"schema": "stereo_ore/posture/1", "stamp_ns": stamp_ns, "bodies": bodies}
    return json.dumps(told).encode() + b"\n"


def site_with(folder: Path, lines: list[bytes], **more: Any) -> Site:
    """The demo's site, whose arm has told these lines."""
    (folder / "arm.jsonl").write_bytes(b"".join(lines))
    document = yaml.safe_load((SCENE / "site.yaml").read_text())
    document["posture"] = {"file": "arm.jsonl"} | more
    (folder / "site.yaml").write_text(yaml.safe_dump(document))
    return load_site(folder / "site.yaml")


def test_a_line_is_read_into_the_camera_frame() -> None:
    posture = parse_posture(line(7, ROD), T, "it")
    (body,) = posture.bodies
    assert (posture.stamp_ns, body.name, body.source) == (7, "boom", "arm")
    assert isinstance(body.body, Capsule)
    assert (T[:3, :3] @ body.body.end + T[:3, 3]).tolist() == pytest.approx([0, 1, 1])


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (b"{", "no JSON"),
        (b"\xff\xfe", "no JSON"),
        (line(-1), "stamp_ns"),
        (line(1).replace(b"1,", b"1.5,"), "stamp_ns"),
        (line(1).replace(b"posture/1", b"posture/2"), "schema"),
        (line(1, {**ROD, "radius": 1}), "radius"),
        (line(1, {**ROD, "radius_m": 0}), "radius_m"),
        (line(1, {**ROD, "to_m": [0, 0, 1]}), "one point"),
        (
            line(1, {**ROD, "to_m": [0, 1000, 1]}),
            "to_m.1: Input should be less than or equal to 25",
        ),
        (line(1, {**ROD, "to_m": [0, float("nan"), 1]}), "to_m"),
        (line(1, *[ROD] * 65), "bodies"),
        (b" " * 70_000, "bytes"),
    ],
)
def test_a_line_that_is_no_posture_is_refused_by_name(text: bytes, told: str) -> None:
    with pytest.raises(ConfigError) as fault:
        parse_posture(text, T, "arm.jsonl: line 3")
    assert "arm.jsonl: line 3" in str(fault.value)
    assert told in str(fault.value)


def test_a_file_gives_the_postures_around_a_time(tmp_path: Path) -> None:
    site = site_with(tmp_path, [line(10, ROD), b"\n", line(20), line(30, ROD)])
    told = recorded_postures(site)
    assert told is not None
    around = {t: [p.stamp_ns for p in told.around(t)] for t in (5, 10, 15, 30, 99)}
    assert around == {5: [10], 10: [10, 20], 15: [10, 20], 30: [30], 99: [30]}


@pytest.mark.parametrize(
    ("lines", "told"),
    [
        ([line(2), line(2)], "line 2: stamp_ns: 2 is not after 2"),
        ([line(2), b"{}"], "line 2"),
    ],
)
def test_a_file_with_a_wrong_line_is_refused(lines: list[bytes], told: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=told):
        recorded_postures(site_with(tmp_path, lines))


@pytest.mark.parametrize(
    ("posture", "told"),
    [
        ({}, "one of file, listen and opcua"),
        ({"file": "a", "listen": "localhost:1"}, "one of file, listen and opcua"),
        ({"listen": "localhost:1", "opcua": True}, "one of file, listen and opcua"),
        ({"opcua": False}, "opcua: Input should be True"),
        ({"listen": "5601"}, "listen"),
        ({"file": "a", "max_age_s": 0}, "max_age_s"),
        ({"file": "a", "max_age": 1}, "did you mean max_age_s"),
    ],
)
def test_a_broken_site_entry_is_refused_by_name(posture: Any, told: str, tmp_path: Path) -> None:
    document = yaml.safe_load((SCENE / "site.yaml").read_text()) | {"posture": posture}
    (tmp_path / "site.yaml").write_text(yaml.safe_dump(document))
    with pytest.raises(ConfigError, match=r"posture") as fault:
        load_site(tmp_path / "site.yaml")
    assert told in str(fault.value)


def test_a_posture_needs_the_arm_and_a_file_that_is_there(tmp_path: Path) -> None:
    site = site_with(tmp_path, [])
    (tmp_path / "arm.jsonl").unlink()
    with pytest.raises(ConfigError, match="can't be read"):
        recorded_postures(site)
    with pytest.raises(ConfigError, match=r"posture\.listen.*Give posture\.file"):
        recorded_postures(replace(site, posture=PostureLink(0.2, listen=("localhost", 1))))
    with pytest.raises(ConfigError, match=r"posture\.opcua.*Give posture\.file"):
        recorded_postures(replace(site, posture=PostureLink(0.2, opcua=True)))
    document = yaml.safe_load((tmp_path / "site.yaml").read_text())
    del document["arm_from_camera"], document["working_volume"]
    (tmp_path / "site.yaml").write_text(yaml.safe_dump(document))
    with pytest.raises(ConfigError, match="posture: is in the arm frame"):
        load_site(tmp_path / "site.yaml")


def test_a_site_with_a_posture_survives_a_round_trip(tmp_path: Path) -> None:
    for link in (
        PostureLink(0.5, file=tmp_path / "arm.jsonl"),
        PostureLink(1, listen=("127.0.0.1", 7)),
        PostureLink(1, opcua=True),
    ):
        site = replace(load_site(SCENE / "site.yaml"), posture=link)
        save_site(site, tmp_path / "site.yaml")
        assert load_site(tmp_path / "site.yaml").posture == link


# --- ages


def places(stamp_ns: int | None, *stamps: int) -> tuple[int, list[str]]:
    told = PostureFile(Path("arm"), np.eye(4), stamps, tuple(line(s, ROD) for s in stamps))
    bodies, doubts = arm_places(stamp_ns, told, PostureLink(0.2))
    return len(bodies), [doubt.code for doubt in doubts]


def test_postures_on_both_sides_are_used_and_an_old_one_is_told() -> None:
    ms = 10**6
    assert places(NOW, NOW - 100 * ms, NOW + 100 * ms) == (2, [])
    assert places(NOW, NOW - 100 * ms, NOW + 300 * ms) == (1, [])
    assert places(NOW, NOW - 250 * ms) == (1, ["POSTURE_OLD"])
    assert places(NOW) == (0, ["NO_POSTURE"])
    assert places(None, NOW) == (0, ["NO_POSTURE"])
    assert arm_places(NOW, None, None) == ((), ())


# --- in the chain


@pytest.fixture(scope="module")
def scene() -> synth.Scene:
    return synth.scene(replace(small_spec(3), seed=4, foreign=("hammer",)))


def capsules_about(scene: synth.Scene, parts: int = 24) -> list[dict[str, Any]]:
    """Balls about what is seen of the tool, as rods; the arm's frame is the world."""
    site = scene.site
    assert site.T_arm_camera is not None
    v, u = np.nonzero(scene.instance == TOOL)
    z = scene.depth_m[v, u]
    K = scene.rectified.K
    xyz = np.stack([(u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z, z], 1)
    xyz = xyz @ site.T_arm_camera[:3, :3].T + site.T_arm_camera[:3, 3]
    order = xyz[np.argsort(xyz[:, 2])]
    return [
        {"name": f"part {k}", "from_m": part.min(0).tolist(), "to_m": part.max(0).tolist(),
         "radius_m": 0.06}
        for k, part in enumerate(np.array_split(order, parts))
    ]  # fmt: skip


def seen(scene: synth.Scene, lines: list[bytes] | None, stamp_ns: int | None) -> FrameResult:
    site = replace(scene.site, posture=PostureLink(0.2, file=Path("arm")))
    told = None
    if lines is not None:
        stamps = tuple(json.loads(each)["stamp_ns"] for each in lines)
        told = PostureFile(Path("arm"), site.T_arm_camera, stamps, tuple(lines))
    chain = Chain(scene.calibration, site, Config(foreign=ForeignConfig(find=False)), told)
    return chain(replace(scene.pair, stamp_ns=stamp_ns))


def test_the_arm_is_masked_out_where_its_posture_has_it(scene: synth.Scene) -> None:
    result = seen(scene, [line(NOW, *capsules_about(scene))], NOW)
    assert (result.status, result.reasons) == ("ok", ())
    assert result.ore_map is not None
    on_tool = np.bincount(result.ore_map.labels[scene.instance == TOOL], minlength=9)[1:]
    assert on_tool.sum() < 0.1 * (scene.instance == TOOL).sum()
    assert {body.source for body in result.foreign} == {"arm"}
    assert result.targets


@pytest.mark.parametrize(
    ("lines", "stamp_ns", "code"),
    [
        ([line(NOW - 10**9, ROD)], NOW, "POSTURE_OLD"),
        (None, NOW, "NO_POSTURE"),
        ([line(NOW, ROD)], None, "NO_POSTURE"),
    ],
)
def test_without_a_fresh_posture_there_is_no_target(
    scene: synth.Scene, lines: list[bytes] | None, stamp_ns: int | None, code: str
) -> None:
    result = seen(scene, lines, stamp_ns)
    assert (result.status, result.targets, result.withheld) == ("ok", (), (code,))
    assert len(result.ores) > 0
    record = json.loads(frame_lines(result, scene.site, []).record)
    assert [reason["code"] for reason in record["reasons"]] == [code]


def test_run_matches_a_recorded_file_by_the_frames_stamps(tmp_path: Path) -> None:
    site_with(tmp_path, [line(NOW, {**ROD, "from_m": [5, 5, 5], "to_m": [5, 5, 6]})])
    arguments = [str(SCENE), "--calib", str(SCENE / "calibration.yaml"), "--no-report",
                 "--no-clouds", "--no-overlays", "--site", str(tmp_path / "site.yaml")]  # fmt: skip
    for name, start in (("fresh", "2001-09-09T01:46:40.1Z"), ("old", "2001-09-09T01:46:45Z")):
        out = tmp_path / name
        with pytest.raises(SystemExit, match="0"):
            launch(["run", *arguments, "--out", str(out), "--start-time", start])
        record = json.loads((out / "frames.jsonl").read_text())
        assert record["withheld"] == ([] if name == "fresh" else ["POSTURE_OLD"])
        assert bool(record["targets"]) == (name == "fresh")
        assert "posture" in json.loads((out / "run.json").read_text())["files"]


# --- over TCP


def wait_for(inbox: PostureInbox, stamps: list[int]) -> None:
    end = time.monotonic() + 10
    while [p.stamp_ns for p in inbox.around(NOW)] != stamps and time.monotonic() < end:
        time.sleep(0.01)
    assert [p.stamp_ns for p in inbox.around(NOW)] == stamps


def test_lines_that_come_over_tcp_are_the_newest_postures() -> None:
    inbox = PostureInbox(T)
    with PostureServer("127.0.0.1", 0, inbox) as server:
        assert inbox.around(NOW) == ()
        with socket.create_connection(("127.0.0.1", server.port)) as arm:
            arm.sendall(line(NOW - 2, ROD) + line(NOW - 1, ROD))
            wait_for(inbox, [NOW - 1])
            # The clock was set back: what was told before is of another time.
            arm.sendall(line(NOW - 5, ROD))
            wait_for(inbox, [NOW - 5])


def test_a_wrong_line_ends_the_connection_and_a_new_one_takes_the_place() -> None:
    inbox = PostureInbox(T)
    with PostureServer("127.0.0.1", 0, inbox) as server:
        with socket.create_connection(("127.0.0.1", server.port), 10) as arm:
            arm.sendall(line(NOW - 2) + b"no posture\n" + line(NOW - 1))
            assert arm.recv(1) == b""
            wait_for(inbox, [NOW - 2])
        with (
            socket.create_connection(("127.0.0.1", server.port), 10) as one,
            socket.create_connection(("127.0.0.1", server.port), 10) as other,
        ):
            assert one.recv(1) == b""
            other.sendall(line(NOW))
            wait_for(inbox, [NOW])


def test_the_port_is_that_of_the_site_and_a_taken_one_is_told(tmp_path: Path) -> None:
    site = site_with(tmp_path, [])
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        live = replace(site, posture=PostureLink(0.2, listen=("127.0.0.1", port)))
        inbox = live_postures(live)
        with (
            pytest.raises(OutputError, match=r"posture\.listen"),
            posture_server(live, inbox),
        ):
            pass
    with posture_server(live, inbox) as server:
        assert isinstance(server, PostureServer)
        assert server.port == port


def test_what_is_told_live_has_an_inbox_and_what_is_recorded_none(tmp_path: Path) -> None:
    site = site_with(tmp_path, [])
    written = replace(site, posture=PostureLink(0.2, opcua=True))
    for each in (site, Site(), replace(site, posture=None)):
        assert live_postures(each) is None
        assert isinstance(posture_server(each, None), nullcontext)
    inbox = live_postures(written)
    assert inbox is not None
    assert isinstance(posture_server(written, inbox), nullcontext)
    assert written_by_opcua(written, inbox) is inbox
    assert written_by_opcua(site, None) is None
