"""Bags of other recorders: the camera_info that counts, baselines, write-ahead logs, Foxglove,
RealSense."""

import contextlib
import shutil
import sqlite3
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bags import TOPICS, Camera, Shot, camera_info, header, image_message, write_bag
from recordings import access_units

from stereo_ore.errors import CalibrationError, FrameError, SourceError
from stereo_ore.io.recordings import open_source
from stereo_ore.io.recordings.bag_files import _image_length
from stereo_ore.io.recordings.ros_messages import _eye, image
from stereo_ore.io.recordings.topics import camera_info_topics

rosbags = pytest.importorskip("rosbags", reason="the extra [bags] is not installed")
pytest.importorskip("mcap", reason="the extra [bags] is not installed")

START = 1_700_000_000_000_000_000
PERIOD = 100_000_000
WIDTH, HEIGHT = 32, 20
INFOS = tuple(topic.rpartition("/")[0] + "/camera_info" for topic in TOPICS)

Message = tuple[str, int, Any]


def picture(number: int, eye: int) -> np.ndarray:
    return np.random.default_rng([number, eye]).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def store() -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


def write(
    path: Path, messages: Sequence[Message], storage: str = "MCAP", types: Any = None
) -> Path:
    """A ROS 2 bag of topic, time of recording and message."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    types = types or store()
    with Writer(path, version=9, storage_plugin=StoragePlugin[storage]) as bag:
        connections: dict[str, Any] = {}
        for topic, logged_ns, message in messages:
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, message.__msgtype__, typestore=types)
            bag.write(
                connections[topic], logged_ns, types.serialize_cdr(message, message.__msgtype__)
            )
    return path


def images(
    count: int, topics: tuple[str, str] = TOPICS, frames: tuple[str, str] = ("left", "right")
) -> list[Message]:
    found = []
    for n in range(count):
        for eye, topic in enumerate(topics):
            stamp = START + n * PERIOD
            message = image_message(
                store(), Shot(topic, stamp, stamp, picture(n, eye)), "bgr8", first=False
            )
            message.header.frame_id = frames[eye]
            found.append((topic, stamp, message))
    return found


def info(
    eye: int, stamp_ns: int, focal_px: float = 30.0, baseline_m: float = 0.12, frame: str = ""
) -> Any:
    camera = Camera(TOPICS[eye], (WIDTH, HEIGHT), (focal_px, focal_px), (16.0, 10.0), baseline_m)
    message = camera_info(store(), camera, first=False)
    message.header = header(store(), stamp_ns, first=False)
    message.header.frame_id = frame
    return message


def infos(times: Sequence[tuple[int, int, float]]) -> list[Message]:
    """camera_info of both eyes: recorded when, stamped when, focal length."""
    return [
        (INFOS[eye], logged, info(eye, stamp, focal))
        for logged, stamp, focal in times
        for eye in (0, 1)
    ]


def focal_of(path: Path) -> float:
    calibration = open_source(path).calibration
    assert calibration is not None
    return float(calibration.left.focal_px[0])


# --- which camera_info


@pytest.mark.parametrize(
    "times",
    {
        "a guess before": [(START - 9, 0, 20.0), (START - 5, 0, 30.0)],
        "the same stamp, recorded after": [
            (START - 9, 0, 20.0),
            *((START + n * PERIOD + 7, START + n * PERIOD, 30.0) for n in range(2)),
        ],
        "only after": [(START + 5, 0, 30.0)],
        "zeros first": [(START - 9, START, 0.0), (START - 5, 0, 30.0)],
    }.items(),
    ids=lambda item: item[0],
)  # fmt: skip
def test_the_camera_info_that_goes_with_the_images(
    times: tuple[str, list[Any]], tmp_path: Path
) -> None:
    messages = infos(times[1])
    for _, _, message in messages:
        if message.p[0] == 0:
            message.k[:] = 0
    assert (
        focal_of(write(tmp_path / "bag", sorted([*messages, *images(2)], key=lambda m: m[1])))
        == 30.0
    )


def test_two_that_differ_among_the_images_are_an_error_that_counts_them(tmp_path: Path) -> None:
    messages = infos([(START - 9, 0, 20.0), (START + PERIOD - 9, 0, 30.0)])
    source = open_source(
        write(tmp_path / "bag", sorted([*messages, *images(3)], key=lambda m: m[1]))
    )
    assert source.read(2).left.shape == (HEIGHT, WIDTH, 3), "with --calib it can be used"
    with pytest.raises(
        CalibrationError, match=r"2 different ones go with 1 and 2 images\. .*--calib"
    ):
        _ = source.calibration


def test_an_unusable_camera_info_ends_only_a_run_without_calib(tmp_path: Path) -> None:
    messages = [(INFOS[eye], START, info(eye, 0, baseline_m=0.0)) for eye in (0, 1)]
    source = open_source(write(tmp_path / "bag", [*messages, *images(1)]))
    assert len(source.names) == 1
    with pytest.raises(CalibrationError, match=r"baseline.*--calib"):
        _ = source.calibration


def test_where_a_camera_info_may_be() -> None:
    assert "/left/camera_info" in camera_info_topics("/left/image_rect/video")
    assert "/d/s/Infrared_1/info/camera_info" in camera_info_topics("/d/s/Infrared_1/image/data")
    assert "/d/s/Infrared_1/image/camera_info" in camera_info_topics(
        "/d/s/Infrared_1/image/data/compressed"
    )


# --- baselines from elsewhere


def transform(child: str, parent: str, x: float) -> Any:
    types = store().types
    zero = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    moved = types["geometry_msgs/msg/Transform"](
        types["geometry_msgs/msg/Vector3"](x, 0.0, 0.0), zero
    )
    head = header(store(), 0, first=False)
    head.frame_id = parent
    return types["geometry_msgs/msg/TransformStamped"](head, child, moved)


def test_the_baseline_may_be_in_the_static_tree(tmp_path: Path) -> None:
    tree = store().types["tf2_msgs/msg/TFMessage"](
        [transform("l", "base", -0.05), transform("r", "base", 0.07)]
    )
    messages = [
        (INFOS[eye], START, info(eye, 0, baseline_m=0.0, frame="lr"[eye])) for eye in (0, 1)
    ]
    source = open_source(
        write(tmp_path / "bag", [("/tf_static", START, tree), *messages, *images(1)])
    )
    np.testing.assert_allclose(source.calibration.t_right_left, [-0.12, 0, 0], atol=1e-12)


def test_a_tree_that_does_not_hold_the_cameras_gives_no_baseline(tmp_path: Path) -> None:
    tree = store().types["tf2_msgs/msg/TFMessage"](
        [transform("l", "base", 0.0), transform("r", "other", 0.12)]
    )
    messages = [
        (INFOS[eye], START, info(eye, 0, baseline_m=0.0, frame="lr"[eye])) for eye in (0, 1)
    ]
    with pytest.raises(CalibrationError, match="--calib"):
        _ = open_source(
            write(tmp_path / "bag", [("/tf_static", START, tree), *messages, *images(1)])
        ).calibration


# --- RealSense's recorders


def test_pairs_are_those_of_the_camera_s_time(tmp_path: Path) -> None:
    """The recorder stamps images as they reach it: here the eyes of one exposure are 40 ms
    apart."""
    topics = tuple(f"/device_0/sensor_0/Infrared_{n}/image/data" for n in (1, 2))
    text = store().types["std_msgs/msg/String"]
    messages: list[Message] = []
    for n in range(3):
        for eye, topic in enumerate(topics):
            logged = 5 + n * PERIOD + 40_000_000 * eye
            shot = Shot(topic, logged, logged, picture(n, eye))
            messages.append((topic, logged, image_message(store(), shot, "mono8", first=False)))
            said = (
                f"Frame number={n};timestamp_domain=Hardware"
                f" Clock;timestamp={1000 + 33.3 * n:.6f};Actual Fps=30;"
            )
            messages.append((topic.replace("/data", "/metadata"), logged, text(said)))
    source = open_source(write(tmp_path / "bag", messages))
    assert source.description["unpaired"] == 0
    assert [source.stamp(n).ns for n in range(3)] == [1_000_000_000, 1_033_300_000, 1_066_600_000]
    assert source.read(2).left.shape == (HEIGHT, WIDTH, 3)


def test_bytes_behind_a_ros1_image_are_left_out() -> None:
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS1_NOETIC)
    message = image_message(types, Shot("", 0, START, picture(0, 0)), "bgr8", first=True)
    data = bytes(types.serialize_ros1(message, message.__msgtype__))
    assert _image_length(data) == _image_length(data + bytes(4)) == len(data)
    assert _image_length(data[:10]) == 10


# --- write-ahead logs


def test_a_write_ahead_log_is_read_and_left_as_it_is(tmp_path: Path) -> None:
    folder = write(tmp_path / "bag", images(4), "SQLITE3")
    recorded = next(folder.glob("*.db3"))
    live = tmp_path / "live" / recorded.name
    live.parent.mkdir()
    shutil.copy(folder / "metadata.yaml", live.parent)
    with (
        contextlib.closing(sqlite3.connect(recorded)) as whole,
        contextlib.closing(sqlite3.connect(live)) as database,
    ):
        script = [
            line for line in whole.iterdump() if line not in ("BEGIN TRANSACTION;", "COMMIT;")
        ]
        database.executescript("\n".join(line for line in script if 'INTO "messages"' not in line))
        rows = [line for line in script if 'INTO "messages"' in line]
        assert len(rows) == 8
        database.execute("pragma journal_mode=wal")
        for place, row in enumerate(rows):
            database.execute(row)
            database.commit()
            if place == 1:
                database.execute("pragma wal_checkpoint(truncate)")
        copy = tmp_path / "copy"
        shutil.copytree(live.parent, copy)
    before = {path.name: path.read_bytes() for path in copy.iterdir()}
    assert any(name.endswith("-wal") and data for name, data in before.items())
    for path in (copy, copy / recorded.name):
        source = open_source(path)
        assert len(source.names) == 4
        np.testing.assert_array_equal(source.read(3).right, picture(3, 1))
    assert {
        path.name: path.read_bytes() for path in copy.iterdir() if not path.name.endswith("-shm")
    } == {name: data for name, data in before.items() if not name.endswith("-shm")}


# --- Foxglove


def foxglove_mcap(
    path: Path, kind: str, messages: Iterator[tuple[str, int, bytes]], schema: bytes
) -> Path:
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="", library="test")
        number = writer.register_schema(f"foxglove.{kind}", "protobuf", schema)
        channels: dict[str, int] = {}
        for topic, stamp, data in messages:
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "protobuf", number)
            writer.add_message(channels[topic], stamp, data, stamp)
        writer.finish()
    return path


def foxglove_types() -> tuple[bytes, Any]:
    """Schema and classes of RawImage and CompressedVideo, as Foxglove publishes them (the fields
    that matter)."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2

    file = descriptor_pb2.FileDescriptorProto(
        name="images.proto", package="foxglove", syntax="proto3"
    )
    file.dependency.append("google/protobuf/timestamp.proto")
    field = descriptor_pb2.FieldDescriptorProto
    kinds = {"text": field.TYPE_STRING, "fixed": field.TYPE_FIXED32, "bytes": field.TYPE_BYTES}
    for name, fields in {
        "RawImage": [
            *((name, number, "fixed") for name,
            number in (("width", 2), ("height", 3), ("step", 5))),
            *(("encoding", 4, "text"), ("frame_id", 7, "text"), ("data", 6, "bytes")),
        ],
        "CompressedVideo": [("frame_id", 2, "text"), ("data", 3, "bytes"), ("format", 4, "text")],
    }.items():  # fmt: skip
        message = file.message_type.add(name=name)
        message.field.add(
            name="timestamp",
            number=1,
            type=field.TYPE_MESSAGE,
            type_name=".google.protobuf.Timestamp",
            label=1,
        )
        for key, number, kind in fields:
            message.field.add(name=key, number=number, type=kinds[kind], label=1)
    stamps = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(stamps)
    schema = descriptor_pb2.FileDescriptorSet(file=[file, stamps])
    pool = descriptor_pool.DescriptorPool()
    for each in (stamps, file):
        pool.Add(each)
    make = message_factory.GetMessageClass
    return schema.SerializeToString(), lambda name: make(
        pool.FindMessageTypeByName(f"foxglove.{name}")
    )


