"""Twenty frames written in every form that keeps all pixels: each reads as the same frames in the
same order."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from bags import TOPICS, Shot, image_message, write_bag
from recordings import write_svo2, write_video

from stereo_ore.io.recordings import Source, open_source

pytest.importorskip("rosbags", reason="the extra [bags] is not installed")
pytest.importorskip("av", reason="the extra [svo] is not installed")

START, PERIOD, COUNT = 1_700_000_000_000_000_000, 100_000_000, 20
WIDTH, HEIGHT = 64, 48
STAMPS = [START + n * PERIOD for n in range(COUNT)]


def picture(number: int, eye: int) -> np.ndarray:
    noise = np.random.default_rng([number, eye]).integers(
        0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8
    )
    return cv2.GaussianBlur(noise, (5, 5), 1)


PAIRS = [(picture(n, 0), picture(n, 1)) for n in range(COUNT)]


def files(left: str, right: str, suffix: str = "png") -> Callable[[Path], Path]:
    """Images by the patterns of their names."""

    def write(folder: Path) -> Path:
        for stamp, pair in zip(STAMPS, PAIRS, strict=True):
            for pattern, image in zip((left, right), pair, strict=True):
                path = folder / f"{pattern.format(stamp)}.{suffix}"
                path.parent.mkdir(parents=True, exist_ok=True)
                assert cv2.imwrite(str(path), image)
        return folder

    return write


def side_by_side(folder: Path) -> Path:
    folder.mkdir()
    for stamp, pair in zip(STAMPS, PAIRS, strict=True):
        assert cv2.imwrite(str(folder / f"{stamp}.png"), np.hstack(pair))
    return folder


def video(folder: Path) -> Path:
    folder.mkdir()
    return write_video(folder / "both.mkv", [np.hstack(pair) for pair in PAIRS])


def two_videos(folder: Path) -> Path:
    folder.mkdir()
    for eye, name in enumerate(("left", "right")):
        write_video(folder / f"{name}.mkv", [pair[eye] for pair in PAIRS])
    return folder


def svo2(folder: Path) -> Path:
    folder.mkdir()
    return write_svo2(folder / "ride.svo2", PAIRS, STAMPS)


def shots() -> list[Shot]:
    return [
        Shot(topic, stamp, stamp, image)
        for stamp, pair in zip(STAMPS, PAIRS, strict=True)
        for topic, image in zip(TOPICS, pair, strict=True)
    ]


def bag(kind: str, encoding: str = "bgr8") -> Callable[[Path], Path]:
    return lambda folder: write_bag(folder, kind, shots(), encoding=encoding)


def compressed_bag(mode: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore

        store: Any = get_typestore(Stores.ROS2_HUMBLE)
        writer = Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3)
        writer.set_compression(CompressionMode[mode], CompressionFormat.ZSTD)
        with writer as opened:
            kind = "sensor_msgs/msg/Image"
            connections = {
                topic: opened.add_connection(topic, kind, typestore=store) for topic in TOPICS
            }
            for shot in shots():
                data = store.serialize_cdr(image_message(store, shot, "bgr8", first=False), kind)
                opened.write(connections[shot.topic], shot.logged_ns, data)
        return folder

    return write


FORMS: dict[str, Callable[[Path], Path]] = {
    "subfolders": files("left/{}", "right/{}"),
    "marked names in subfolders": files("left/left{}", "right/right{}"),
    "ZED's export": files("left{}", "right{}"),
    "suffixes": files("{}_left", "{}_right"),
    "letters": files("{}_L", "{}_R"),
    "small letters": files("{}_l", "{}_r"),
    "folders a frame": files("{}/left", "{}/right"),
    "Middlebury": files("{}/im0", "{}/im1"),
    "KITTI raw": files("image_02/data/{}", "image_03/data/{}"),
    "KITTI odometry": files("image_2/{}", "image_3/{}"),
    "EuRoC": files("mav0/cam0/data/{}", "mav0/cam1/data/{}"),
    "RealSense": files("infra1/{}", "infra2/{}"),
    "rectified": files("left_rect/{}", "right_rect/{}"),
    "TIFF": files("left/{}", "right/{}", "tif"),
    "BMP": files("left/{}", "right/{}", "bmp"),
    "PPM": files("left/{}", "right/{}", "ppm"),
    "side by side": side_by_side,
    "video": video,
    "two videos": two_videos,
    "SVO2": svo2,
    "ROS 1": bag("ros1"),
    "ROS 2, sqlite3": bag("sqlite3", "rgb8"),
    "ROS 2, MCAP": bag("mcap"),
    "ROS 2, PNG": bag("mcap", "png"),
    "ROS 2, compressed by file": compressed_bag("FILE"),
    "ROS 2, compressed by message": compressed_bag("MESSAGE"),
}


@pytest.mark.parametrize("form", FORMS)
def test_twenty_frames_read_the_same_from_every_form(form: str, tmp_path: Path) -> None:
    source: Source = open_source(FORMS[form](tmp_path / "recording"))
    assert len(source.names) == COUNT
    for index in (*range(COUNT), 3):
        pair = source.read(index)
        np.testing.assert_array_equal(pair.left, PAIRS[index][0])
        np.testing.assert_array_equal(pair.right, PAIRS[index][1])
        assert pair.index == index
        if "video" not in form:
            assert (pair.name, pair.stamp_ns) == (str(STAMPS[index]), STAMPS[index])
        else:
            assert pair.stamp_ns - source.stamp(0).ns == index * PERIOD
