"""Side-by-side videos: every frame is the right one however it is reached, and damage is
reported."""

import pickle
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereo_ore.errors import FrameError, SourceError
from stereo_ore.io.recordings import open_source
from stereo_ore.io.recordings.video import Decoder, SideBySideVideo

COUNT, WIDTH, HEIGHT = 25, 128, 64
CONTAINERS = {"avi": "MJPG", "mp4": "mp4v", "mkv": "XVID"}


def brightness(number: int) -> int:
    return 20 + 9 * number


def write_video(path: Path, codec: str, count: int = COUNT, width: int = 2 * WIDTH) -> Path:
    """A video whose picture n has left eye of brightness(n) and right eye of half of that."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), 15, (width, HEIGHT))
    assert writer.isOpened()
    for number in range(count):
        image = np.full((HEIGHT, width, 3), brightness(number), np.uint8)
        image[:, width // 2 :] //= 2
        writer.write(image)
    writer.release()
    return path


@pytest.fixture(scope="module", params=CONTAINERS)
def video(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("video") / f"ride.{request.param}"
    return write_video(path, CONTAINERS[request.param])


def assert_frame(source: SideBySideVideo, index: int) -> None:
    pair = source.read(index)
    assert (pair.name, pair.index) == (f"{index:06d}", index)
    assert pair.left.shape == pair.right.shape == (HEIGHT, WIDTH, 3)
    assert pair.left.mean() == pytest.approx(brightness(index), abs=4)
    assert pair.right.mean() == pytest.approx(brightness(index) // 2, abs=4)


def test_frames_in_any_order_and_again(video: Path) -> None:
    source = open_source(video)
    assert source.names == tuple(f"{index:06d}" for index in range(COUNT))
    for index in (0, 1, 2, 17, 24, 3, 3, 23, 0):
        assert_frame(source, index)
    assert source.files(5) == (video,)
    assert source.description == {"kind": "side-by-side video", "frames": COUNT}
    assert source.calibration is None


def test_pickled_in_the_middle_reads_the_same(video: Path) -> None:
    source = open_source(video)
    assert_frame(source, 20)
    copy = pickle.loads(pickle.dumps(source))
    assert_frame(copy, 21)
    assert_frame(source, 21)


def test_the_same_picture_is_the_same_bytes_however_it_is_reached(video: Path) -> None:
    once, again = open_source(video), open_source(video)
    for index in range(15):
        once.read(index)
    np.testing.assert_array_equal(once.read(15).left, again.read(15).left)


def test_container_that_does_not_say_its_length(tmp_path: Path) -> None:
    jpeg = cv2.imencode(".jpg", np.full((HEIGHT, 2 * WIDTH, 3), 90, np.uint8))[1].tobytes()
    path = tmp_path / "stream.mjpg"
    path.write_bytes(jpeg * 7)
    assert len(Decoder(path).times_ms()) == 7
    assert open_source(path).read(6).left.mean() == pytest.approx(90, abs=4)


def test_cut_off_video_fails_frame_by_frame_or_at_once(tmp_path: Path) -> None:
    whole = write_video(tmp_path / "whole.avi", "MJPG")
    path = tmp_path / "cut.avi"
    path.write_bytes(whole.read_bytes()[: int(0.6 * whole.stat().st_size)])
    source = open_source(path)
    assert_frame(source, 5)
    if len(source.names) == COUNT:
        with pytest.raises(
            FrameError, match=r"cut\.avi: picture 24 of 25 can't be decoded"
        ) as caught:
            source.read(24)
        assert caught.value.code == "UNREADABLE_IMAGE"
    else:
        assert 5 < len(source.names) < COUNT
    assert_frame(source, 6)


def test_a_video_that_vanishes_fails_the_frame(tmp_path: Path) -> None:
    source = open_source(write_video(tmp_path / "x.avi", "MJPG", 3))
    source.read(1)
    (tmp_path / "x.avi").unlink()
    with pytest.raises(FrameError, match="can't be decoded"):
        source.read(0)


@pytest.mark.parametrize("suffix", [".avi", ".mp4", ".mkv"])
@pytest.mark.parametrize("content", [b"", b"hello world" * 99])
def test_what_is_no_video(
    suffix: str, content: bytes, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / f"x{suffix}"
    path.write_bytes(content)
    with pytest.raises(SourceError, match="can't be decoded as a video"):
        open_source(path)
    assert capfd.readouterr().err == ""


def test_video_in_a_path_with_odd_characters(tmp_path: Path) -> None:
    folder = tmp_path / "a %03d ö"
    folder.mkdir()
    shutil.copy(write_video(tmp_path / "x.avi", "MJPG", 3), folder / "x y.avi")
    assert_frame(open_source(folder / "x y.avi"), 2)