def test_foxglove_raw_images(tmp_path: Path) -> None:
    schema, make = foxglove_types()

    def messages() -> Iterator[tuple[str, int, bytes]]:
        for n in range(3):
            for eye, topic in enumerate(("/left/image", "/right/image")):
                message = make("RawImage")(
                    width=WIDTH, height=HEIGHT, encoding="bgr8", step=3 * WIDTH
                )
                message.data = picture(n, eye).tobytes()
                message.timestamp.FromNanoseconds(START + n * PERIOD)
                yield topic, START + n * PERIOD + 5 + eye, message.SerializeToString()

    source = open_source(foxglove_mcap(tmp_path / "x.mcap", "RawImage", messages(), schema))
    assert source.names == tuple(str(START + n * PERIOD) for n in range(3))
    np.testing.assert_array_equal(source.read(2).right, picture(2, 1))
    assert source.calibration is None


@pytest.mark.parametrize("gop", [1, 3])
def test_foxglove_videos(gop: int, tmp_path: Path) -> None:
    pytest.importorskip("av")
    schema, make = foxglove_types()
    units = [access_units([picture(n, eye) for n in range(5)], gop=gop) for eye in (0, 1)]

    def messages() -> Iterator[tuple[str, int, bytes]]:
        for n in range(5):
            for eye, topic in enumerate(("/left/video", "/right/video")):
                message = make("CompressedVideo")(format="h264", data=units[eye][n])
                message.timestamp.FromNanoseconds(START + n * PERIOD)
                yield topic, START + n * PERIOD, message.SerializeToString()

    source = open_source(foxglove_mcap(tmp_path / "x.mcap", "CompressedVideo", messages(), schema))
    for index in (0, 4, 1, 3):
        np.testing.assert_array_equal(source.read(index).left, picture(index, 0))
        np.testing.assert_array_equal(source.read(index).right, picture(index, 1))


