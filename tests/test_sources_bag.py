"""ROS 1, ROS 2 and MCAP recordings: pixels, pairing by stamp, topics, calibration, damage; sameness
with folders."""

import contextlib
import json
import pickle
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from bags import KINDS, TOPICS, Camera, Shot, write_bag
from hypothesis import given, settings
from hypothesis import strategies as st
from runs import quarter_scene

from stereo_ore.cli.recording import calibration_for
from stereo_ore.errors import CalibrationError, FrameError, SourceError
from stereo_ore.io.recordings import BagOptions, open_source, ros_messages
from stereo_ore.io.recordings.pairing import pair_by_stamp
from stereo_ore.io.recordings.topics import camera_info_topics, choose_topics, is_rectified

pytest.importorskip("rosbags", reason="the extra [bags] is not installed")

REPOSITORY = Path(__file__).parents[1]
START = 1_700_000_000_000_000_000
PERIOD = 66_666_667
WIDTH, HEIGHT = 32, 20


def picture(number: int, eye: int) -> np.ndarray:
    return np.random.default_rng([number, eye]).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def shots(count: int = 3, skew_ns: int = 0, topics: tuple[str, str] = TOPICS) -> list[Shot]:
    """Pairs whose messages are recorded some time after they were taken."""
    return [
        Shot(
            topic,
            START + n * PERIOD + 1_000_000 * (eye + 3),
            START + n * PERIOD + eye * skew_ns,
            picture(n, eye),
        )
        for n in range(count)
        for eye, topic in enumerate(topics)
    ]


def camera(topic: str, focal_px: float = 30.0) -> Camera:
    return Camera(topic, (WIDTH, HEIGHT), (focal_px, focal_px), (WIDTH / 2, HEIGHT / 2), 0.12)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("encoding", ["bgr8", "rgb8", "bgra8", "png"])
def test_pictures_and_stamps_come_back(kind: str, encoding: str, tmp_path: Path) -> None:
    source = open_source(write_bag(tmp_path / "bag", kind, shots(), encoding=encoding))
    assert source.names == tuple(str(START + n * PERIOD) for n in range(3))
    for n in (2, 0, 1):
        pair = source.read(n)
        assert (pair.index, pair.stamp_ns) == (n, START + n * PERIOD)
        np.testing.assert_array_equal(pair.left, picture(n, 0))
        np.testing.assert_array_equal(pair.right, picture(n, 1))
    assert all(file.is_file() for file in source.files(0))


@pytest.mark.parametrize("kind", KINDS)
def test_grey_images(kind: str, tmp_path: Path) -> None:
    pair = open_source(write_bag(tmp_path / "bag", kind, shots(1), encoding="mono8")).read(0)
    grey = cv2.cvtColor(picture(0, 0), cv2.COLOR_BGR2GRAY)
    np.testing.assert_array_equal(pair.left, np.repeat(grey[:, :, None], 3, 2))


def test_single_mcap_file_and_database_file(tmp_path: Path) -> None:
    for kind, suffix in (("mcap", "mcap"), ("sqlite3", "db3")):
        folder = write_bag(tmp_path / kind, kind, shots())
        source = open_source(folder / f"{kind}.{suffix}")
        np.testing.assert_array_equal(source.read(1).right, picture(1, 1))


def test_open_bag_can_be_sent_to_a_worker_and_read_again(tmp_path: Path) -> None:
    source = open_source(write_bag(tmp_path / "bag", "mcap", shots()))
    source.read(2)
    copy = pickle.loads(pickle.dumps(source))
    for n in (2, 0):
        np.testing.assert_array_equal(copy.read(n).left, source.read(n).left)


def test_a_lost_image_is_reported_and_shifts_nothing(tmp_path: Path) -> None:
    some = [
        shot
        for shot in shots(4)
        if shot.logged_ns not in (shots(4)[3].logged_ns, shots(4)[4].logged_ns)
    ]
    source = open_source(
        write_bag(tmp_path / "bag", "mcap", some)
    )  # frame 1 lacks its right eye, frame 2 its left
    assert source.names == tuple(str(START + n * PERIOD) for n in range(4))
    for n, missing in ((1, "right"), (2, "left")):
        with pytest.raises(
            FrameError, match=rf"frame {source.names[n]} has no {missing} image within 5 ms"
        ) as caught:
            source.read(n)
        assert caught.value.code == "UNPAIRED"
    np.testing.assert_array_equal(source.read(3).right, picture(3, 1))
    assert source.description["unpaired"] == 2


