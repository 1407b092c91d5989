"""Folders and image files: every layout the design names, every pixel format, every way a file can
be broken."""

import os
import pickle
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereo_ore.errors import FrameError, SourceError
from stereo_ore.io.recordings import FILE_OPENERS, open_source, open_two_files
from stereo_ore.io.recordings.images import read_image
from stereo_ore.io.recordings.names import (
    frame_names,
    name_stamp,
    natural_key,
    split_name,
    stamp_name,
)
from stereo_ore.io.recordings.quiet import overheard
from stereo_ore.types import U8

WIDTH, HEIGHT = 32, 20


def picture(number: int, eye: str, width: int = WIDTH) -> U8:
    """A picture that tells its frame and eye: no two are alike."""
    noise = np.random.default_rng([number, eye == "right"]).integers(
        0, 256, (HEIGHT, width, 3), dtype=np.uint8
    )
    return cv2.GaussianBlur(noise, (5, 5), 1.0)


def save(path: Path, image: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)
    return path


def both(number: int) -> U8:
    return np.hstack([picture(number, "left"), picture(number, "right")])


def write_pairs(
    folder: Path, pattern: Callable[[str, int], str], numbers: range = range(3)
) -> Path:
    for number in numbers:
        for eye in ("left", "right"):
            save(folder / pattern(eye, number), picture(number, eye))
    return folder


def assert_frames(source: object, names: tuple[str, ...]) -> None:
    assert source.names == names
    for index in range(len(names)):
        pair = source.read(index)
        assert (pair.name, pair.index) == (names[index], index)
        np.testing.assert_array_equal(pair.left, picture(index, "left"))
        np.testing.assert_array_equal(pair.right, picture(index, "right"))


