"""What image files say beside their pixels: where they end, turns, both eyes in one file, pages;
depth of pixels."""

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereo_ore.errors import FrameError
from stereo_ore.io.recordings import describe_recording, jpeg, open_source
from stereo_ore.io.recordings.image_header import claimed_size, tiff_pages
from stereo_ore.io.recordings.images import depth_of, is_complete, read_image, to_8_bit, turn_of

WIDTH, HEIGHT = 64, 48


def picture(seed: int = 0, width: int = WIDTH) -> np.ndarray:
    noise = np.random.default_rng(seed).integers(0, 256, (HEIGHT, width, 3), dtype=np.uint8)
    return cv2.GaussianBlur(noise, (7, 7), 2)


def encoded(image: np.ndarray, suffix: str = ".jpg") -> bytes:
    return cv2.imencode(suffix, image)[1].tobytes()


def segment(marker: int, content: bytes) -> bytes:
    return bytes([0xFF, marker]) + struct.pack(">H", len(content) + 2) + content


def with_segment(data: bytes, marker: int, content: bytes) -> bytes:
    return data[:2] + segment(marker, content) + data[2:]


def exif(turn: int, order: str = "<") -> bytes:
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", 8)
    return b"Exif\0\0" + head + struct.pack(order + "HHHIHHI", 1, 0x0112, 3, 1, turn, 0, 0)


# --- the end


@pytest.mark.parametrize(
    "tail", [b"", bytes(4), bytes(900), bytes(4096), b"\0\xff\xd8 no end", b"trailer" * 5000]
)
@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_what_follows_the_end_is_no_part_of_a_file(
    suffix: str, tail: bytes, tmp_path: Path
) -> None:
    data = encoded(picture(), suffix)
    path = tmp_path / f"x{suffix}"
    path.write_bytes(data + tail)
    assert is_complete(data + tail)
    np.testing.assert_array_equal(read_image(path), cv2.imdecode(np.frombuffer(data, np.uint8), 1))


@given(st.integers(0, 5000), st.binary(max_size=40).filter(lambda tail: b"\xff" not in tail))
@settings(deadline=None, max_examples=60)
def test_a_jpeg_cut_anywhere_is_not_complete(cut: int, tail: bytes) -> None:
    data = encoded(picture())
    cut %= len(data) - 1
    assert not is_complete(data[:cut] + tail) or cut < 2
    assert is_complete(data + tail)


@pytest.mark.parametrize("stray", [1, 12, 64])
def test_stray_bytes_behind_the_last_row_are_no_damage(stray: int, tmp_path: Path) -> None:
    data = encoded(picture())
    path = tmp_path / "x.jpg"
    path.write_bytes(data[:-2] + bytes(range(1, stray + 1)) + data[-2:])
    np.testing.assert_array_equal(read_image(path), cv2.imdecode(np.frombuffer(data, np.uint8), 1))


def test_rows_that_are_shifted_are_damage() -> None:
    data = encoded(picture())
    noise = bytes(np.random.default_rng(0).integers(1, 255, 400, dtype=np.uint8))
    said = b"Corrupt JPEG data: 400 extraneous bytes before marker 0xd9\n"
    assert jpeg.damage(data[:-2] + noise + data[-2:], said)
    assert not jpeg.damage(data[:-2] + bytes(400) + data[-2:], said), "padding"
    assert jpeg.damage(data, b"Premature end of JPEG file\n")
    assert jpeg.damage(data, b"Corrupt JPEG data: premature end of data segment\n")
    assert not jpeg.damage(data, b"Corrupt JPEG data: 3 extraneous bytes before marker 0xd0\n")