def test_skew_is_limited_and_counted(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", "sqlite3", shots(3, skew_ns=7_000_000))
    wide = open_source(path, BagOptions(max_skew_ms=8)).description
    assert (wide["frames"], wide["unpaired"], wide["max_skew_ms"]) == (3, 0, 8)
    assert dict(zip(wide["skew_ms"]["from"], wide["skew_ms"]["pairs"], strict=True))[5.0] == 3
    assert wide["skew_ms"]["largest"] == pytest.approx(7)
    narrow = open_source(path)
    assert (narrow.description["frames"], narrow.description["unpaired"]) == (6, 6)
    json.dumps(narrow.description)


def test_a_driver_without_stamps_is_paired_by_time_of_recording(tmp_path: Path) -> None:
    bare = [Shot(s.topic, s.logged_ns, 0, s.image) for s in shots(2)]
    source = open_source(write_bag(tmp_path / "bag", "ros1", bare))
    assert source.names[0] == str(START + 3_000_000)
    np.testing.assert_array_equal(source.read(1).right, picture(1, 1))


# --- encodings

BLUE, GREEN, RED = 50, 100, 200
Y, U, V = 123, 91, 176  # of that colour, BT.601 limited range


def mosaic(letters: str) -> np.ndarray:
    values = {"R": RED, "G": GREEN, "B": BLUE}
    return np.tile(
        np.array([values[letter] for letter in letters.upper()], np.uint8).reshape(2, 2), (4, 4)
    )


def message(encoding: str, rows: np.ndarray, width: int, big: bool = False) -> SimpleNamespace:
    flat = np.ascontiguousarray(rows).view(np.uint8).reshape(len(rows), -1)
    return SimpleNamespace(
        encoding=encoding,
        height=len(rows),
        width=width,
        step=flat.shape[1],
        is_bigendian=big,
        data=flat.ravel(),
    )


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_patterns(pattern: str) -> None:
    found = ros_messages.image(message(f"bayer_{pattern}8", mosaic(pattern), 8), Path("bag"))
    np.testing.assert_array_equal(found[2:-2, 2:-2], np.broadcast_to((BLUE, GREEN, RED), (4, 4, 3)))


@pytest.mark.parametrize(
    ("encoding", "order"),
    [("yuv422", (U, Y, V, Y)), ("yuv422_yuy2", (Y, U, Y, V)), ("uyvy", (U, Y, V, Y))],
)
def test_yuv(encoding: str, order: tuple[int, ...]) -> None:
    found = ros_messages.image(
        message(encoding, np.tile(np.array(order, np.uint8), (8, 4)), 8), Path("bag")
    )
    assert np.abs(found.astype(int) - (BLUE, GREEN, RED)).max() <= 3


@pytest.mark.parametrize("big", [False, True])
def test_16_bit_of_either_byte_order(big: bool) -> None:
    values = np.arange(48, dtype=np.uint16).reshape(6, 8) * 500
    stored = values.astype(">u2" if big else "<u2")
    found = ros_messages.image(message("mono16", stored, 8, big), Path("bag"))
    np.testing.assert_array_equal(found, np.repeat(values[:, :, None], 3, 2))


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"encoding": "32FC1"}, "image encoding '32FC1' is not known"),
        ({"height": 9}, "8×9 mono8 with a step of 8 does not fit its 64 bytes"),
        ({"step": 7}, "step of 7 does not fit"),
        ({"width": 0}, "0×8"),
        ({"data": np.zeros(0, np.uint8)}, "does not fit its 0 bytes"),
    ],
)
def test_images_that_contradict_themselves(change: dict[str, object], error: str) -> None:
    bad = message("mono8", np.zeros((8, 8), np.uint8), 8)
    vars(bad).update(change)
    with pytest.raises(FrameError, match=error):
        ros_messages.image(bad, Path("bag"))


