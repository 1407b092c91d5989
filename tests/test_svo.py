"""SVO2 recordings, read without Stereolabs' software; other videos that are stored a message a
picture."""

import contextlib
import pickle
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import access_units, write_svo2

from stereo_ore.errors import FrameError, SourceError
from stereo_ore.io.recordings import describe_recording, expect_eyes, open_source
from stereo_ore.io.recordings.access_units import UnitDecoder, codec_of, is_key

pytest.importorskip("av", reason="the extra [svo] is not installed")
pytest.importorskip("mcap", reason="the extra [svo] is not installed")

WIDTH, HEIGHT, COUNT = 96, 64, 7
STAMPS = [1_700_000_000_000_000_000 + n * 66_666_667 for n in range(COUNT)]


def picture(number: int, eye: int) -> np.ndarray:
    noise = np.random.default_rng([number, eye]).integers(
        0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8
    )
    return cv2.GaussianBlur(noise, (5, 5), 1)


PAIRS = [(picture(n, 0), picture(n, 1)) for n in range(COUNT)]


@pytest.fixture(params=[1, 3], ids=["key frames alone", "a key frame of three"])
def recording(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    return write_svo2(tmp_path / "ride.svo2", PAIRS, STAMPS, request.param)


def test_frames_in_any_order_with_their_stamps(recording: Path) -> None:
    source = open_source(recording)
    assert source.names == tuple(map(str, STAMPS))
    for index in (0, 1, 5, 2, 6, 6, 3):
        pair = source.read(index)
        np.testing.assert_array_equal(pair.left, PAIRS[index][0])
        np.testing.assert_array_equal(pair.right, PAIRS[index][1])
        assert (pair.stamp_ns, pair.stamp_source) == (STAMPS[index], "header")
    assert source.description == {"kind": "SVO2", "frames": COUNT, "camera": "SN12345678"}
    assert describe_recording(source).startswith("7 frames of SVO2, 2 × 96×64")


def test_it_can_be_sent_to_a_worker(recording: Path) -> None:
    source = open_source(recording)
    source.read(2)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(source)).read(4).left, PAIRS[4][0])


def test_where_its_calibration_is_to_be_had(recording: Path) -> None:
    with pytest.raises(
        SourceError, match=r"carries no calibration\. Give .* --calib: SN12345678\.conf"
    ):
        _ = open_source(recording).calibration


def test_a_calibration_of_another_size_is_told(recording: Path) -> None:
    with pytest.raises(FrameError, match="as one eye of the calibration"):
        expect_eyes(open_source(recording), (2 * WIDTH, HEIGHT)).read(0)


@pytest.mark.parametrize("content", [b"", b"\xf5\xff\xff\xff" + bytes(50), b"hello world" * 9])
@pytest.mark.parametrize("suffix", [".svo", ".svo2"])
def test_version_1_is_one_line(content: bytes, suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"ride{suffix}"
    path.write_bytes(content)
    with pytest.raises(SourceError, match=rf"ZED_SVO_Export ride{suffix} FOLDER 2"):
        open_source(path)


@pytest.mark.parametrize("share", [0.3, 0.9, 0.999])
def test_a_cut_off_file_is_an_error(share: float, recording: Path) -> None:
    recording.write_bytes(recording.read_bytes()[: int(share * recording.stat().st_size)])
    with pytest.raises(SourceError, match="can't be read as a bag"):
        open_source(recording)


def test_a_damaged_frame_fails_alone(tmp_path: Path) -> None:
    recording = write_svo2(tmp_path / "ride.svo2", PAIRS, STAMPS)
    unit = access_units([np.hstack(pair) for pair in PAIRS])[3]
    data = recording.read_bytes()
    recording.write_bytes(data.replace(unit, bytes(len(unit))))
    source = open_source(recording)
    assert source.names == tuple(map(str, STAMPS))
    for index in (2, 4):
        np.testing.assert_array_equal(source.read(index).left, PAIRS[index][0])
    with pytest.raises(FrameError, match="picture 3 of 7 can't be decoded"):
        source.read(3)


# --- access units


def test_what_units_are() -> None:
    assert [is_key(unit) for unit in access_units([np.hstack(pair) for pair in PAIRS], gop=3)] == [
        True, False, False, True, False, False, True,
    ]  # fmt: skip
    assert codec_of(b"\0\0\0\1\x67\x42") == "h264"
    assert codec_of(b"\0\0\1\x40\x01\0\0\1\x42\x01") == "hevc"
    assert is_key(b"\0\0\1\x40\x01\0\0\1\x42\x01\0\0\1\x26\x01")
    assert not is_key(b"\0\0\1\x02\x01")


def test_without_a_key_frame_there_is_no_picture() -> None:
    units = access_units([np.hstack(pair) for pair in PAIRS], gop=7)[1:]
    decoder = UnitDecoder(Path("x"), [is_key(unit) for unit in units], units.__getitem__)
    with pytest.raises(
        FrameError, match="picture 2 of 6 can't be decoded: no key frame comes before it"
    ):
        decoder.picture(2, 10**8)


def test_a_picture_that_is_too_large_is_refused() -> None:
    units = access_units([np.hstack(pair) for pair in PAIRS])
    with pytest.raises(FrameError, match="at most 100 are decoded"):
        UnitDecoder(Path("x"), [True] * COUNT, units.__getitem__).picture(0, 100)


@given(st.lists(st.binary(max_size=80), min_size=1, max_size=4))
@settings(deadline=None, max_examples=50)
def test_any_bytes_are_a_picture_or_a_frame_error(parts: list[bytes]) -> None:
    whole = access_units([np.hstack(PAIRS[0])])[0]
    units = [whole, *(b"\0\0\0\1\x67" + part for part in parts)]
    decoder = UnitDecoder(Path("x"), [is_key(unit) for unit in units], units.__getitem__)
    for index in range(len(units)):
        with contextlib.suppress(FrameError):
            assert decoder.picture(index, 10**6).shape[2] == 3


def test_the_footer_is_as_it_is_described() -> None:
    from stereo_ore.io.recordings.svo import FOOTER, FOOTER_MAGIC

    assert FOOTER.size == 56
    assert struct.unpack_from("<I", FOOTER.pack(1, 2, FOOTER_MAGIC, 1, 2, -1, 7), 8) == (
        0x5C002C00,
    )