def test_a_whole_file_is_not_sent_to_repair(tmp_path: Path) -> None:
    schema, _ = foxglove_types()
    path = foxglove_mcap(
        tmp_path / "x.mcap", "Odometry", iter([("/pose", START, b"\x0a\x00")]), schema
    )
    with pytest.raises(
        SourceError, match=r"no image that can be read here: /pose \(protobuf foxglove\.Odometry\)"
    ) as caught:
        open_source(path)
    assert "repair" not in str(caught.value)


# --- H.264 in ROS messages


def test_h264_in_compressed_images(tmp_path: Path) -> None:
    pytest.importorskip("av")
    topics = tuple(f"{topic}/compressed" for topic in TOPICS)
    units = [access_units([picture(n, eye) for n in range(4)], gop=4) for eye in (0, 1)]
    make = store().types["sensor_msgs/msg/CompressedImage"]
    messages = []
    for n in range(4):
        stamp = START + n * PERIOD
        for eye, topic in enumerate(topics):
            data = np.frombuffer(units[eye][n], np.uint8)
            messages.append((topic, stamp, make(header(store(), stamp, first=False), "h264", data)))
    source = open_source(write(tmp_path / "bag", messages))
    for index in (3, 0, 2):
        np.testing.assert_array_equal(source.read(index).right, picture(index, 1))


