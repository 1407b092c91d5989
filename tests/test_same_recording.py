"""Twenty frames written in every form that keeps all pixels: each reads as the same frames in the
same order, and a run of each gives the same records."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
from bags import TOPICS, Shot, image_message, write_bag
from recordings import write_svo2, write_video
from runs import quarter_scene

from stereo_ore.cli import launch
from stereo_ore.io.recordings import Source, open_source

pytest.importorskip("rosbags", reason="the extra [bags] is not installed")
pytest.importorskip("av", reason="the extra [svo] is not installed")

START, PERIOD, COUNT = 1_700_000_000_000_000_000, 100_000_000, 20
WIDTH, HEIGHT = 64, 48


class Shown(NamedTuple):
    """A frame to write: its stamp [ns], and the pictures of both eyes."""

    stamp: int
    left: np.ndarray
    right: np.ndarray


Frames = Sequence[Shown]


def picture(number: int, eye: int) -> np.ndarray:
    noise = np.random.default_rng([number, eye]).integers(
        0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8
    )
    return cv2.GaussianBlur(noise, (5, 5), 1)


FRAMES = [Shown(START + n * PERIOD, picture(n, 0), picture(n, 1)) for n in range(COUNT)]
Write = Callable[[Path, Frames], Path]


def files(left: str, right: str, suffix: str = "png") -> Write:
    """Images by the patterns of their names."""

    def write(folder: Path, frames: Frames) -> Path:
        for stamp, *pair in frames:
            for pattern, image in zip((left, right), pair, strict=True):
                path = folder / f"{pattern.format(stamp)}.{suffix}"
                path.parent.mkdir(parents=True, exist_ok=True)
                assert cv2.imwrite(str(path), image)
        return folder

    return write


def side_by_side(folder: Path, frames: Frames) -> Path:
    folder.mkdir()
    for stamp, *pair in frames:
        assert cv2.imwrite(str(folder / f"{stamp}.png"), np.hstack(pair))
    return folder


def video(folder: Path, frames: Frames) -> Path:
    folder.mkdir()
    return write_video(folder / "both.mkv", [np.hstack(pair) for _, *pair in frames])


def two_videos(folder: Path, frames: Frames) -> Path:
    folder.mkdir()
    write_video(folder / "left.mkv", [frame.left for frame in frames])
    write_video(folder / "right.mkv", [frame.right for frame in frames])
    return folder


def svo2(folder: Path, frames: Frames) -> Path:
    folder.mkdir()
    pairs = [(frame.left, frame.right) for frame in frames]
    return write_svo2(folder / "ride.svo2", pairs, [frame.stamp for frame in frames])


def shots(frames: Frames) -> list[Shot]:
    return [
        Shot(topic, stamp, stamp, image)
        for stamp, *pair in frames
        for topic, image in zip(TOPICS, pair, strict=True)
    ]


def bag(kind: str, encoding: str = "bgr8") -> Write:
    return lambda folder, frames: write_bag(folder, kind, shots(frames), encoding=encoding)


def compressed_bag(mode: str) -> Write:
    def write(folder: Path, frames: Frames) -> Path:
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
            for shot in shots(frames):
                data = store.serialize_cdr(image_message(store, shot, "bgr8", first=False), kind)
                opened.write(connections[shot.topic], shot.logged_ns, data)
        return folder

    return write


FORMS: dict[str, Write] = {
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
    source: Source = open_source(FORMS[form](tmp_path / "recording", FRAMES))
    assert len(source.names) == COUNT
    for index in (*range(COUNT), 3):
        pair, shown = source.read(index), FRAMES[index]
        np.testing.assert_array_equal(pair.left, shown.left)
        np.testing.assert_array_equal(pair.right, shown.right)
        assert pair.index == index
        if "video" not in form:
            assert (pair.name, pair.stamp_ns) == (str(shown.stamp), shown.stamp)
        else:
            assert pair.stamp_ns - source.stamp(0).ns == index * PERIOD


# --- and through `run`


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> tuple[Frames, list[str]]:
    """Twenty frames with ore, no two alike, and the arguments that give calibration and site."""
    folder = tmp_path_factory.mktemp("scene")
    known = quarter_scene(folder)
    eyes = [cv2.imread(str(folder / f"{eye}.png")) for eye in ("left", "right")]
    noise = np.random.default_rng(0).integers(0, 4, (COUNT, *eyes[0].shape), np.uint8)
    frames = [
        Shown(START + n * PERIOD, *(cv2.add(eye, grain) for eye in eyes))
        for n, grain in enumerate(noise)
    ]
    return frames, known


def run(write: Write, frames: Frames, known: list[str], folder: Path) -> list[dict[str, Any]]:
    """The records of a run of the frames in one form."""
    folder.mkdir(exist_ok=True)
    source = write(folder / "recording", frames)
    options = ["--no-report", "--no-clouds", "--no-overlays", "--set", "order.include=all"]
    with pytest.raises(SystemExit) as end:
        launch(["run", str(source), *known, "--out", str(folder / "out"), *options])
    assert end.value.code == 0
    lines = (folder / "out" / "frames.jsonl").read_text(encoding="utf-8").splitlines()
    return [json.loads(line) for line in lines]


def origin(form: str) -> str:
    """Where stamps are from; these videos say nothing of their beginning."""
    if "video" in form:
        return "modification time"
    return "header" if form.startswith(("ROS", "SVO2")) else "file name"


def without_source(record: dict[str, Any], form: str) -> str:
    """A record as text, but for what the form can't say: a video knows no stamps of its frames and
    no names."""
    other = {"stamp_source"} | ({"stamp_ns", "frame"} if "video" in form else set())
    return json.dumps({key: value for key, value in record.items() if key not in other})


PLAIN = "subfolders"


def check_records(form: str, count: int, expected: list[dict[str, Any]], *made: Any) -> None:
    found = run(FORMS[form], *made)
    assert len(found) == len(expected) == count
    assert {entry["stamp_source"] for entry in found} == {origin(form)}
    assert [without_source(entry, form) for entry in found] == [
        without_source(entry, form) for entry in expected
    ]


@pytest.fixture(scope="module")
def expected(
    scene: tuple[Frames, list[str]], tmp_path_factory: pytest.TempPathFactory
) -> list[dict[str, Any]]:
    frames, known = scene
    records = run(FORMS[PLAIN], frames[:2], known, tmp_path_factory.mktemp("plain"))
    assert all(entry["status"] == "ok" and entry["targets"] for entry in records)
    return records


@pytest.mark.parametrize("form", FORMS)
def test_a_run_of_every_form_gives_the_same_records(
    form: str,
    scene: tuple[Frames, list[str]],
    expected: list[dict[str, Any]],
    tmp_path: Path,
) -> None:
    frames, known = scene
    check_records(form, 2, expected, frames[:2], known, tmp_path)


@pytest.mark.slow
def test_a_run_of_all_twenty_frames_gives_the_same_records_from_every_form(
    scene: tuple[Frames, list[str]], tmp_path: Path
) -> None:
    frames, known = scene
    plain = run(FORMS[PLAIN], frames, known, tmp_path / "plain")
    for form in FORMS:
        check_records(form, COUNT, plain, frames, known, tmp_path / form)