LAYOUTS = {
    "subfolders": (lambda eye, n: f"{eye}/{n:04d}.png", "{:04d}"),
    "subfolders, marked files": (lambda eye, n: f"{eye.title()}/{eye}{n:04d}.png", "{:04d}"),
    "ZED export": (lambda eye, n: f"{eye}{n:06d}.png", "{:06d}"),
    "suffix": (lambda eye, n: f"{n}_{eye}.png", "{}"),
    "letter suffix": (lambda eye, n: f"{n:03d}_{eye[0].upper()}.png", "{:03d}"),
    "letter suffix without separator": (lambda eye, n: f"{n:03d}{eye[0].upper()}.png", "{:03d}"),
    "letter prefix": (lambda eye, n: f"{eye[0].upper()}{n:03d}.png", "{:03d}"),
    "mark in the middle": (lambda eye, n: f"cam-{eye}-{n}.png", "cam_{}"),
    "capitals": (lambda eye, n: f"{eye.upper()}_{n}.png", "{}"),
    "camel case": (lambda eye, n: f"shot{n}{eye.title()}.png", "shot{}"),
    "folder a frame": (lambda eye, n: f"scene_{n}/{eye}.png", "scene_{}"),
    "folder a frame, Middlebury": (
        lambda eye, n: f"scene_{n}/im{int(eye == 'right')}.png",
        "scene_{}",
    ),
    "folders of frames": (lambda eye, n: f"day_{n}/{eye}0000.png", "day_{}_0000"),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_layouts_of_pairs(layout: str, tmp_path: Path) -> None:
    pattern, name = LAYOUTS[layout]
    source = open_source(write_pairs(tmp_path, pattern))
    assert_frames(source, tuple(name.format(n) for n in range(3)))
    assert source.description == {"kind": "image pairs", "frames": 3, "unpaired": 0}
    assert all(file.is_file() for file in source.files(1))
    assert len(source.files(1)) == 2


def test_folder_that_holds_left_and_right_is_one_frame_named_like_the_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_pairs(tmp_path / "pile 7", lambda eye, _: f"{eye}.png", range(1))
    assert_frames(open_source(folder), ("pile_7",))
    monkeypatch.chdir(folder)
    assert_frames(open_source(Path(".")), ("pile_7",))


def test_two_files(tmp_path: Path) -> None:
    write_pairs(tmp_path, lambda eye, n: f"{eye}{n}.png", range(1))
    assert_frames(open_two_files(tmp_path / "left0.png", tmp_path / "right0.png"), ("0",))
    write_pairs(tmp_path / "pile", lambda eye, _: f"{eye}.png", range(1))
    assert open_two_files(
        tmp_path / "pile" / "left.png", tmp_path / "pile" / "right.png"
    ).names == ("pile",)
    assert open_two_files(save(tmp_path / "a.png", both(0)), tmp_path / "right0.png").names == (
        "a",
    )
    with pytest.raises(SourceError, match=r"nothing\.png: no such file"):
        open_two_files(tmp_path / "left0.png", tmp_path / "nothing.png")


def test_side_by_side_folder_and_file(tmp_path: Path) -> None:
    for number in range(3):
        save(tmp_path / f"frame_{number}.png", both(number))
    source = open_source(tmp_path)
    assert_frames(source, ("frame_0", "frame_1", "frame_2"))
    assert source.files(2) == (tmp_path / "frame_2.png",)
    assert source.description == {"kind": "side-by-side images", "frames": 3}
    assert open_source(tmp_path / "frame_2.png").names == ("frame_2",)


def test_other_files_of_an_export_are_no_frames(tmp_path: Path) -> None:
    write_pairs(tmp_path, lambda eye, n: f"{eye}{n:06d}.png")
    save(tmp_path / "depth000000.png", picture(0, "left"))
    (tmp_path / ".left000009.png").write_bytes(b"hidden")
    (tmp_path / "notes.txt").write_text("left right")
    assert_frames(open_source(tmp_path), ("000000", "000001", "000002"))


def test_frames_come_in_natural_order(tmp_path: Path) -> None:
    write_pairs(tmp_path, lambda eye, n: f"{eye}{n}.png", range(11))
    assert open_source(tmp_path).names == tuple(str(n) for n in range(11))


@pytest.mark.parametrize("missing", ["left", "right"])
def test_unpaired_frame_is_reported_and_shifts_nothing(missing: str, tmp_path: Path) -> None:
    write_pairs(tmp_path, lambda eye, n: f"{eye}/{n}.png", range(4))
    (tmp_path / missing / "1.png").unlink()
    source = open_source(tmp_path)
    assert source.names == ("0", "1", "2", "3")
    with pytest.raises(FrameError, match=f"has no {missing} partner") as caught:
        source.read(1)
    assert caught.value.code == "UNPAIRED"
    np.testing.assert_array_equal(source.read(2).right, picture(2, "right"))
    assert source.description["unpaired"] == 1
    assert len(source.files(1)) == 1


def test_two_files_for_one_eye_are_an_error(tmp_path: Path) -> None:
    write_pairs(tmp_path, lambda eye, n: f"{eye}/{n}.png")
    save(tmp_path / "left" / "1.jpg", picture(1, "left"))
    with pytest.raises(
        SourceError, match=r"1\.(png|jpg) and 1\.(png|jpg) are for the same eye of frame '1'"
    ):
        open_source(tmp_path)


def test_stamps_are_those_of_names_or_else_of_files(tmp_path: Path) -> None:
    stamp, changed = 1_700_000_000_123_456_789, 1_600_000_000_000_000_001
    write_pairs(tmp_path / "pairs", lambda eye, n: f"{eye}{stamp + n}.png", range(2))
    save(tmp_path / "both" / f"{stamp}.png", both(0))
    os.utime(save(tmp_path / "counted" / "000001.png", both(0)), ns=(0, changed))
    pairs = [open_source(tmp_path / "pairs").read(i) for i in range(2)]
    assert [(pair.stamp_ns, pair.stamp_source) for pair in pairs] == [
        (stamp, "file name"),
        (stamp + 1, "file name"),
    ]
    assert open_source(tmp_path / "both").read(0).stamp_ns == stamp
    counted = open_source(tmp_path / "counted").read(0)
    assert (counted.stamp_ns, counted.stamp_source) == (changed, "modification time")


def test_source_can_be_sent_to_a_worker(tmp_path: Path) -> None:
    source = open_source(write_pairs(tmp_path, lambda eye, n: f"{eye}{n}.png"))
    assert_frames(pickle.loads(pickle.dumps(source)), source.names)


# --- pixel formats


def grey16() -> np.ndarray:
    return picture(0, "left")[:, :, 0].astype(np.uint16) * 16


@pytest.mark.parametrize(
    ("image", "expected"),
    [
        (picture(0, "left"), picture(0, "left")),
        (
            np.dstack([picture(0, "left"), np.full((HEIGHT, WIDTH), 77, np.uint8)]),
            picture(0, "left"),
        ),
        (picture(0, "left")[:, :, 0], np.repeat(picture(0, "left")[:, :, :1], 3, 2)),
        (grey16(), np.repeat(grey16()[:, :, None], 3, 2)),
        (picture(0, "left").astype(np.uint16) * 257, picture(0, "left").astype(np.uint16) * 257),
    ],
    ids=["BGR", "BGRA", "grey", "grey 16 bit", "BGR 16 bit"],
)
@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_pixel_formats(
    image: np.ndarray, expected: np.ndarray, suffix: str, tmp_path: Path
) -> None:
    found = read_image(save(tmp_path / f"image{suffix}", image))
    assert found.dtype == expected.dtype
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("suffix", [".jpg", ".jpeg", ".bmp", ".PNG", ".tiff"])
def test_suffixes(suffix: str, tmp_path: Path) -> None:
    write_pairs(tmp_path, lambda eye, n: f"{eye}{n}{suffix}", range(1))
    pair = open_source(tmp_path).read(0)
    assert np.abs(pair.left.astype(int) - picture(0, "left")).mean() < 10


def test_both_eyes_of_a_12_bit_camera_are_scaled_alike_and_keep_their_contrast(
    tmp_path: Path,
) -> None:
    ramp = np.linspace(0, 4095, WIDTH * HEIGHT).reshape(HEIGHT, WIDTH).astype(np.uint16)
    save(tmp_path / "left.png", ramp)
    save(tmp_path / "right.png", ramp // 2)
    pair = open_source(tmp_path).read(0)
    assert pair.left.max() == 255
    np.testing.assert_array_equal(
        pair.right, (ramp // 2 // 16).astype(np.uint8)[:, :, None].repeat(3, 2)
    )


# --- broken files: always a FrameError with a code, never half a picture, never a word on stderr


def damaged(path: Path, at: float, count: int) -> None:
    data = bytearray(path.read_bytes())
    start = int(at * len(data))
    data[start : start + count] = bytes(byte ^ 0x5A for byte in data[start : start + count])
    path.write_bytes(data)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".bmp"])
@pytest.mark.parametrize("share", [0.02, 0.3, 0.7, 0.98])
def test_truncated_file(
    suffix: str, share: float, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = save(tmp_path / f"image{suffix}", cv2.resize(picture(0, "left"), (640, 400)))
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(FrameError) as caught:
        read_image(path)
    assert caught.value.code in ("TRUNCATED_IMAGE", "UNREADABLE_IMAGE")
    assert str(path) in str(caught.value)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif"])
def test_damage_in_the_middle_is_seen(
    suffix: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    if suffix == ".tif" and int(cv2.__version__.split(".")[0]) < 5:
        pytest.skip("OpenCV 4 keeps libtiff's complaints to itself")
    noise = np.random.default_rng(1).integers(0, 256, (400, 640, 3), dtype=np.uint8)
    path = save(tmp_path / f"image{suffix}", cv2.GaussianBlur(noise, (0, 0), 2))
    damaged(path, 0.5, 400)
    with pytest.raises(FrameError, match="can't be decoded"):
        read_image(path)
    assert capfd.readouterr().err == ""


def test_a_jpeg_of_many_scans_is_refused_before_it_is_decoded(tmp_path: Path) -> None:
    path = tmp_path / "many.jpg"
    _, data = cv2.imencode(
        ".jpg", np.zeros((64, 64, 3), np.uint8), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]
    )
    whole = data.tobytes()
    path.write_bytes(whole)
    assert read_image(path).shape == (64, 64, 3)
    scan = whole[whole.index(b"\xff\xda") : -2]
    path.write_bytes(whole[:-2] + 300 * scan + whole[-2:])
    with pytest.raises(FrameError, match="scans"):
        read_image(path)


def test_what_others_write_to_stderr_is_passed_on_and_is_no_damage(
    capfd: pytest.CaptureFixture[str],
) -> None:
    def decode() -> int:
        os.write(2, b"error of another thread: premature\nCorrupt JPEG data: 7 extraneous bytes\n")
        return 7

    assert overheard(decode) == (7, b"Corrupt JPEG data: 7 extraneous bytes\n")
    assert capfd.readouterr().err == "error of another thread: premature\n"


def test_a_jpeg_of_an_unknown_revision_is_read_in_silence(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = save(tmp_path / "image.jpg", picture(0, "left"))
    data = path.read_bytes()
    assert data[6:12] == b"JFIF\0\1"
    path.write_bytes(data[:11] + b"\xfc" + data[12:])
    assert read_image(path).shape == (HEIGHT, WIDTH, 3)
    assert capfd.readouterr().err == ""


def test_a_service_without_standard_error(tmp_path: Path) -> None:
    path = save(tmp_path / "image.png", picture(0, "left"))
    code = (
        "import os; os.close(2)\nfrom pathlib import Path\nfrom stereo_ore.io.recordings.images"
        f" import read_image\nprint(read_image(Path({str(path)!r})).shape)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, timeout=60
    )
    assert done.stdout == f"({HEIGHT}, {WIDTH}, 3)\n"


@pytest.mark.parametrize(
    ("content", "code"),
    [
        (b"", "UNREADABLE_IMAGE"),
        (b"not an image at all\n" * 99, "UNREADABLE_IMAGE"),
        (bytes(5000), "UNREADABLE_IMAGE"),
    ],
    ids=["zero bytes", "text", "zeros"],
)
def test_what_is_no_image(content: bytes, code: str, tmp_path: Path) -> None:
    write_pairs(tmp_path, lambda eye, n: f"{eye}{n}.png")
    (tmp_path / "right1.png").write_bytes(content)
    source = open_source(tmp_path)
    with pytest.raises(FrameError, match=r"right1\.png") as caught:
        source.read(1)
    assert caught.value.code == code
    source.read(0)
    source.read(2)


def test_folder_with_the_name_of_an_image(tmp_path: Path) -> None:
    write_pairs(tmp_path, lambda eye, n: f"{eye}{n}.png", range(1))
    (tmp_path / "left0.png").unlink()
    (tmp_path / "left0.png").mkdir()
    with pytest.raises(FrameError, match="can't be read"):
        open_source(tmp_path).read(0)


def test_image_that_claims_to_be_enormous(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = save(tmp_path / "image.png", picture(0, "left"))
    data = bytearray(path.read_bytes())
    data[16:24] = struct.pack(">II", 2_000_000_000, 2_000_000_000)
    path.write_bytes(data)
    with pytest.raises(FrameError, match="claims 2,000,000,000×2,000,000,000 pixels"):
        read_image(path)
    assert capfd.readouterr().err == ""


def test_float_image_is_refused(tmp_path: Path) -> None:
    path = save(tmp_path / "image.tif", np.zeros((HEIGHT, WIDTH), np.float32))
    with pytest.raises(FrameError, match="float32 pixels; 8 or 16 bit are read"):
        read_image(path)


def test_eyes_of_different_size(tmp_path: Path) -> None:
    save(tmp_path / "left.png", picture(0, "left"))
    save(tmp_path / "right.png", picture(0, "right", WIDTH + 2))
    with pytest.raises(FrameError, match=r"left\.png: is 32×20 but right\.png is 34×20") as caught:
        open_source(tmp_path).read(0)
    assert caught.value.code == "SIZE_MISMATCH"


def test_eyes_of_different_depth(tmp_path: Path) -> None:
    save(tmp_path / "left.png", picture(0, "left"))
    save(tmp_path / "right.png", picture(0, "right").astype(np.uint16) * 257)
    with pytest.raises(FrameError, match=r"left\.png: has uint8 pixels but right\.png has uint16"):
        open_source(tmp_path).read(0)


def test_odd_width_side_by_side(tmp_path: Path) -> None:
    path = save(tmp_path / "frame.png", picture(0, "left", 33))
    with pytest.raises(FrameError, match="33 px wide: two eyes need an even width") as caught:
        open_source(path).read(0)
    assert caught.value.code == "SIZE_MISMATCH"


# --- layouts that are none


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ([], r"holds no stereo images that are known \(0 entries\)"),
        (["notes.txt"], r"1 entries.*it holds notes\.txt: name a recording file itself"),
        (["ride.svo"], r"it holds ride\.svo"),
        (["1/0.png", "2/0.png"], r"say which eye is which: --left FOLDER --right FOLDER"),
        (["left0.png", "left1.png"], r"images of one eye only, such as left0\.png"),
        (["left0.png", "right1.png"], r"1 left and 1 right images, none of which belong together"),
        (
            ["left/0.png", "right/1.png"],
            r"1 left and 1 right images, none of which belong together",
        ),
        (["left/notes.txt", "right/notes.txt"], r"0 left and 0 right"),
    ],
)
def test_folder_of_no_known_layout(files: list[str], message: str, tmp_path: Path) -> None:
    for name in files:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"x")
    with pytest.raises(SourceError, match=message):
        open_source(tmp_path)


@pytest.mark.parametrize("name", ["ride.svo", "ride.SVO2"])
def test_svo_says_how_to_export(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"SVO")
    with pytest.raises(SourceError, match="ZED_SVO_Export"):
        open_source(tmp_path / name)


def test_unknown_paths(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="no such file or folder"):
        open_source(tmp_path / "nothing")
    (tmp_path / "a.docx").write_bytes(b"x")
    with pytest.raises(
        SourceError, match=r"files ending in '\.docx' are not known\. Known: a folder"
    ):
        open_source(tmp_path / "a.docx")
    write_pairs(tmp_path, lambda eye, _: f"{eye}.png", range(1))
    with pytest.raises(SourceError, match="is by its name the left eye of a pair"):
        open_source(tmp_path / "left.png")


# --- names


@pytest.mark.parametrize(
    ("stem", "expected"),
    [
        ("left000007", ("left", "000007")),
        ("x_R", ("right", "x")),
        ("Bright7", (None, "Bright7")),
        ("leftover", (None, "leftover")),
        ("FLOOR", (None, "FLOOR")),
        ("im1", ("right", "")),
        ("im12", (None, "im12")),
        ("frankfurt_leftImg8bit", ("left", "frankfurt_Img8bit")),
    ],
)
def test_split_name(stem: str, expected: tuple[str | None, str]) -> None:
    assert split_name(stem) == expected


@given(st.lists(st.text(max_size=300), unique=True, max_size=20))
@settings(deadline=None)
def test_frame_names_are_unique_and_safe_as_file_names(keys: list[str]) -> None:
    names = frame_names(keys)
    assert len(set(names)) == len(keys)
    for name in names:
        assert name == Path(name).name
        assert len(f"{name}.ply.tmp".encode()) < 255
        assert not name.startswith(".")


@given(st.lists(st.text(max_size=8)))
@settings(deadline=None)
def test_natural_order_is_total(keys: list[str]) -> None:
    other_order = keys[::-1]
    assert sorted(keys, key=natural_key) == sorted(other_order, key=natural_key)


@given(st.integers(0, 2**63 - 1))
@settings(deadline=None)
def test_stamp_survives_in_a_name(stamp: int) -> None:
    assert name_stamp(stamp_name(stamp)) == stamp


def test_names_that_are_no_stamps() -> None:
    assert [
        name_stamp(name) for name in ("000123", "frame_1700000000123456789", "٣" * 19, "9" * 19)
    ] == [None] * 4


def test_of_two_endings_the_longer_one_opens_a_file(tmp_path, monkeypatch):
    opened = []
    monkeypatch.setitem(FILE_OPENERS, ".pairs.png", lambda path, options: opened.append(path))
    for name in ("all.PAIRS.png", "pairs.png"):
        cv2.imwrite(str(tmp_path / name), np.zeros((4, 8), np.uint8))
    open_source(tmp_path / "all.PAIRS.png")
    assert opened == [tmp_path / "all.PAIRS.png"]
    assert open_source(tmp_path / "pairs.png").description["kind"] == "side-by-side images"