# --- calibration


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["image_rect", "image_raw"])
def test_camera_info_is_the_calibration(kind: str, name: str, tmp_path: Path) -> None:
    topics = (f"/cam/left/{name}", f"/cam/right/{name}")
    cameras = [camera(topic) for topic in topics]
    calibration = open_source(
        write_bag(tmp_path / "bag", kind, shots(1, topics=topics), cameras)
    ).calibration
    assert calibration.images == ("rectified" if name == "image_rect" else "raw")
    assert calibration.image_size == (WIDTH, HEIGHT)
    assert calibration.left.focal_px == (30.0, 30.0)
    np.testing.assert_allclose(calibration.t_right_left, [-0.12, 0, 0], atol=1e-12)


def test_no_calibration_without_both_infos_or_when_they_are_empty(tmp_path: Path) -> None:
    one = [camera(TOPICS[0])]
    empty = [camera(topic, 0.0) for topic in TOPICS]
    assert open_source(write_bag(tmp_path / "one", "mcap", shots(1), one)).calibration is None
    assert open_source(write_bag(tmp_path / "none", "mcap", shots(1))).calibration is None
    with pytest.raises(CalibrationError, match="never calibrated"):
        _ = open_source(write_bag(tmp_path / "empty", "mcap", shots(1), empty)).calibration


# --- topics


@pytest.mark.parametrize(
    ("topics", "expected"),
    [
        (("/zed/left/image", "/zed/right/image"), ("/zed/left/image", "/zed/right/image")),
        (
            ("/right/image_raw", "/left/image_raw", "/rgb/image"),
            ("/left/image_raw", "/right/image_raw"),
        ),
        (("/cam_left", "/cam_right"), ("/cam_left", "/cam_right")),
        (
            (
                "/left/image",
                "/right/image",
                "/left/image/compressedDepth",
                "/right/image/compressedDepth",
            ),
            ("/left/image", "/right/image"),
        ),
        (
            ("/left/image", "/right/image", "/left/image/compressed", "/right/image/compressed"),
            ("/left/image", "/right/image"),
        ),
        (
            ("/left/image", "/left/image/compressed", "/right/image/compressed"),
            ("/left/image/compressed", "/right/image/compressed"),
        ),
    ],
)
def test_topics_are_recognised(topics: tuple[str, ...], expected: tuple[str, str]) -> None:
    assert choose_topics(topics, None, Path("bag")) == expected


@pytest.mark.parametrize(
    ("topics", "count"),
    [
        ((), 0),
        (("/a/image", "/b/image"), 0),
        (("/left/image_raw", "/right/image_rect"), 0),
        (("/left/image_raw", "/right/image_raw", "/b/left/image", "/b/right/image"), 2),
        (("/left/one", "/right/one", "/left/two", "/right/two"), 2),
    ],
)
def test_topics_are_never_guessed(topics: tuple[str, ...], count: int) -> None:
    with pytest.raises(
        SourceError, match=rf"has {count} pairs of left and right image topics"
    ) as caught:
        choose_topics(topics, None, Path("bag"))
    options = (
        f"--left-topic {topics[0]} --right-topic {topics[1]} or" if count else "image topics: "
    )
    other = f"--left-topic {topics[2]} --right-topic {topics[3]} or" if count else "image topics: "
    assert options in str(caught.value) or other in str(caught.value)


def test_of_one_camera_the_images_that_need_no_rectification_are_taken(tmp_path: Path) -> None:
    names = ("image_raw", "image_rect", "image_rect/compressed")
    topics = [f"/camera/{eye}/{name}" for eye in ("right", "left") for name in names]
    chosen = ("/camera/left/image_rect", "/camera/right/image_rect")
    assert choose_topics(topics, None, Path("bag")) == chosen


def test_a_calibration_of_raw_images_is_refused_for_rectified_ones(tmp_path: Path) -> None:
    topics = ("/left/image_rect", "/right/image_rect")
    path = write_bag(tmp_path / "bag", "mcap", shots(1, topics=topics))
    file = tmp_path / "raw.yaml"
    file.write_text(
        (REPOSITORY / "calib" / "zed2_hd720.yaml")
        .read_text()
        .replace("images: rectified", "images: raw")
    )
    with pytest.raises(CalibrationError, match="is for raw images, /left/image_rect has rect"):
        calibration_for(open_source(path), file)


