"""Recordings as real tools and people leave them: each of the inputs in ../shared/data gives its
right value."""

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereo_ore.cli import launch
from stereo_ore.errors import FrameError, SourceError
from stereo_ore.io.recordings import (
    BagOptions,
    Source,
    describe_recording,
    open_source,
    open_two_files,
)

ROOT = Path(__file__).parents[1]
SCENE = ROOT / "data" / "paper_03"


@dataclass(frozen=True)
class Run:
    """What the command made of a recording."""

    code: int
    out: str
    err: str
    records: tuple[dict[str, Any], ...]

    @property
    def statuses(self) -> list[str]:
        return [record["status"] for record in self.records]

    def nearest(self, frame: int, point: tuple[float, float, float], base: str = "camera") -> float:
        """Distance [m] from a point to the nearest ore's centre of gravity."""
        centres = [
            ore["centre_of_gravity"][base]
            for ore in self.records[frame]["ores"]
            if ore["centre_of_gravity"]
        ]
        return float(np.min(np.linalg.norm(np.array(centres) - point, axis=1)))


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Callable[..., Run]:
    def command(*arguments: object, name: str = "out") -> Run:
        out = tmp_path / name
        kept = [
            "--no-report",
            "--no-clouds",
            "--no-overlays",
            "--out",
            str(out),
            "--set",
            "health.refuse_frozen=false",
        ]
        with pytest.raises(SystemExit) as end:
            launch(["run", *map(str, arguments), *kept])
        printed = capsys.readouterr()
        file = out / "frames.jsonl"
        lines = file.read_text().splitlines() if file.exists() else []
        return Run(
            int(end.value.code or 0), printed.out, printed.err, tuple(map(json.loads, lines))
        )

    return command


def read_all(source: Source) -> int:
    """Number of frames that can be read."""
    for index in range(len(source.names)):
        pair = source.read(index)
        assert pair.stamp_source is not None
        assert pair.left.shape == pair.right.shape
    return len(source.names)


# --- ../shared/data/surprises

VIDEOS = {
    "recordings-01-mkv-fewer-than-there": ("recording.mkv", 6),
    "recordings-02-mkv-more-than-there": ("recording.mkv", 6),
    "recordings-03-depz-mjpeg-mkv": ("recording.mkv", 6),
    "recordings-04-mp4-display-rotation": ("recording.mp4", 2),
    "recordings-05-mkv-stereo-mode-right-first": ("recording.mkv", 2),
}
FIRST_ORES = {
    "recordings-04-mp4-display-rotation": ("arm", (0.216, 0.295, 0.070)),
    "recordings-05-mkv-stereo-mode-right-first": ("camera", (0.194, -0.198, 0.995)),
}


@pytest.mark.parametrize("name", VIDEOS)
def test_videos_of_real_recorders(name: str, shared_data: Path, run: Callable[..., Run]) -> None:
    folder = shared_data / "surprises" / name
    file, count = VIDEOS[name]
    done = run(
        folder / file, "--calib", folder / "calibration.yaml", "--site", folder / "site.yaml"
    )
    assert (done.code, done.statuses) == (0, ["ok"] * count)
    assert {record["stamp_source"] for record in done.records} <= {"container", "modification time"}
    if name in FIRST_ORES:
        base, point = FIRST_ORES[name]
        # Touching lumps may be one in a frame of a compressed video.
        assert min(done.nearest(frame, point, base) for frame in range(count)) < 0.03


BAGS = {
    "recordings-06-db3-with-wal": ("rec_0.db3", 3, False),
    "recordings-07-realsense-db3": ("recording.db3", 2, False),
    "recordings-08-realsense-bag": ("recording.bag", 2, False),
    "recordings-09-foxglove-mcap": ("recording.mcap", 3, False),
    "recordings-11-compressed-video-mcap": ("", 4, False),
    "recordings-07-realsense-db3, --calib": ("recording.db3", 2, True),
    "recordings-08-realsense-bag, --calib": ("recording.bag", 2, True),
}


@pytest.mark.parametrize("name", BAGS)
def test_bags_of_real_recorders(
    name: str, shared_data: Path, tmp_path: Path, run: Callable[..., Run]
) -> None:
    for package in ("rosbags", "mcap", "google.protobuf", "av"):
        pytest.importorskip(package)
    file, count, given = BAGS[name]
    folder = shutil.copytree(
        shared_data / "surprises" / name.partition(",")[0], tmp_path / "recording"
    )
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    calib = ["--calib", folder / "calibration.yaml"] if given else []
    done = run(folder / file, *calib, "--site", folder / "site.yaml")
    assert (done.code, done.statuses) == (0, ["ok"] * count), done.err
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    if not given:
        assert np.linalg.norm(open_source(folder / file).calibration.t_right_left) == pytest.approx(
            0.12, abs=1e-6
        )


