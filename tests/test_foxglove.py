"""Results live in Foxglove, read by a client of its own WebSocket protocol, foxglove.sdk.v1."""

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from live import free_port, make_message
from runs import make_run

pytest.importorskip("foxglove", reason="the extra [foxglove] is not installed")
pytest.importorskip("rosbags", reason="the extra [foxglove] is not installed")
pytest.importorskip("websockets", reason="pip install websockets")

from websockets.sync.client import connect

from stereo_ore.errors import OutputError
from stereo_ore.io.results import Results
from stereo_ore.io.ros_channels import typestore
from stereo_ore.plant.sinks.foxglove import FoxgloveSink
from stereo_ore.plant.sinks.message import Origin, message, notice

KINDS = {
    "/stereo_ore/cloud": "sensor_msgs/msg/PointCloud2",
    "/stereo_ore/ores": "vision_msgs/msg/Detection3DArray",
    "/stereo_ore/targets": "geometry_msgs/msg/PoseArray",
    "/stereo_ore/overlay": "sensor_msgs/msg/CompressedImage",
    "/stereo_ore/record": "std_msgs/msg/String",
    "/tf_static": "tf2_msgs/msg/TFMessage",
}


class Viewer:
    """Subscribes to all that is advertised; the latest message of each topic, decoded."""

    def __init__(self, port: int) -> None:
        address, protocol = f"ws://127.0.0.1:{port}", "foxglove.sdk.v1"
        self.connection = connect(address, subprotocols=[protocol], max_size=None)
        self.store, self.topics, self.kinds = typestore(), {}, {}

    def __enter__(self) -> "Viewer":
        self.socket = self.connection.__enter__()
        return self

    def __exit__(self, *about: Any) -> None:
        self.connection.__exit__(*about)

    def take(self, wanted: set[str]) -> dict[str, Any]:
        """Messages until each wanted topic has come."""
        found: dict[str, Any] = {}
        while not wanted <= found.keys():
            data = self.socket.recv(timeout=30)
            if isinstance(data, bytes):
                opcode, id, _ = struct.unpack_from("<BIQ", data)
                if opcode == 1:
                    topic = self.topics[id]
                    found[topic] = self.store.deserialize_cdr(data[13:], self.kinds[topic])
            elif (said := json.loads(data))["op"] == "advertise":
                for channel in said["channels"]:
                    assert (channel["encoding"], channel["schemaEncoding"]) == ("cdr", "ros2msg")
                    self.topics[channel["id"]] = channel["topic"]
                    self.kinds[channel["topic"]] = channel["schemaName"]
                    wish = {"id": channel["id"], "channelId": channel["id"]}
                    self.socket.send(json.dumps({"op": "subscribe", "subscriptions": [wish]}))
        return found


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return make_run(tmp_path / "run")


@pytest.fixture
def sink(folder: Path) -> Iterator[FoxgloveSink]:
    results = Results(folder)
    with FoxgloveSink("127.0.0.1", free_port(), results, results.site.T_arm_camera) as sink:
        yield sink


def port_of(sink: FoxgloveSink) -> int:
    return int(sink.state().address.rpartition(":")[2])


def test_a_viewer_has_the_channels_of_an_exported_bag_late_or_early(
    sink: FoxgloveSink, folder: Path
) -> None:
    record = Results(folder).records[0]
    made = message(record, 1, Origin("s"), age_s=0.0, valid_for_s=60.0)
    with Viewer(port_of(sink)) as early:
        sink.show(made, record, 0.0)
        sink.show_files(record)
        with Viewer(port_of(sink)) as late:
            for viewer in (early, late):
                found = viewer.take(set(KINDS))
                assert viewer.kinds == KINDS
                assert json.loads(found["/stereo_ore/record"].data) == record
                assert len(found["/stereo_ore/targets"].poses) == len(made.targets) > 0
                cloud = Results(folder).cloud(record["frame"])
                assert found["/stereo_ore/cloud"].width == len(cloud)
                overlay = Results(folder).overlay(record["frame"]).read_bytes()
                assert bytes(found["/stereo_ore/overlay"].data) == overlay
            assert (sink.state().consumers, sink.state().alarm) == (2, "")
        sink.publish(notice(2, Origin("s"), "stopped"))
        # What the late one was sent again is before it in the queue.
        while early.take({"/stereo_ore/targets"})["/stereo_ore/targets"].poses:
            pass


def test_what_can_not_be_shown_is_an_alarm_and_no_end(sink: FoxgloveSink) -> None:
    sink.show(make_message(1), {"stamp_ns": 1, "ores": None}, 0.0)
    assert "can't publish" in sink.state().alarm
    sink.publish(notice(2, Origin("s"), "stopped"))
    assert sink.state().alarm == ""


def test_a_port_in_use_is_refused(sink: FoxgloveSink, folder: Path) -> None:
    with (
        pytest.raises(OutputError, match="can't serve Foxglove"),
        FoxgloveSink("127.0.0.1", port_of(sink), Results(folder), None),
    ):
        pass