def test_given_topics(tmp_path: Path) -> None:
    topics = ("/a/image", "/b/image")
    path = write_bag(tmp_path / "bag", "mcap", shots(1, topics=topics))
    np.testing.assert_array_equal(open_source(path, BagOptions(topics)).read(0).left, picture(0, 0))
    np.testing.assert_array_equal(
        open_source(path, BagOptions(topics[::-1])).read(0).left, picture(0, 1)
    )
    with pytest.raises(
        SourceError, match=r"has no image topic /c/image\. Image topics: /a/image, /b/image"
    ):
        open_source(path, BagOptions(("/a/image", "/c/image")))


def test_topics_on_the_command_line_come_in_pairs(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", "mcap", shots(1))
    command = [
        "stereo-ore",
        "run",
        str(path),
        "--left-topic",
        TOPICS[0],
        "--out",
        str(tmp_path / "out"),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert "give both --left-topic and --right-topic, or neither" in " ".join(
        done.stderr.replace("│", " ").split()
    )


def test_where_ros_puts_things() -> None:
    assert camera_info_topics("/zed/left/image_rect_color/compressed")[0] == "/zed/left/camera_info"
    assert is_rectified("/rectifier/left/image_raw") is False
    assert is_rectified("/left/image_rect_color/compressed") is True


# --- damage


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.97])
def test_cut_off_bag_is_an_error_or_failed_frames(kind: str, share: float, tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", kind, shots(20))
    file = (
        path
        if path.is_file()
        else next(child for child in path.iterdir() if child.name != "metadata.yaml")
    )
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    assert unharmed(path) < 20


def unharmed(path: Path) -> int:
    """Frames that can be read, each of them whole; opening and reading raise no other errors than
    typed ones."""
    count = 0
    with contextlib.suppress(SourceError):
        source = open_source(path)
        for n in range(len(source.names)):
            with contextlib.suppress(FrameError):
                pair = source.read(n)
                np.testing.assert_array_equal(pair.left, picture(n, 0))
                count += 1
    return count


@pytest.mark.parametrize("suffix", [".bag", ".mcap", ".db3"])
@pytest.mark.parametrize("content", [b"", b"hello world" * 99])
def test_what_is_no_bag(suffix: str, content: bytes, tmp_path: Path) -> None:
    (tmp_path / f"x{suffix}").write_bytes(content)
    with pytest.raises(SourceError, match="can't be read as a bag"):
        open_source(tmp_path / f"x{suffix}")


def test_bag_without_images(tmp_path: Path) -> None:
    cameras = [camera(topic) for topic in TOPICS]
    with pytest.raises(
        SourceError,
        match=r"holds no topic of images; its topics: \S+ \(sensor_msgs/msg/CameraInfo\),",
    ):
        open_source(write_bag(tmp_path / "bag", "mcap", [], cameras))


def test_missing_extra_is_one_line(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", "mcap", shots(1))
    code = (
        "import sys; sys.modules['rosbags'] = None\n"
        "from stereo_ore.cli import launch\n"
        f"launch(['run', {str(path)!r}, '--out', {str(tmp_path / 'out')!r}])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert done.stderr.splitlines() == [
        'error: the optional package rosbags is not installed. pip install "stereo-ore[bags]"'
    ]


# --- pairing

ascending = st.lists(st.integers(0, 400), unique=True, max_size=12).map(sorted)


@given(ascending, ascending, st.integers(0, 60))
@settings(deadline=None)
def test_pairing_uses_each_image_once_in_order_within_the_limit(
    left: list[int], right: list[int], limit: int
) -> None:
    pairs = pair_by_stamp(left, right, limit)
    assert [i for i, _ in pairs if i is not None] == list(range(len(left)))
    assert sorted(j for _, j in pairs if j is not None) == list(range(len(right)))
    stamps = [left[i] if i is not None else right[j] for i, j in pairs]
    assert stamps == sorted(stamps)
    for i, j in pairs:
        if i is not None and j is not None:
            assert abs(left[i] - right[j]) <= limit
            assert abs(left[i] - right[j]) == min(abs(left[i] - other) for other in right)


@given(
    st.lists(st.integers(0, 10**6), unique=True, min_size=1).map(sorted),
    st.integers(-20, 20),
    st.data(),
)
@settings(deadline=None)
def test_lost_images_never_shift_the_others(
    ticks: list[int], skew: int, data: st.DataObject
) -> None:
    stamps = [1000 * tick for tick in ticks]
    lost = data.draw(st.sets(st.integers(0, len(stamps) - 1)))
    right = {stamp + skew: n for n, stamp in enumerate(stamps) if n not in lost}
    pairs = pair_by_stamp(stamps, list(right), 50)
    found = {i: list(right.values())[j] for i, j in pairs if i is not None and j is not None}
    assert found == {n: n for n in range(len(stamps)) if n not in lost}


# --- the same recording in four forms gives the same bytes


@pytest.fixture(scope="module")
def forms(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Twenty frames as a PNG folder, side-by-side PNG, MCAP and a ROS 2 bag; names are stamps, as
    the bags' are.

    The MCAP carries the calibration that the others are given.
    """
    folder = tmp_path_factory.mktemp("forms")
    quarter_scene(folder / "scene")
    pair = [cv2.imread(str(folder / "scene" / f"{eye}.png")) for eye in ("left", "right")]
    messages = []
    for n in range(20):
        stamp = START + n * PERIOD
        images = [
            np.ascontiguousarray(np.clip(image.astype(int) + n, 0, 255).astype(np.uint8))
            for image in pair
        ]
        for eye, image in zip(("left", "right"), images, strict=True):
            (folder / "png" / eye).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / "png" / eye / f"{stamp}.png"), image)
        (folder / "side").mkdir(exist_ok=True)
        cv2.imwrite(str(folder / "side" / f"{stamp}.png"), np.hstack(images))
        messages += [
            Shot(topic, stamp, stamp, image) for topic, image in zip(TOPICS, images, strict=True)
        ]
    cameras = [Camera(topic, (320, 180), (132.4, 132.325), (160.5, 90.3), 0.12) for topic in TOPICS]
    write_bag(folder / "mcap", "mcap", messages, cameras)
    write_bag(folder / "sqlite3", "sqlite3", messages, encoding="rgb8")
    return {name: folder / name for name in ("png", "side", "mcap", "sqlite3")}


@pytest.mark.slow
def test_twenty_frames_give_identical_records_from_every_lossless_form(
    forms: dict[str, Path], tmp_path: Path
) -> None:
    files = quarter_scene(tmp_path / "scene")
    results = {}
    for name, recording in forms.items():
        calib, site = files[:2], files[2:]
        options = [*site, "--workers", 2] if name == "mcap" else [*calib, *site]
        command = [
            "stereo-ore",
            "run",
            recording,
            *options,
            "--out",
            tmp_path / name,
            "--no-report",
        ]
        done = subprocess.run(
            [str(part) for part in command], capture_output=True, text=True, timeout=200
        )
        assert done.returncode == 0, done.stderr
        # Where a stamp is from differs; all the rest is the same.
        text = (tmp_path / name / "frames.jsonl").read_bytes()
        results[name] = re.sub(rb'"stamp_source":"[a-z ]+",', b"", text)
    records = [json.loads(line) for line in results["png"].splitlines()]
    assert [record["stamp_ns"] for record in records] == [START + n * PERIOD for n in range(20)]
    assert sum(record["counts"]["kept"] for record in records) > 1000
    assert all(result == results["png"] for result in results.values())
    described = json.loads((tmp_path / "mcap" / "run.json").read_text())["recording"]
    assert described["skew_ms"]["pairs"][0] == 20
    assert (tmp_path / "mcap" / "calibration.yaml").is_file()


def test_a_recording_without_calibration_asks_for_one(
    forms: dict[str, Path], tmp_path: Path
) -> None:
    for name in ("sqlite3", "png"):
        command = ["stereo-ore", "run", forms[name], "--out", tmp_path / name]
        done = subprocess.run(
            [str(part) for part in command], capture_output=True, text=True, timeout=60
        )
        assert done.returncode == 1
        assert (
            done.stderr == f"error: {forms[name]}: carries no calibration. Give one with --calib\n"
        )