@pytest.mark.parametrize("file", ["right_first.jps", "pair.mpo", "right_first.jpg", "pair.jpg"])
def test_recordings_10_jps_and_mpo(
    file: str, shared_data: Path, tmp_path: Path, run: Callable[..., Run]
) -> None:
    folder = shared_data / "surprises" / "recordings-10-jps-and-mpo"
    (source,) = (path for path in folder.iterdir() if path.stem == file.partition(".")[0])
    shutil.copy(source, tmp_path / file)
    done = run(
        tmp_path / file, "--calib", folder / "calibration.yaml", "--site", folder / "site.yaml"
    )
    assert (done.code, done.statuses) == (0, ["ok"])
    assert ("the right eye comes first" in done.err) == file.startswith("right")


# --- ../shared/data/reports


def test_10_vfr_video(shared_data: Path) -> None:
    source = open_source(shared_data / "reports" / "10-vfr-video" / "declared10.webm")
    assert read_all(source) == 20


def test_11_zstd_bag(shared_data: Path) -> None:
    pytest.importorskip("rosbags")
    folder = shared_data / "reports" / "11-zstd-bag" / "rec_db3"
    assert read_all(open_source(folder)) == read_all(open_source(folder / "rec_db3.db3.zstd")) == 2


ENCODINGS = {
    "protobuf.mcap": (
        r"no image that can be read here: /left/image \(protobuf foxglove\.CompressedImage\)"
    ),
    "video_only.mcap": (
        r"no image that can be read: /left/video \(foxglove_msgs/msg/CompressedVideo\)"
    ),
}


@pytest.mark.parametrize("file", ENCODINGS)
def test_12_mcap_other_encodings(file: str, shared_data: Path) -> None:
    pytest.importorskip("mcap")
    with pytest.raises(SourceError, match=ENCODINGS[file]) as caught:
        open_source(shared_data / "reports" / "12-mcap-other-encodings" / file)
    assert "repair" not in str(caught.value)


def test_12_mcap_of_ros1(shared_data: Path) -> None:
    pytest.importorskip("mcap")
    assert (
        read_all(open_source(shared_data / "reports" / "12-mcap-other-encodings" / "ros1.mcap"))
        == 2
    )


@pytest.mark.parametrize("layout", ["rec", "dirs", "--left --right"])
def test_18_two_videos(layout: str, shared_data: Path) -> None:
    folder = shared_data / "reports" / "18-two-videos"
    videos = folder / "rec" / "left.mp4", folder / "rec" / "right.mp4"
    source = open_two_files(*videos) if "--" in layout else open_source(folder / layout)
    assert read_all(source) == 4
    assert source.description == {"kind": "two videos", "frames": 4, "unpaired": 0}
    assert describe_recording(source).startswith("4 frames of two videos, 2 × 1280×720")


def test_26_hot_pixel(shared_data: Path, run: Callable[..., Run]) -> None:
    folder = shared_data / "reports" / "26-hot-pixel" / "hot"
    done = run(folder, "--calib", SCENE / "calibration.yaml", "--site", SCENE / "site.yaml")
    clean = run(
        SCENE, "--calib", SCENE / "calibration.yaml", "--site", SCENE / "site.yaml", name="clean"
    )
    assert (done.statuses, clean.statuses) == (["ok"], ["ok"])
    assert done.records[0]["targets"] == clean.records[0]["targets"] != []


@pytest.mark.parametrize(
    "name", ["plain", "extraneous1", "extraneous12", "pad4", "pad900", "pad4k", "rst", "trailer"]
)
def test_09_mjpeg_bytes(name: str, shared_data: Path) -> None:
    folder = shared_data / "reports" / "09-mjpeg-bytes"
    found, plain = (open_source(folder / each).read(0) for each in (name, "plain"))
    if name not in ("extraneous1", "rst"):  # whose pictures were encoded anew
        np.testing.assert_array_equal(found.left, plain.left)
    assert np.abs(found.right.astype(int) - plain.right).mean() < 3


# --- ../shared/data/reports2


def test_10_camera_info_first(shared_data: Path, run: Callable[..., Run]) -> None:
    pytest.importorskip("rosbags")
    site = shared_data / "reports2" / "site_noplane.yaml"
    done = run(shared_data / "reports2" / "10-camera-info-first", "--site", site)
    assert done.statuses == ["ok"]
    assert done.nearest(0, (0.195, -0.196, 0.992)) < 0.03