FFMPEG_PACKET = """std_msgs/Header header
int32 width
int32 height
string encoding
uint64 pts
uint8 flags
bool is_bigendian
uint8[] data
"""


@pytest.mark.parametrize("encoding", ["h264", "libx264", "h264_nvenc"])
def test_packets_of_ffmpeg_image_transport(encoding: str, tmp_path: Path) -> None:
    pytest.importorskip("av")
    from rosbags.typesys import get_types_from_msg

    types, name = store(), "ffmpeg_image_transport_msgs/msg/FFMPEGPacket"
    types.register(get_types_from_msg(FFMPEG_PACKET, name))
    units = [access_units([picture(n, eye) for n in range(4)], gop=4) for eye in (0, 1)]
    messages = []
    for n in range(4):
        head = header(types, START + n * PERIOD, first=False)
        for eye, topic in enumerate(TOPICS):
            data = np.frombuffer(units[eye][n], np.uint8)
            packet = types.types[name](head, WIDTH, HEIGHT, encoding, n, n == 0, False, data)
            messages.append((f"{topic}/ffmpeg", START + n * PERIOD, packet))
    source = open_source(write(tmp_path / "bag", messages, types=types))
    for index in (3, 0, 2):
        np.testing.assert_array_equal(source.read(index).right, picture(index, 1))


def test_a_compression_that_is_not_read_is_named(tmp_path: Path) -> None:
    make = store().types["sensor_msgs/msg/CompressedImage"]
    data = np.frombuffer(zlib.compress(bytes(99)), np.uint8)
    message = make(header(store(), START, first=False), "bgr8; zstd", data)
    source = open_source(write(tmp_path / "bag", [(topic, START, message) for topic in TOPICS]))
    with pytest.raises(FrameError, match=r"its format is said to be 'bgr8; zstd'"):
        source.read(0)


