"""The arm's posture, written into the OPC UA server as a controller does it."""

import json
import math
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from live import free_port, wait_for
from test_opcua_clients import CODES, Arm
from test_posture import NOW, SCENE, T, capsules_about, scene, site_with  # noqa: F401

pytest.importorskip("asyncua", reason="asyncua is not installed")

from asyncua import ua

from stereo_ore.chain import Chain
from stereo_ore.config import Config, ForeignConfig
from stereo_ore.errors import ConfigError
from stereo_ore.io.site import save_site
from stereo_ore.lab import synth
from stereo_ore.lab.synth.foreign import TOOL
from stereo_ore.plant.doctor import Plan, examine
from stereo_ore.plant.posture import PostureInbox
from stereo_ore.plant.sinks.opcua import OpcUaSink
from stereo_ore.plant.sinks.opcua_model import MODEL, POSTURE, POSTURE_SLOTS
from stereo_ore.plant.sinks.settings import load_sinks, open_sinks
from stereo_ore.types import PostureLink

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning:asyncua")

TYPES = {variable.name: ua.VariantType[variable.type] for variable in POSTURE}
ROD = {"name": "boom", "from_m": [0, 0, 1], "to_m": [0, 1, 1], "radius_m": 0.2}


class Place:
    """A server for all tests of this module, whose postures go to an inbox for each of them."""

    def __init__(self) -> None:
        self.inbox = PostureInbox(T)
        self.sink = OpcUaSink("127.0.0.1", free_port(), take_posture=self.take)

    def take(self, data: Any, where: str) -> None:
        self.inbox.take(data, where)


@pytest.fixture(scope="module")
def place() -> Iterator[Place]:
    place = Place()
    with place.sink:
        yield place


@pytest.fixture
def inbox(place: Place) -> PostureInbox:
    place.inbox = PostureInbox(T)
    return place.inbox


@pytest.fixture
def arm(place: Place) -> Iterator[Arm]:
    with Arm(place.sink.url) as arm:
        yield arm


def detail(place: Place) -> str:
    return place.sink.state().detail


def utc(stamp_ns: int) -> datetime:
    return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=stamp_ns // 1000)


def values(stamp_ns: int, *bodies: dict[str, Any]) -> dict[str, Any]:
    """What a controller writes for a posture; slots not in use hold what they like."""
    free = POSTURE_SLOTS - len(bodies)
    flat = {
        key: [float(x) for body in bodies for x in body[key]] + [math.nan] * 3 * free
        for key in ("from_m", "to_m")
    }
    return {
        "PostureStamp": utc(stamp_ns),
        "BodyCount": len(bodies),
        "Name": [body["name"] for body in bodies] + [""] * free,
        "From": flat["from_m"],
        "To": flat["to_m"],
        "Radius": [float(body["radius_m"]) for body in bodies] + [0.0] * free,
    }


def variant(name: str, value: Any, kind: ua.VariantType | None = None) -> ua.DataValue:
    return ua.DataValue(ua.Variant(value, kind or TYPES[name], is_array=isinstance(value, list)))


def write_all(arm: Arm, told: dict[str, Any]) -> dict[str, int]:
    """One request, in the order of `told`."""
    items = [
        ua.WriteValue(arm.id(name), ua.AttributeIds.Value, None,
                      value if isinstance(value, ua.DataValue) else variant(name, value))
        for name, value in told.items()
    ]  # fmt: skip
    answer = arm.client.aio_obj.uaclient.write(ua.WriteParameters(NodesToWrite=items))
    return dict(zip(told, (int(code.value) for code in arm.client.tloop.post(answer)), strict=True))


def stamps(inbox: PostureInbox) -> list[int]:
    return [posture.stamp_ns for posture in inbox.around(NOW)]


