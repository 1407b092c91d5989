"""Layouts of recorders and data sets: one test a line of the table, and names that can be read in
several ways."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereo_ore.errors import FrameError, SourceError
from stereo_ore.io.recordings import (
    BagOptions,
    describe_recording,
    expect_eyes,
    open_source,
    open_two_files,
)
from stereo_ore.io.recordings.images import IMAGE_SUFFIXES
from stereo_ore.io.recordings.layouts import LAYOUTS, Layout, list_files, may_be_eye
from stereo_ore.io.recordings.topics import choose_topics, is_rectified
from stereo_ore.plant.arrivals import arrivals

WIDTH, HEIGHT = 32, 20


def picture(number: int, eye: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    return np.random.default_rng([number, eye]).integers(0, 256, (height, width, 3), dtype=np.uint8)


def save(path: Path, image: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)
    return path


def write(
    folder: Path, left: Callable[[int], str], right: Callable[[int], str], numbers: range = range(3)
) -> Path:
    for number in numbers:
        for eye, name in enumerate((left, right)):
            save(folder / f"{name(number)}.png", picture(number, eye))
    return folder


def assert_pairs(folder: Path, names: list[str]) -> None:
    source = open_source(folder)
    assert list(source.names) == names
    for index in range(len(names)):
        pair = source.read(index)
        np.testing.assert_array_equal(pair.left, picture(index, 0))
        np.testing.assert_array_equal(pair.right, picture(index, 1))


def named(pattern: str) -> Callable[[int], str]:
    """The n-th file of a layout; where it has one frame, that is in a folder of its own."""
    return lambda n: pattern.replace("*", f"{n:06d}") if "*" in pattern else f"scene{n}/{pattern}"


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.name)
def test_each_layout(layout: Layout, tmp_path: Path) -> None:
    write(tmp_path, named(layout.left), named(layout.right))
    names = [f"{n:06d}" if "*" in layout.left else f"scene{n}" for n in range(3)]
    assert_pairs(tmp_path, names)
    assert open_source(tmp_path).layout == layout.name
    assert layout.name in describe_recording(open_source(tmp_path))


@pytest.mark.parametrize(
    "layout", [each for each in LAYOUTS if "*" in each.left], ids=lambda layout: layout.name
)
def test_each_layout_below_folders_of_sequences(layout: Layout, tmp_path: Path) -> None:
    for sequence in ("day1", "day2"):
        write(tmp_path / sequence, named(layout.left), named(layout.right))
    assert len(open_source(tmp_path).names) == 6
    np.testing.assert_array_equal(open_source(tmp_path).read(4).right, picture(1, 1))


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.name)
def test_each_layout_as_it_arrives(layout: Layout, tmp_path: Path) -> None:
    """A watched folder gives the same names, and waits for the other eye."""
    write(tmp_path, named(layout.left), named(layout.right))
    assert [
        arrival.name for arrival in arrivals(tmp_path, list_files(tmp_path, IMAGE_SUFFIXES))
    ] == list(open_source(tmp_path).names)
    assert all(
        arrival.paired for arrival in arrivals(tmp_path, list_files(tmp_path, IMAGE_SUFFIXES))
    )
    (tmp_path / f"{named(layout.right)(1)}.png").unlink()
    assert not all(
        arrival.paired for arrival in arrivals(tmp_path, list_files(tmp_path, IMAGE_SUFFIXES))
    )


OTHER = {
    "imageL0 imageR0": (lambda n: f"imageL{n}", lambda n: f"imageR{n}", "image_{}"),
    "x_l x_r": (lambda n: f"{n}_l", lambda n: f"{n}_r", "{}"),
    "image_l/ image_r/": (lambda n: f"image_l/{n}", lambda n: f"image_r/{n}", "{}"),
    "left_rect/ right_rect/": (lambda n: f"left_rect/{n}", lambda n: f"right_rect/{n}", "{}"),
    "L/ R/": (lambda n: f"L/{n}", lambda n: f"R/{n}", "{}"),
    "EuRoC from its root": (lambda n: f"mav0/cam0/data/{n}", lambda n: f"mav0/cam1/data/{n}", "{}"),
    "memory cards": (
        lambda n: f"left/DCIM/100MEDIA/{n}",
        lambda n: f"right/DCIM/100MEDIA/{n}",
        "DCIM_100MEDIA_{}",
    ),
    "phones": (
        lambda n: f"IMG_20251125_10150{n}_L",
        lambda n: f"IMG_20251125_10150{n}_R",
        "IMG_20251125_10150{}",
    ),
    "a place named left": (
        lambda n: f"left_wall_cam_L_{n}",
        lambda n: f"left_wall_cam_R_{n}",
        "left_wall_cam_{}",
    ),
    "a place named right, words": (
        lambda n: f"right_left_{n}",
        lambda n: f"right_right_{n}",
        "right_{}",
    ),
    "a line R in folders": (
        lambda n: f"left/Line_R_{n}",
        lambda n: f"right/Line_R_{n}",
        "Line_R_{}",
    ),
    "a mark twice": (lambda n: f"left/left_cam_{n}", lambda n: f"right/right_cam_{n}", "cam_{}"),
}


@pytest.mark.parametrize("layout", OTHER)
def test_other_names_of_pairs(layout: str, tmp_path: Path) -> None:
    left, right, name = OTHER[layout]
    assert_pairs(write(tmp_path, left, right), [name.format(n) for n in range(3)])


def test_an_unpaired_image_is_no_less_told_where_names_are_read_by_another_mark(
    tmp_path: Path,
) -> None:
    write(tmp_path, lambda n: f"cam L {n}", lambda n: f"cam R {n}")
    save(tmp_path / "only_left_7.png", picture(7, 0))
    assert open_source(tmp_path).description["unpaired"] == 1


COMPANIONS = {
    "Falling Things": ("{}.left", "{}.right", "{}.left.depth", "{}.right.depth"),
    "disparities": ("{}_left", "{}_right", "{}_left_disp", "{}_right_disp"),
    "folders": ("image_left/{}", "image_right/{}", "seg_left/{}", "seg_right/{}"),
    "a folder a frame": ("{}/left", "{}/right", "{}/left_mask", "{}/right_mask"),
}


@pytest.mark.parametrize("layout", COMPANIONS)
def test_depths_and_masks_beside_the_pictures_are_no_frames(
    layout: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for n in range(3):
        for kind, name in enumerate(COMPANIONS[layout]):
            save(tmp_path / f"{name.format(f'{n:06d}')}.png", picture(n, min(kind, 2)))
    with caplog.at_level("WARNING"):
        assert_pairs(tmp_path, [f"{n:06d}" for n in range(3)])
    assert "3 pairs are left out" in caplog.text


def test_a_recording_that_is_named_after_depth_is_one(tmp_path: Path) -> None:
    write(tmp_path, lambda n: f"depth_test_{n}_left", lambda n: f"depth_test_{n}_right")
    assert_pairs(tmp_path, [f"depth_test_{n}" for n in range(3)])


def test_stamps_below_folders_whose_names_say_more_than_the_eye(tmp_path: Path) -> None:
    """The stamp is in the name, whatever the folder's part of the frame's; pairs may be skewed."""
    write(
        tmp_path / "image",
        lambda n: f"stereo_left/{EPOCH + n * 50_000_000}",
        lambda n: f"stereo_right/{EPOCH + n * 50_000_000 + 700_000}",
    )
    source = open_source(tmp_path)
    assert_pairs(tmp_path, [f"stereo_{EPOCH + n * 50_000_000}" for n in range(3)])
    assert [source.stamp(n).ns for n in range(3)] == [EPOCH + n * 50_000_000 for n in range(3)]
    assert source.stamp(0).source == "file name"


def test_stamps_of_two_sequences_are_not_paired_across_them(tmp_path: Path) -> None:
    for number, stamp in enumerate((EPOCH, EPOCH + 1_000_000)):
        for eye, skew in (("left", 0), ("right", 700_000)):
            image = picture(number, int(eye == "right"))
            save(tmp_path / f"{'ab'[number]}_{eye}" / f"{stamp + skew}.png", image)
    assert_pairs(tmp_path, [f"a_{EPOCH}", f"b_{EPOCH + 1_000_000}"])


@pytest.mark.parametrize("stem", ["r", "l_1", "scan_r_1"])
def test_a_small_letter_without_its_partner_is_no_mark(stem: str, tmp_path: Path) -> None:
    save(tmp_path / f"{stem}.png", np.hstack([picture(0, 0), picture(0, 1)]))
    source = open_source(tmp_path)
    assert source.description["kind"] == "side-by-side images"
    assert may_be_eye(stem)
    assert not may_be_eye("frame_000123")


def test_more_views_than_two_are_no_pair_unless_their_truth_says_so(tmp_path: Path) -> None:
    for view in range(7):
        save(tmp_path / f"view{view}.png", picture(0, {1: 0, 5: 1}.get(view, 9)))
    assert open_source(tmp_path).description["kind"] == "side-by-side images"
    for view in (1, 5):
        save(tmp_path / f"disp{view}.png", picture(0, 9))
    assert_pairs(tmp_path, [tmp_path.name])


def test_images_that_are_the_size_of_one_eye_are_not_halved(tmp_path: Path) -> None:
    save(tmp_path / "000001.png", picture(0, 0))
    with pytest.raises(
        FrameError, match=r"32×20 px, as one eye of the calibration: these are images of one eye"
    ):
        expect_eyes(open_source(tmp_path), (WIDTH, HEIGHT)).read(0)


def test_images_over_and_under_are_told(tmp_path: Path) -> None:
    save(tmp_path / "000001.png", np.vstack([picture(0, 0), picture(0, 1)]))
    with pytest.raises(
        FrameError, match=r"32×40 px, as two eyes of the calibration over and under"
    ):
        expect_eyes(open_source(tmp_path), (WIDTH, HEIGHT)).read(0)


def test_images_beside_each_other_pass(tmp_path: Path) -> None:
    save(tmp_path / "000001.png", np.hstack([picture(0, 0), picture(0, 1)]))
    np.testing.assert_array_equal(
        expect_eyes(open_source(tmp_path), (WIDTH, HEIGHT)).read(0).right, picture(0, 1)
    )


def test_one_eye_s_folder_alone(tmp_path: Path) -> None:
    write(tmp_path, lambda n: f"left/{n}", lambda n: f"left/{n}")
    with pytest.raises(SourceError, match=r"images of one eye only, such as 0\.png"):
        open_source(tmp_path)


def test_an_unknown_layout_names_what_it_saw(tmp_path: Path) -> None:
    write(tmp_path, lambda n: f"front/{n}", lambda n: f"back/{n}")
    with pytest.raises(SourceError, match=r"\(2 entries: back/, front/\)"):
        open_source(tmp_path)


def test_two_folders(tmp_path: Path) -> None:
    write(tmp_path, lambda n: f"front/{n}", lambda n: f"back/{n}")
    source = open_two_files(tmp_path / "front", tmp_path / "back")
    assert source.names == ("0", "1", "2")
    np.testing.assert_array_equal(source.read(2).right, picture(2, 1))
    with pytest.raises(SourceError, match="are not of the same kind"):
        open_two_files(tmp_path / "front", tmp_path / "back" / "0.png")


def test_what_is_taken_for_what_is_one_line(tmp_path: Path) -> None:
    write(tmp_path / "pairs", lambda n: f"left/{n}", lambda n: f"right/{n}")
    for n in range(2):
        save(tmp_path / "both" / f"{n}.png", np.hstack([picture(n, 0), picture(n, 1)]))
    said = [describe_recording(open_source(tmp_path / name)) for name in ("pairs", "both")]
    assert said == [
        "3 frames of two images, 2 × 32×20, stamps: modification time",
        "2 side-by-side frames of 2 × 32×20, stamps: modification time",
    ]


# --- stamps

EPOCH = 1_403_636_579_763_555_584


def test_names_that_are_stamps_are_paired_by_them_alone(tmp_path: Path) -> None:
    for n, (left_ms, right_ms) in enumerate(
        [(0, 0.4), (50, 49.8), (100, None), (None, 150.2), (200, 230)]
    ):
        for eye, ms in (("left", left_ms), ("right", right_ms)):
            if ms is not None:
                save(
                    tmp_path / eye / f"{EPOCH + round(1e6 * ms)}.png",
                    picture(n, int(eye == "right")),
                )
    source = open_source(tmp_path)
    assert [tuple(file is not None for file in pair) for pair in source.pairs] == [
        (True, True), (True, True), (True, False), (False, True), (True, False), (False, True),
    ]  # fmt: skip
    np.testing.assert_array_equal(source.read(1).right, picture(1, 1))
    assert source.stamp(3).ns == EPOCH + 150_200_000
    assert len(open_source(tmp_path, BagOptions(max_skew_ms=40)).names) == 5


def test_a_name_that_is_no_stamp_means_pairs_by_name(tmp_path: Path) -> None:
    write(tmp_path, lambda n: f"left/{EPOCH + n}", lambda n: f"right/{EPOCH + n}")
    save(tmp_path / "left" / "extra.png", picture(9, 0))
    assert open_source(tmp_path).description == {"kind": "image pairs", "frames": 4, "unpaired": 1}


def test_the_table_of_euroc_gives_stamps(tmp_path: Path) -> None:
    write(tmp_path, lambda n: f"mav0/cam0/data/{n}", lambda n: f"mav0/cam1/data/{n}")
    rows = "".join(f"{EPOCH + n * 50_000_000},{n}.png\r\n" for n in range(2))
    (tmp_path / "mav0" / "cam0" / "data.csv").write_text(f"#timestamp [ns],filename\r\n{rows}")
    stamps = [open_source(tmp_path).stamp(n) for n in range(3)]
    assert [(stamp.ns, stamp.source) for stamp in stamps[:2]] == [
        (EPOCH, "csv"),
        (EPOCH + 50_000_000, "csv"),
    ]
    assert stamps[2].source == "modification time"


# --- topics

TOPICS = {
    "ZED wrapper 3": (
        "/zed/zed_node/left/image_rect_color",
        "/zed/zed_node/right/image_rect_color",
        True,
    ),
    "ZED wrapper 4, raw": (
        "/zed/zed_node/left_raw/image_raw_color",
        "/zed/zed_node/right_raw/image_raw_color",
        False,
    ),
    "ZED wrapper 5": (
        "/zed/zed_node/left/color/rect/image",
        "/zed/zed_node/right/color/rect/image",
        True,
    ),
    "ZED wrapper 5, raw": (
        "/zed/zed_node/left/gray/raw/image",
        "/zed/zed_node/right/gray/raw/image",
        False,
    ),
    "RealSense, ROS 2": (
        "/camera/camera/infra1/image_rect_raw",
        "/camera/camera/infra2/image_rect_raw",
        True,
    ),
    "RealSense's recorder": (
        "/device_0/sensor_0/Infrared_1/image/data",
        "/device_0/sensor_0/Infrared_2/image/data",
        False,
    ),
    "depthai": ("/oak/left/image_rect", "/oak/right/image_rect", True),
    "EuRoC": ("/cam0/image_raw", "/cam1/image_raw", False),
}
OFFERED = {
    "zed-ros2-wrapper 5": [
        f"/zed/zed_node/{eye}/{kind}/image"
        for eye in ("left", "right", "rgb")
        for kind in ("color/raw", "color/rect", "gray/raw", "gray/rect")
    ],
    "zed-ros2-wrapper 4": [
        f"/zed/zed_node/{eye}{name}"
        for eye in ("left", "right", "rgb")
        for name in (
            "_raw/image_raw_color",
            "/image_rect_color",
            "_gray/image_rect_gray",
            "_raw_gray/image_raw_gray",
        )
    ],
    "realsense-ros": [
        "/camera/camera/infra1/image_rect_raw",
        "/camera/camera/infra2/image_rect_raw",
        "/camera/camera/color/image_raw",
        "/camera/camera/depth/image_rect_raw",
    ],
    "depthai-ros": [
        *(
            f"/oak/{eye}/{name}"
            for eye in ("left", "right")
            for name in ("image_raw", "image_rect")
        ),
        "/oak/rgb/image_raw",
        "/oak/stereo/image_raw",
    ],
    "image_pipeline": [
        f"/stereo/{eye}/{name}"
        for eye in ("left", "right")
        for name in ("image_raw", "image_mono", "image_color", "image_rect", "image_rect_color")
    ],
}
CHOSEN = {
    "zed-ros2-wrapper 5": "/zed/zed_node/left/color/rect/image",
    "zed-ros2-wrapper 4": "/zed/zed_node/left/image_rect_color",
    "realsense-ros": "/camera/camera/infra1/image_rect_raw",
    "depthai-ros": "/oak/left/image_rect",
    "image_pipeline": "/stereo/left/image_rect_color",
}


@pytest.mark.parametrize("driver", OFFERED)
@pytest.mark.parametrize("compressed", [False, True])
def test_of_all_that_a_driver_offers_the_best_pair_is_taken(driver: str, compressed: bool) -> None:
    offered = OFFERED[driver]
    offered = offered + [f"{topic}/compressed" for topic in offered] if compressed else offered
    left, right = choose_topics(offered, None, "ROS 2")
    assert left == CHOSEN[driver]
    assert right in offered
    assert is_rectified(left)


@pytest.mark.parametrize("name", TOPICS)
def test_topics_of_drivers(name: str) -> None:
    left, right, rectified = TOPICS[name]
    assert choose_topics((right, left, "/rgb/image", "/depth/image"), None, Path("bag")) == (
        left,
        right,
    )
    assert is_rectified(left) is rectified


def test_of_two_marks_in_a_topic_the_last_that_will_do_tells_the_eye() -> None:
    """A machine's name holds left or right too: another machine's eye is never the partner."""
    left, right = "/right_boom/stereo/left/image", "/right_boom/stereo/right/image"
    assert choose_topics((left, right), None, "bag") == (left, right)
    assert choose_topics(("/a/left/left_image", "/a/right/right_image"), None, "bag") == (
        "/a/left/left_image",
        "/a/right/right_image",
    )
    arms = [f"/{arm}_arm/cam/{eye}/image" for arm in ("left", "right") for eye in ("left", "right")]
    with pytest.raises(SourceError, match="has 2 pairs") as caught:
        choose_topics(arms, None, "bag")
    for arm in (arms[:2], arms[2:]):
        assert f"--left-topic {arm[0]} --right-topic {arm[1]}" in str(caught.value)


def test_small_letters_tell_the_eyes_of_topics() -> None:
    topics = ("/cam_l/image_raw", "/cam_r/image_raw")
    assert choose_topics(topics, None, "bag") == topics