def test_a_preview_inside_is_not_the_end() -> None:
    data = with_segment(encoded(picture()), 0xE1, b"Exif\0\0" + encoded(picture(1, 16)))
    assert jpeg.end_of(data) == len(data)
    assert not is_complete(data[: len(data) // 2])


# --- turns


@pytest.mark.parametrize("order", ["<", ">"])
def test_a_turn_of_one_eye_is_told_and_of_both_is_not_made(order: str, tmp_path: Path) -> None:
    plain = encoded(picture())
    turned = with_segment(plain, 0xE1, exif(3, order))
    assert (jpeg.orientation(turned), jpeg.orientation(plain)) == (3, 1)
    (tmp_path / "left.jpg").write_bytes(plain)
    (tmp_path / "right.jpg").write_bytes(turned)
    with pytest.raises(
        FrameError, match=r"right\.jpg: says that it is to be turned by 180°, left\.jpg"
    ) as caught:
        open_source(tmp_path).read(0)
    assert caught.value.code == "ORIENTATION_MISMATCH"
    (tmp_path / "left.jpg").write_bytes(turned)
    pair = open_source(tmp_path).read(0)
    np.testing.assert_array_equal(pair.left, cv2.imdecode(np.frombuffer(plain, np.uint8), 1))
    assert (
        "left.jpg asks viewers to turn it by 180°, pixels are taken as stored"
        in describe_recording(open_source(tmp_path))
    )


def test_a_turn_may_be_in_a_png_or_a_tiff() -> None:
    plain = encoded(picture(), ".png")
    content = b"eXIf" + exif(6)[6:]
    chunk = struct.pack(">I", len(content) - 4) + content + struct.pack(">I", zlib.crc32(content))
    assert (turn_of(plain), turn_of(plain[:33] + chunk + plain[33:])) == (1, 6)
    assert turn_of(exif(8)[6:]) == 8


@given(st.binary(max_size=60))
@settings(deadline=None)
def test_damaged_tags_turn_nothing(content: bytes) -> None:
    assert isinstance(
        turn_of(with_segment(encoded(picture()), 0xE1, b"Exif\0\0II*\0" + content)), int
    )


# --- both eyes in one file


def jps(flags: int, layout: int = 2) -> bytes:
    return b"_JPSJPS_" + struct.pack(">H", 4) + bytes([0, flags, layout, 1])


def test_a_stereo_jpeg_says_which_eye_comes_first(tmp_path: Path) -> None:
    eyes = [np.full((HEIGHT, WIDTH, 3), value, np.uint8) for value in (60, 180)]
    plain = encoded(np.hstack(eyes))
    for name, data, left in (
        ("first.jps", with_segment(plain, 0xE3, jps(4)), 60),
        ("second.jps", with_segment(plain, 0xE3, jps(0)), 180),
        ("nothing.jps", plain, 180),
        ("signed.jpg", with_segment(plain, 0xE3, jps(0)), 180),
        ("plain.jpg", plain, 60),
    ):
        (tmp_path / name).write_bytes(data)
        assert open_source(tmp_path / name).read(0).left.mean() == pytest.approx(left, abs=2), name
    (tmp_path / "tall.jps").write_bytes(with_segment(plain, 0xE3, jps(4, 3)))
    with pytest.raises(FrameError, match="over and under, left eye on top"):
        open_source(tmp_path / "tall.jps").read(0)


def test_a_folder_of_stereo_files_is_one_of_both_eyes_whatever_they_are_called(
    tmp_path: Path,
) -> None:
    for name in ("left_wall.jps", "right_wall.jps"):
        (tmp_path / name).write_bytes(encoded(np.hstack([picture(1), picture(2)])))
    assert open_source(tmp_path).description == {"kind": "side-by-side images", "frames": 2}


def mpo(pictures: list[bytes], kind: int = 0x020002) -> bytes:
    """A multi-picture file: an index in the first picture, the others behind it."""
    entries = b""
    index_length = 8 + 2 + 12 + 4 + 16 * len(pictures)
    place = 2 + 4 + 4  # SOI, marker and length, "MPF\0": where offsets count from
    first = pictures[0][:2] + segment(0xE2, b"MPF\0" + bytes(index_length)) + pictures[0][2:]
    offset = 0
    for number, data in enumerate([first, *pictures[1:]]):
        entries += struct.pack("<IIIHH", kind, len(data), offset - place if number else 0, 0, 0)
        offset += len(data)
    index = (
        b"II*\0" + struct.pack("<IHHHII", 8, 1, 0xB002, 7, len(entries), 26) + bytes(4) + entries
    )
    return first[:2] + segment(0xE2, b"MPF\0" + index) + pictures[0][2:] + b"".join(pictures[1:])


@pytest.mark.parametrize("suffix", [".mpo", ".jpg"])
def test_two_pictures_of_a_size_are_the_eyes(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"pair{suffix}"
    path.write_bytes(mpo([encoded(picture(1)), encoded(picture(2))]))
    pair = open_source(path).read(0)
    for image, seed in ((pair.left, 1), (pair.right, 2)):
        np.testing.assert_array_equal(
            image, cv2.imdecode(np.frombuffer(encoded(picture(seed)), np.uint8), 1)
        )


def test_a_preview_is_no_eye(tmp_path: Path) -> None:
    path = tmp_path / "both.jpg"
    path.write_bytes(mpo([encoded(picture(1)), encoded(picture(2, 32))]))
    assert jpeg.pictures(path.read_bytes()) == ()
    assert open_source(path).read(0).left.shape == (HEIGHT, WIDTH // 2, 3)


# --- pages, formats, depth


def test_pages_of_a_tiff_are_told(tmp_path: Path) -> None:
    path = tmp_path / "left.tif"
    assert cv2.imwritemulti(str(path), [picture(1), picture(2), picture(3)])
    assert cv2.imwrite(str(tmp_path / "right.tif"), picture(2))
    assert tiff_pages(path.read_bytes()) == 3
    with pytest.raises(FrameError, match=r"left\.tif: holds 3 pages"):
        open_source(tmp_path).read(0)


@pytest.mark.parametrize("suffix", [".pgm", ".ppm", ".webp"])
def test_other_formats_that_opencv_decodes(suffix: str, tmp_path: Path) -> None:
    data = encoded(picture()[:, :, 0] if suffix == ".pgm" else picture(), suffix)
    path = tmp_path / f"x{suffix}"
    path.write_bytes(data)
    assert claimed_size(data) == (WIDTH, HEIGHT)
    assert read_image(path).shape == (HEIGHT, WIDTH, 3)
    path.write_bytes(data[:-20])
    with pytest.raises(FrameError, match="can't be decoded"):
        read_image(path)


def test_a_bright_pixel_does_not_make_the_others_dark() -> None:
    image = np.full((200, 200, 3), 1000, np.uint16)
    image[0, 0] = 65535
    assert depth_of([image]) == 10
    assert to_8_bit(image, image)[0][1, 1, 0] == 250
    assert to_8_bit(image, image)[0][0, 0, 0] == 255


def test_one_depth_for_the_whole_recording_in_any_order(tmp_path: Path) -> None:
    for number, value in enumerate((200, 3000, 200, 700)):
        for eye in ("left", "right"):
            image = np.full((HEIGHT, WIDTH, 3), value, np.uint16)
            assert cv2.imwrite(str(tmp_path / f"{eye}{number}.png"), image)
    source = open_source(tmp_path)
    found = {index: source.read(index).left.max() for index in (3, 0, 1, 2)}
    assert found == {0: 12, 1: 187, 2: 12, 3: 43}