def test_one_request_is_one_posture_wherever_its_stamp_stands(
    arm: Arm, inbox: PostureInbox, place: Place
):
    told = values(NOW, ROD, {**ROD, "name": "chisel", "to_m": [1, 0, 1]})
    assert next(iter(told)) == "PostureStamp"
    assert set(write_all(arm, told).values()) == {CODES.Good}
    (posture,) = inbox.around(NOW)
    assert (posture.stamp_ns, [body.name for body in posture.bodies]) == (NOW, ["boom", "chisel"])
    end = posture.bodies[1].body.end
    assert (T[:3, :3] @ end + T[:3, 3]).tolist() == pytest.approx([1, 0, 1])
    assert "posture of 2 bodies" in detail(place)
    assert arm.read("From").Value.Value[:3] == [0, 0, 1]


def test_each_node_has_a_name_of_its_own():
    assert len({variable.name for variable in MODEL}) == len(MODEL)


def test_values_written_one_by_one_count_when_the_stamp_comes(arm: Arm, inbox: PostureInbox):
    told = values(NOW - 9_000, ROD)
    for name in ("BodyCount", "Name", "From", "To", "Radius"):
        assert arm.write(name, variant(name, told[name])) == CODES.Good
        assert inbox.around(NOW) == ()
    assert arm.write("PostureStamp", variant("PostureStamp", told["PostureStamp"])) == CODES.Good
    assert stamps(inbox) == [NOW - 9_000]
    # The next cycle writes what has changed: names and radii are what they were.
    told = values(NOW, {**ROD, "to_m": [0, 0, 2]})
    changed = {name: told[name] for name in ("From", "To", "PostureStamp")}
    assert set(write_all(arm, changed).values()) == {CODES.Good}
    (posture,) = inbox.around(NOW)
    assert (T[:3, :3] @ posture.bodies[0].body.end + T[:3, 3]).tolist() == pytest.approx([0, 0, 2])


def test_an_arm_that_is_away_has_no_bodies(arm: Arm, inbox: PostureInbox):
    assert set(write_all(arm, values(NOW)).values()) == {CODES.Good}
    assert [posture.bodies for posture in inbox.around(NOW)] == [()]


def test_a_stamp_before_all_was_written_hands_over_nothing():
    told, inbox = values(NOW, ROD), PostureInbox(T)
    with (
        OpcUaSink("127.0.0.1", free_port(), take_posture=inbox.take) as sink,
        Arm(sink.url) as arm,
    ):
        for name in told:
            value = arm.read(name)
            assert value.Value.VariantType is TYPES[name]
            assert not value.StatusCode.is_good()
        del told["Radius"]
        assert write_all(arm, told)["PostureStamp"] == CODES.BadInvalidState
        assert inbox.around(NOW) == ()
        assert "posture refused: Radius not written well" in sink.state().detail
        assert not arm.read("Radius").StatusCode.is_good()


BAD = {
    "a short list": ("From", variant("From", [0.0] * 3)),
    "a long list": ("Radius", variant("Radius", [0.1] * (POSTURE_SLOTS + 1))),
    "no list": ("To", variant("To", 1.0)),
    "a list": ("BodyCount", variant("BodyCount", [1])),
    "a list of stamps": ("PostureStamp", variant("PostureStamp", [utc(NOW)])),
    "an empty list": ("Name", variant("Name", [])),
    "whole numbers": ("From", variant("From", [0] * 3 * POSTURE_SLOTS, ua.VariantType.Int32)),
    "single precision": ("To", variant("To", [0.0] * 3 * POSTURE_SLOTS, ua.VariantType.Float)),
    "a signed count": ("BodyCount", variant("BodyCount", 1, ua.VariantType.Int32)),
    "a matrix": (
        "From",
        ua.DataValue(
            ua.Variant([[0.0] * 3] * POSTURE_SLOTS, ua.VariantType.Double, [POSTURE_SLOTS, 3], True)
        ),
    ),
    "a number for a stamp": ("PostureStamp", variant("PostureStamp", NOW, ua.VariantType.Int64)),
    "nothing": ("Radius", ua.DataValue(ua.Variant())),
}


