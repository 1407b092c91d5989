"""The MCAP bag of a run, opened again by rosbags and by the reference reader."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import node
import numpy as np
import pytest
import yaml
from runs import PERIOD, STAMP, cloud, make_run, of_today, ore, record

from stereo_ore.errors import OutputError, SourceError
from stereo_ore.io.results import Results

pytest.importorskip("rosbags", reason="the extra [bags] is not installed")

from rosbags.highlevel import AnyReader

from stereo_ore.export.mcap import write_mcap

SCHEMAS = {
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/stereo_ore/cloud": "sensor_msgs/msg/PointCloud2",
    "/stereo_ore/ores": "vision_msgs/msg/Detection3DArray",
    "/stereo_ore/targets": "geometry_msgs/msg/PoseArray",
    "/stereo_ore/overlay": "sensor_msgs/msg/CompressedImage",
    "/stereo_ore/record": "std_msgs/msg/String",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("mcap") / "run")


@pytest.fixture(scope="module")
def bag(folder: Path) -> Path:
    return write_mcap(Results(folder), folder.parent / "bag")


@pytest.fixture(scope="module")
def messages(bag: Path) -> dict[str, list[tuple[int, Any]]]:
    found: dict[str, list[tuple[int, Any]]] = {}
    with AnyReader([bag.parent]) as reader:
        for connection, stamp, data in reader.messages():
            found.setdefault(connection.topic, []).append(
                (stamp, reader.deserialize(data, connection.msgtype))
            )
    return found


def rotate(quaternion: Any, vector: list[float]) -> np.ndarray:
    w, v = quaternion.w, np.array([quaternion.x, quaternion.y, quaternion.z])
    return np.array(vector) + 2 * np.cross(v, np.cross(v, vector) + w * np.array(vector))


def test_reference_reader_sees_the_schemas_and_counts(bag: Path) -> None:
    reader = pytest.importorskip("mcap.reader", reason="the reference reader is not installed")
    with bag.open("rb") as file:
        summary = reader.make_reader(file, validate_crcs=True).get_summary()
        assert summary is not None
        counts = summary.statistics.channel_message_counts
        found = {
            channel.topic: (summary.schemas[channel.schema_id].name, counts[id])
            for id, channel in summary.channels.items()
        }
        definition = {schema.name: schema.data.decode() for schema in summary.schemas.values()}
        read = sum(1 for _ in reader.make_reader(file).iter_messages())
    numbers = {"/tf_static": 1, "/stereo_ore/cloud": 2, "/stereo_ore/overlay": 2}
    assert found == {topic: (schema, numbers.get(topic, 3)) for topic, schema in SCHEMAS.items()}
    assert "Detection3D[] detections" in definition["vision_msgs/msg/Detection3DArray"]
    assert read == sum(number for _, number in found.values())


def test_static_transforms_are_offered_as_their_listeners_ask(bag: Path) -> None:
    """As ROS 2 writes them: reliable, transient local, keep last, depth 1, in the channel and in
    metadata.yaml."""
    reader = pytest.importorskip("mcap.reader", reason="the reference reader is not installed")
    with bag.open("rb") as file:
        channels = reader.make_reader(file).get_summary().channels.values()
    topics = yaml.safe_load((bag.parent / "metadata.yaml").read_text())[
        "rosbag2_bagfile_information"
    ]
    listed = {
        topic["topic_metadata"]["name"]: topic["topic_metadata"]
        for topic in topics["topics_with_message_count"]
    }
    for channel in channels:
        for written in (
            channel.metadata["offered_qos_profiles"],
            listed[channel.topic]["offered_qos_profiles"],
        ):
            profiles = yaml.safe_load(written) if isinstance(written, str) else written
            if channel.topic != "/tf_static":
                assert not profiles
                continue
            (profile,) = profiles
            names = {key: profile[key] for key in ("history", "depth", "reliability", "durability")}
            expected = {
                "history": "keep_last",
                "depth": 1,
                "reliability": "reliable",
                "durability": "transient_local",
            }
            numbers = {"history": 1, "depth": 1, "reliability": 1, "durability": 1}
            assert names in (expected, numbers)
    with AnyReader([bag.parent]) as opened:
        (static,) = [
            connection for connection in opened.connections if connection.topic == "/tf_static"
        ]
        assert [profile.durability.name for profile in static.ext.offered_qos_profiles] == [
            "TRANSIENT_LOCAL"
        ]


def test_foxglove_reader_sees_the_same(bag: Path) -> None:
    rows = {
        row["topic"]: row for row in node.run("mcap_core.js", str(bag), packages=("@mcap/core",))
    }
    assert {topic: row["schema"] for topic, row in rows.items()} == SCHEMAS
    assert [
        rows[topic]["count"] for topic in ("/tf_static", "/stereo_ore/cloud", "/stereo_ore/record")
    ] == [1, 2, 3]
    assert "durability" in rows["/tf_static"]["qos"]


def test_stamps_are_those_of_the_frames(messages: dict[str, list[tuple[int, Any]]]) -> None:
    assert [stamp for stamp, _ in messages["/stereo_ore/record"]] == [
        STAMP + n * PERIOD for n in range(3)
    ]
    stamp, cloud_message = messages["/stereo_ore/cloud"][1]
    assert (
        cloud_message.header.stamp.sec * 10**9 + cloud_message.header.stamp.nanosec
        == stamp
        == STAMP + PERIOD
    )
    assert cloud_message.header.frame_id == "left_rectified"


def test_cloud_point_by_point(messages: dict[str, list[tuple[int, Any]]]) -> None:
    for number, (_, message) in enumerate(messages["/stereo_ore/cloud"]):
        kinds = {7: "<f4", 5: "<i4"}
        dtype = np.dtype(
            {
                "names": [field.name for field in message.fields],
                "formats": [kinds[field.datatype] for field in message.fields],
                "offsets": [field.offset for field in message.fields],
                "itemsize": message.point_step,
            }
        )
        table = np.frombuffer(message.data.tobytes(), dtype)
        expected = cloud(number)
        assert len(table) == message.width == len(expected)
        for name in ("x", "y", "z", "ore_id", "score"):
            np.testing.assert_array_equal(table[name], expected[name])
        packed = table["rgb"].copy().view("<u4")
        for name, shift in (("red", 16), ("green", 8), ("blue", 0)):
            np.testing.assert_array_equal((packed >> shift) & 255, expected[name])


def test_detections_are_the_solids(messages: dict[str, list[tuple[int, Any]]]) -> None:
    first, second = messages["/stereo_ore/ores"][0][1].detections
    assert (first.id, second.id) == ("1", "2")
    assert [detection.results[0].hypothesis.class_id for detection in (first, second)] == [
        "oversize",
        "passes",
    ]
    box = first.bbox
    assert (box.size.x, box.size.y, box.size.z) == (0.3, 0.2, 0.1)
    assert (box.center.position.x, box.center.position.z) == (0.1, 0.95)
    np.testing.assert_allclose(rotate(box.center.orientation, [0, 1, 0]), [0, 0, 1], atol=1e-9)
    covariance = first.results[0].pose.covariance.reshape(6, 6)
    np.testing.assert_allclose(np.diag(covariance), [1e-4, 4e-4, 9e-4, -1, -1, -1])


def test_targets_are_in_the_arm_frame_best_first_and_point_along_x(
    messages: dict[str, list[tuple[int, Any]]],
) -> None:
    message = messages["/stereo_ore/targets"][0][1]
    assert message.header.frame_id == "arm"
    assert [round(pose.position.y, 9) for pose in message.poses] == [0.2, 0.1]
    for pose in message.poses:
        np.testing.assert_allclose(rotate(pose.orientation, [1, 0, 0]), [0, 0.6, -0.8], atol=1e-9)
    assert [len(message.poses) for _, message in messages["/stereo_ore/targets"]] == [2, 0, 0]


def test_transform_and_record(folder: Path, messages: dict[str, list[tuple[int, Any]]]) -> None:
    transform = messages["/tf_static"][0][1].transforms[0]
    T = Results(folder).site.T_arm_camera
    assert (transform.header.frame_id, transform.child_frame_id) == ("arm", "left_rectified")
    np.testing.assert_allclose(rotate(transform.transform.rotation, [0, 0, 1]), T[:3, 2], atol=1e-6)
    assert transform.transform.translation.x == T[0, 3]
    lines = (folder / "frames.jsonl").read_text().splitlines()
    assert [json.loads(message.data) for _, message in messages["/stereo_ore/record"]] == [
        json.loads(x) for x in lines
    ]


def test_overlay_is_the_file(folder: Path, messages: dict[str, list[tuple[int, Any]]]) -> None:
    message = messages["/stereo_ore/overlay"][0][1]
    assert message.format == "png"
    assert message.data.tobytes() == (folder / "overlays" / "000000.png").read_bytes()


def test_the_record_says_where_stamps_are_from(tmp_path: Path) -> None:
    told = of_today(record(0, []), "modification time")
    path = write_mcap(Results(make_run(tmp_path / "run", [told])), tmp_path / "bag")
    with AnyReader([path]) as reader:
        ((at, data),) = [
            (stamp, json.loads(reader.deserialize(raw, c.msgtype).data))
            for c, stamp, raw in reader.messages()
            if c.topic == "/stereo_ore/record"
        ]
    assert (at, data["stamp_ns"], data["stamp_source"]) == (STAMP, STAMP, "modification time")


def test_without_stamps_and_arm(tmp_path: Path) -> None:
    records = [record(n, [ore(1)], stamp_ns=None, arm_frame=None) for n in (4, 5)]
    for entry in records:
        entry["ores"][0]["strike"]["point"]["arm"] = entry["ores"][0]["strike"]["direction"][
            "arm"
        ] = None
    folder = make_run(tmp_path / "run", records)
    (folder / "site.yaml").unlink()
    path = write_mcap(Results(folder), tmp_path / "bag")
    with AnyReader([path]) as reader:
        found = [
            (c.topic, stamp, reader.deserialize(data, c.msgtype))
            for c, stamp, data in reader.messages()
        ]
    assert "/tf_static" not in {topic for topic, _, _ in found}
    targets = [
        (stamp, message) for topic, stamp, message in found if topic == "/stereo_ore/targets"
    ]
    assert [stamp for stamp, _ in targets] == [4_000_000_000, 5_000_000_000]
    assert targets[0][1].header.frame_id == "left_rectified"
    np.testing.assert_allclose(
        rotate(targets[0][1].poses[0].orientation, [1, 0, 0]), [0, 0, 1], atol=1e-9
    )


def test_nothing_is_overwritten_and_nothing_half_done_stays(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    with pytest.raises(OutputError, match="there: exists already"):
        write_mcap(Results(folder), tmp_path / "there")
    broken = make_run(tmp_path / "run")
    (broken / "clouds" / "000001.ply").write_bytes(b"ply\nnonsense")
    with pytest.raises(Exception, match=r"000001\.ply"):
        write_mcap(Results(broken), tmp_path / "bag")
    assert not (tmp_path / "bag").exists()


def test_command_and_missing_extra(folder: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        ["stereo-ore", "export", folder, tmp_path / "bag"],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert (done.returncode, done.stdout.strip()) == (0, str(tmp_path / "bag" / "bag.mcap"))
    code = (
        "import sys; sys.modules['rosbags'] = None\nfrom stereo_ore.cli import launch;"
        f" launch(['export', {str(folder)!r}, {str(tmp_path / 'x')!r}])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert (
        done.stderr
        == 'error: the optional package rosbags is not installed. pip install "stereo-ore[bags]"\n'
    )


def test_folder_without_a_run(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"holds no frames\.jsonl"):
        write_mcap(Results(tmp_path), tmp_path / "bag")
    assert not (tmp_path / "bag").exists()