def test_11_video_rotation(shared_data: Path, run: Callable[..., Run]) -> None:
    folder = shared_data / "reports2"
    done = run(
        folder / "11-video-rotation" / "tagged180.mp4",
        "--calib", SCENE / "calibration.yaml", "--site", folder / "site_noplane.yaml",
    )  # fmt: skip
    assert done.statuses == ["ok"]
    assert "asks players to turn the picture by 180°; pixels are taken as stored" in done.err
    assert done.nearest(0, (0.191, -0.196, 0.998)) < 0.03


PAIRED = {
    "12-stamped-names": ("1764150000.104512", "1764150001.104498", "1764150002.104505"),
    "13-place-letters/two_lines": ("L_cam_0001", "R_cam_0001"),
    "13-place-letters/line_R": ("Line_R_cam_0001",),
    "14-memory-cards": ("DCIM_100MEDIA_IMAG0001",),
}


@pytest.mark.parametrize("name", PAIRED)
def test_files_that_are_one_frame(
    name: str, shared_data: Path, caplog: pytest.LogCaptureFixture
) -> None:
    source = open_source(shared_data / "reports2" / name)
    assert source.names == PAIRED[name]
    assert read_all(source) == len(PAIRED[name])
    assert ("names can be read in more than one way" in caplog.text) == name.endswith("two_lines")
    for left, right in source.pairs:
        assert [mark for mark in ("Line_R", "L_cam", "R_cam") if left.name.startswith(mark)] == [
            mark for mark in ("Line_R", "L_cam", "R_cam") if right.name.startswith(mark)
        ]


def test_12_stamped_names_are_paired_within_the_skew_alone(shared_data: Path) -> None:
    with pytest.raises(FrameError, match="partner"):
        open_source(
            shared_data / "reports2" / "12-stamped-names", BagOptions(max_skew_ms=0.1)
        ).read(0)


def test_12_stamped_names_give_the_stamps(shared_data: Path) -> None:
    pair = open_source(shared_data / "reports2" / "12-stamped-names").read(1)
    assert (pair.stamp_ns, pair.stamp_source) == (1_764_150_001_104_498_000, "file name")


def test_15_orientation_tag(shared_data: Path, run: Callable[..., Run]) -> None:
    folder = shared_data / "reports2"
    done = run(folder / "15-orientation-tag", "--calib", folder / "small_calibration.yaml")
    assert (done.code, done.statuses) == (3, ["failed"])
    assert done.records[0]["reasons"][0]["code"] == "ORIENTATION_MISMATCH"
    assert "right.jpg: says that it is to be turned by 180°, left.jpg does not say so" in done.err


def test_the_remedy_of_svo_names_the_mode_that_writes_both_eyes(tmp_path: Path) -> None:
    (tmp_path / "ride.svo").write_bytes(b"\xf5\xff\xff\xff" + bytes(100))
    with pytest.raises(SourceError, match=r"ZED_SVO_Export ride\.svo FOLDER 2"):
        open_source(tmp_path / "ride.svo")


def test_copies_keep_their_order_of_time(shared_data: Path, tmp_path: Path) -> None:
    """A video that says nothing of its beginning ended when its file was written."""
    source = shared_data / "surprises" / "recordings-01-mkv-fewer-than-there" / "recording.mkv"
    copy = Path(shutil.copy(source, tmp_path))
    os.utime(copy, ns=(0, 1_700_000_000_000_000_000))
    stamps = [open_source(copy).stamp(index).ns for index in range(6)]
    assert stamps == [1_700_000_000_000_000_000 - 33_000_000 * (5 - index) for index in range(6)]


WINDOWS = {"b_roi": (0.190, -0.199, 0.958), "b_oak14raw": (0.190, -0.199, 0.958)}


@pytest.mark.parametrize("name", WINDOWS)
def test_21_bag_topics(name: str, shared_data: Path, run: Callable[..., Run]) -> None:
    pytest.importorskip("rosbags")
    folder = shared_data / "reports" / "21-bag-topics"
    done = run(folder / name, "--site", folder / "site_noplane.yaml")
    assert done.statuses == ["ok"], done.err
    centroids = [ore["surface_centroid"]["camera"] for ore in done.records[0]["ores"]]
    assert np.min(np.linalg.norm(np.array(centroids) - WINDOWS[name], axis=1)) < 0.03