@pytest.mark.parametrize("write", BAD)
def test_what_does_not_fit_is_refused_and_no_stamp_makes_up_for_it(
    arm: Arm, inbox: PostureInbox, place: Place, write: str
):
    name, value = BAD[write]
    assert set(write_all(arm, values(NOW - 10**9, ROD)).values()) == {CODES.Good}
    codes = write_all(arm, values(NOW, ROD) | {name: value})
    assert codes.pop(name) == CODES.BadTypeMismatch
    if name != "PostureStamp":
        assert codes.pop("PostureStamp") == CODES.BadInvalidState
        # Nor a later one, until the value is written well.
        assert arm.write("PostureStamp", variant("PostureStamp", utc(NOW))) == CODES.BadInvalidState
    assert set(codes.values()) == {CODES.Good}
    assert stamps(inbox) == [NOW - 10**9]
    assert set(write_all(arm, values(NOW, ROD)).values()) == {CODES.Good}
    assert stamps(inbox) == [NOW]
    assert place.sink.state().restarts == 0


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"BodyCount": POSTURE_SLOTS + 1}, "17 is more than the 16 slots"),
        ({"BodyCount": 2}, "bodies.1.name"),
        ({"Radius": [0.0] * POSTURE_SLOTS}, "radius_m"),
        ({"To": [math.nan] * 3 * POSTURE_SLOTS}, "to_m"),
        ({"To": [2500.0] * 3 * POSTURE_SLOTS}, "bodies.0.to_m.0: Input should be less than"),
        ({"To": [0.0, 0.0, 1.0] * POSTURE_SLOTS}, "one point"),
        ({"Name": [""] * POSTURE_SLOTS}, "name"),
        ({"Name": [None] * POSTURE_SLOTS}, "name"),
        ({"PostureStamp": datetime(1601, 1, 1, tzinfo=UTC)}, "stamp_ns"),
        ({"PostureStamp": datetime(9999, 1, 1, tzinfo=UTC)}, "stamp_ns"),
    ],
)
def test_what_is_no_posture_is_out_of_range_and_told(
    arm: Arm, inbox: PostureInbox, place: Place, changed: dict[str, Any], told: str
):
    codes = write_all(arm, values(NOW, ROD) | changed)
    assert codes.pop("PostureStamp") == CODES.BadOutOfRange
    assert set(codes.values()) == {CODES.Good}
    assert inbox.around(NOW) == ()
    assert told in detail(place)


@pytest.mark.parametrize("code", [CODES.BadNoCommunication, CODES.UncertainLastUsableValue])
def test_a_gateway_that_lost_its_controller_stamps_nothing(
    arm: Arm, inbox: PostureInbox, code: int
):
    status = ua.StatusCode(code)
    lost = {
        name: replace(variant(name, value), StatusCode=status)
        for name, value in values(NOW, ROD).items()
    }
    write_all(arm, lost)
    assert (
        write_all(arm, values(NOW, ROD) | {"To": lost["To"]})["PostureStamp"]
        == CODES.BadInvalidState
    )
    assert inbox.around(NOW) == ()
    assert set(write_all(arm, values(NOW, ROD)).values()) == {CODES.Good}
    assert stamps(inbox) == [NOW]


def test_a_part_of_an_array_is_not_written(arm: Arm):
    assert arm.write("From", variant("From", [0.0]), "3") == CODES.BadWriteNotSupported


def test_ranks_and_lengths_are_told(arm: Arm):
    for variable in POSTURE:
        node = arm.client.get_node(arm.id(variable.name))
        assert node.read_value_rank() == (-1 if variable.length is None else 1)
        assert (node.read_array_dimensions() or None) == (
            None if variable.length is None else [variable.length]
        )
        assert ua.AccessLevel.CurrentWrite in node.get_user_access_level()


def test_nothing_is_taken_where_nobody_wants_it():
    with OpcUaSink("127.0.0.1", free_port()) as sink, Arm(sink.url) as arm:
        for name, value in values(NOW, ROD).items():
            node = arm.client.get_node(arm.id(name))
            assert ua.AccessLevel.CurrentWrite not in node.get_user_access_level()
            assert arm.write(name, variant(name, value)) == CODES.BadUserAccessDenied
        assert "posture" not in sink.state().detail