# --- encodings of ROS images


def raw(encoding: str, pixels: np.ndarray, height: int = HEIGHT) -> Any:
    """An image message of two eyes' worth of nothing but its pixels."""
    step = pixels.nbytes // len(pixels)
    return store().types["sensor_msgs/msg/Image"](
        header(store(), START, first=False), height, WIDTH, encoding, 0, step,
        np.ascontiguousarray(pixels).view(np.uint8).ravel(),
    )  # fmt: skip


@pytest.mark.parametrize("size", [8, 16])
@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_patterns_of_8_and_16_bit(pattern: str, size: int) -> None:
    """A red surface is red, whichever pattern: only the red pixels of the sensor see it."""
    full = 2**size - 1
    tile = np.array([full * (colour == "r") for colour in pattern], f"u{size // 8}").reshape(2, 2)
    pixels = np.tile(tile, (HEIGHT // 2, WIDTH // 2))
    found = image(raw(f"bayer_{pattern}{size}", pixels), Path("bag"))
    assert found.dtype == pixels.dtype
    np.testing.assert_array_equal(
        found[4:-4, 4:-4], np.broadcast_to([0, 0, full], (HEIGHT - 8, WIDTH - 8, 3))
    )


@pytest.mark.parametrize("encoding", ["nv12", "nv21"])
def test_colours_in_half_as_many_rows_again(encoding: str) -> None:
    """BT.601 in its narrow range: red is Y 82, Cb 90, Cr 240 (ITU-R BT.601-7, rounded)."""
    colour = [90, 240] if encoding == "nv12" else [240, 90]
    pixels = np.concatenate([np.full(HEIGHT * WIDTH, 82), np.tile(colour, HEIGHT * WIDTH // 4)])
    rows = pixels.astype(np.uint8).reshape(HEIGHT * 3 // 2, WIDTH)
    found = image(raw(encoding, rows), Path("bag"))
    assert found.shape == (HEIGHT, WIDTH, 3)
    assert np.abs(found.astype(int) - [0, 0, 255]).max() <= 2
    with pytest.raises(FrameError, match="does not fit its"):
        image(raw(encoding, rows[:HEIGHT]), Path("bag"))


def test_colours_of_16_bit_with_alpha() -> None:
    pixels = np.tile(np.array([1000, 2000, 3000, 9], np.uint16), (HEIGHT, WIDTH, 1))
    for encoding, first in (("rgba16", 3000), ("bgra16", 1000)):
        assert image(raw(encoding, pixels), Path("bag"))[0, 0].tolist() == [
            first,
            2000,
            4000 - first,
        ]


def test_a_compressed_bag_is_a_folder_or_its_file(tmp_path: Path) -> None:
    (tmp_path / "alone.db3.zstd").write_bytes(b"x")
    with pytest.raises(SourceError, match=r"Unpack it: zstd -d alone\.db3\.zstd"):
        open_source(tmp_path / "alone.db3.zstd")
    folder = write_bag(
        tmp_path / "bag",
        "sqlite3",
        [Shot(t, START, START, picture(0, i)) for i, t in enumerate(TOPICS)],
    )
    assert len(open_source(folder).names) == 1


# --- windows of a sensor


def windowed(
    cx: float, cy: float, offset: tuple[int, int], size: tuple[int, int]
) -> dict[str, Any]:
    message = info(0, 0)
    message.k[2], message.k[5] = cx, cy
    message.roi.x_offset, message.roi.y_offset = offset
    message.width, message.height = message.roi.width, message.roi.height = size
    return _eye(message)


def test_a_size_that_is_the_window_s_is_resolved_by_the_principal_point() -> None:
    of_sensor = windowed(642.3, 361.7, (320, 120), (640, 480))
    assert (of_sensor["width"], of_sensor["height"], of_sensor["roi"]) == (
        960.0,
        600.0,
        (320, 120, 640, 480),
    )
    of_window = windowed(322.3, 241.7, (640, 480), (640, 480))
    assert (of_window["width"], of_window["roi"]) == (640.0, (0, 0, 0, 0))
    either = windowed(500.0, 300.0, (100, 100), (640, 480))
    assert (either["width"], either["roi"]) == (640.0, (100, 100, 640, 480)), "is to be refused"