def test_a_posture_without_the_server_is_refused(tmp_path: Path, inbox: PostureInbox):
    with pytest.raises(ConfigError, match=r"posture\.opcua.*Give --opcua PORT"):
        open_sinks(load_sinks(None, tcp=0), postures=inbox)
    (sink,) = open_sinks(load_sinks(None, opcua=free_port()), postures=inbox)
    assert isinstance(sink, OpcUaSink)
    site = replace(site_with(tmp_path, []), posture=PostureLink(0.2, opcua=True))
    save_site(site, tmp_path / "site.yaml")
    port = free_port()
    for ports, fault in (((), True), ((("opcua", port),), False)):
        found = [each for each in examine(Plan(site=tmp_path / "site.yaml", ports=ports))
                 if each.check == "consumers"]  # fmt: skip
        assert any("posture.opcua" in each.text for each in found) == fault


def test_what_is_written_masks_the_arm_out_until_it_is_old(
    scene: synth.Scene,  # noqa: F811
):
    site = replace(scene.site, posture=PostureLink(0.2, opcua=True))
    assert site.T_arm_camera is not None
    inbox = PostureInbox(site.T_arm_camera)
    chain = Chain(scene.calibration, site, Config(foreign=ForeignConfig(find=False)), inbox)
    with OpcUaSink("127.0.0.1", free_port(), take_posture=inbox.take) as sink, Arm(sink.url) as arm:
        before = chain(replace(scene.pair, stamp_ns=NOW))
        assert (before.targets, before.withheld) == ((), ("NO_POSTURE",))
        told = values(NOW, *capsules_about(scene, POSTURE_SLOTS))
        assert set(write_all(arm, told).values()) == {CODES.Good}
    fresh = chain(replace(scene.pair, stamp_ns=NOW + 10**8))
    assert (fresh.status, fresh.withheld) == ("ok", ())
    assert fresh.targets
    assert fresh.ore_map is not None
    on_tool = fresh.ore_map.labels[scene.instance == TOOL]
    assert np.count_nonzero(on_tool) < 0.1 * on_tool.size
    assert {body.source for body in fresh.foreign} == {"arm"}
    old = chain(replace(scene.pair, stamp_ns=NOW + 10**9))
    assert (old.status, old.targets, old.withheld) == ("ok", (), ("POSTURE_OLD",))


def test_serve_takes_in_what_is_written(tmp_path: Path):
    port, out, inbox = free_port(), tmp_path / "live", tmp_path / "inbox"
    site = replace(site_with(tmp_path, []), posture=PostureLink(60, opcua=True))
    save_site(site, tmp_path / "site.yaml")
    for eye in ("left", "right"):
        (inbox / eye).mkdir(parents=True)
    command = [sys.executable, "-m", "stereo_ore", "serve", "--watch", str(inbox),
               "--out", str(out), "--calib", str(SCENE / "calibration.yaml"),
               "--site", str(tmp_path / "site.yaml"), "--opcua", str(port)]  # fmt: skip
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as serve:
        try:
            wait_for(lambda: _listens(port), 60, what="the server")
            with Arm(f"opc.tcp://127.0.0.1:{port}/stereo-ore") as arm:
                away = {**ROD, "from_m": [9, 9, 9], "to_m": [9, 9, 8]}
                codes = write_all(arm, values(time.time_ns(), away))
                assert set(codes.values()) == {CODES.Good}
                for eye in ("left", "right"):
                    (inbox / eye / "a.png").write_bytes((SCENE / f"{eye}.png").read_bytes())
                wait_for(lambda: arm.read("Valid").Value.Value, 60, what="targets")
        finally:
            serve.terminate()
    (record,) = map(json.loads, (out / "frames.jsonl").read_text().splitlines())
    assert (record["withheld"], bool(record["targets"])) == ([], True)


def _listens(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port), 1).close()
    except OSError:
        return False
    return True
