"""What containers of videos say and leave out: how many pictures, which eye comes first, tracks,
turns, times."""

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import access_units, write_video

from stereo_ore.errors import FrameError, SourceError
from stereo_ore.io.recordings import open_source, open_two_files
from stereo_ore.io.recordings.container import LAYERS, Container, read_container
from stereo_ore.io.recordings.frame_packing import packing_of
from stereo_ore.io.recordings.images import check_packing

av = pytest.importorskip("av", reason="the extra [svo] is not installed")

WIDTH, HEIGHT = 64, 48
GAPS = {"more than claimed": (10, 33), "fewer than claimed": (30, 200), "as claimed": (10, 100)}


def picture(number: int, eye: int) -> np.ndarray:
    noise = np.random.default_rng([number, eye]).integers(
        0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8
    )
    return cv2.GaussianBlur(noise, (7, 7), 2)


def both(count: int) -> list[np.ndarray]:
    return [np.hstack([picture(n, 0), picture(n, 1)]) for n in range(count)]


@pytest.mark.parametrize("gap", GAPS)
@pytest.mark.parametrize("suffix", [".mkv", ".mp4", ".mov"])
def test_frames_are_what_decodes(suffix: str, gap: str, tmp_path: Path) -> None:
    rate, gap_ms = GAPS[gap]
    source = open_source(write_video(tmp_path / f"x{suffix}", both(6), rate, gap_ms))
    assert len(source.names) == 6
    assert [source.stamp(n).ns - source.stamp(0).ns for n in range(6)] == [
        n * gap_ms * 10**6 for n in range(6)
    ]
    if suffix == ".mkv":  # lossless
        np.testing.assert_array_equal(source.read(5).right, picture(5, 1))


def test_a_longer_track_beside_makes_no_frames(tmp_path: Path) -> None:
    path = tmp_path / "x.mkv"
    with av.open(str(path), "w") as container:
        video = container.add_stream("ffv1", rate=10)
        video.width, video.height, video.pix_fmt = 2 * WIDTH, HEIGHT, "bgr0"
        sound = container.add_stream("pcm_s16le", rate=8000, layout="mono")
        for image in both(12):
            container.mux(video.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
        container.mux(video.encode(None))
        frame = av.AudioFrame.from_ndarray(
            np.zeros((1, 9 * 8000), np.int16), format="s16", layout="mono"
        )
        frame.sample_rate, frame.pts = 8000, 0
        container.mux(sound.encode(frame))
        container.mux(sound.encode(None))
    source = open_source(path)
    assert source.track.decoder.claim() > 12
    assert len(source.names) == 12


@pytest.mark.parametrize("degrees", [180, 90])
def test_a_turn_is_not_made(degrees: int, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = write_video(tmp_path / "x.mp4", both(2))
    plain = [open_source(path).read(n).left for n in range(2)]
    path.write_bytes(turned(path.read_bytes(), degrees))
    caplog.set_level("INFO")
    for n, image in enumerate(plain):
        np.testing.assert_array_equal(open_source(path).read(n).left, image)
    assert "asks players to turn the picture" in caplog.text


def turned(data: bytes, degrees: int) -> bytes:
    """An MP4 whose track header's matrix turns the picture."""
    one, turn = (
        struct.pack(">9i", 65536, 0, 0, 0, 65536, 0, 0, 0, 1 << 30),
        {
            180: (-65536, 0, 0, 0, -65536, 0, 0, 0, 1 << 30),
            90: (0, 65536, 0, -65536, 0, 0, 0, 0, 1 << 30),
        }[degrees],
    )
    place = data.index(one, data.index(b"tkhd"))
    return data[:place] + struct.pack(">9i", *turn) + data[place + len(one) :]


# --- which eye comes first


MODES = {
    "left_right": "left-right",
    "right_left": "right-left",
    "top_bottom": "over and under, left eye on top",
}


@pytest.mark.parametrize("mode", MODES)
def test_matroska_says_which_eye_is_first(mode: str, tmp_path: Path) -> None:
    path = tmp_path / "x.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=10)
        stream.width, stream.height, stream.pix_fmt = 2 * WIDTH, HEIGHT, "bgr0"
        stream.metadata["stereo_mode"] = mode
        for image in both(2):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
        container.mux(stream.encode(None))
    assert read_container(path).packing == MODES[mode]
    if mode == "top_bottom":
        with pytest.raises(SourceError, match="says that it holds over and under, left eye on top"):
            open_source(path)
    else:
        first = int(mode == "right_left")
        np.testing.assert_array_equal(open_source(path).read(1).left, picture(1, first))


def frame_packing(arrangement: int, interpretation: int) -> bytes:
    """An access unit with a frame packing message before its picture; exp-Golomb 0 is the bit 1."""
    bits = f"1{0:01b}{arrangement:07b}0{interpretation:06b}"
    payload = int(bits.ljust(24, "0"), 2).to_bytes(3, "big")
    return (
        b"\0\0\0\1\x09\x10"
        + b"\0\0\1\x06"
        + bytes([45, len(payload)])
        + payload
        + b"\x80"
        + b"\0\0\1\x65picture"
    )


@pytest.mark.parametrize(
    ("arrangement", "interpretation", "expected"),
    [
        (3, 1, "left-right"),
        (3, 2, "right-left"),
        (3, 0, None),
        (4, 1, "over and under, left eye on top"),
        (4, 2, "over and under, right eye on top"),
        (5, 1, "one eye after the other"),
        (0, 1, "a checkerboard of both eyes"),
    ],
)
def test_frame_packing_messages(
    arrangement: int, interpretation: int, expected: str | None
) -> None:
    assert packing_of(frame_packing(arrangement, interpretation)) == expected


def test_frame_packing_as_x264_writes_it(tmp_path: Path) -> None:
    path = write_video(tmp_path / "x.mp4", both(2), **{"x264-params": "frame-packing=3"})
    assert packing_of(open_source(path).track.decoder.first_packet()) == "left-right"
    path = write_video(tmp_path / "y.mp4", both(2), **{"x264-params": "frame-packing=4"})
    with pytest.raises(SourceError, match="over and under"):
        open_source(path)
    assert packing_of(access_units(both(1))[0]) is None


@pytest.mark.parametrize("box", [b"vexu", b"lhvC"])
def test_a_spatial_video_is_never_halved(box: bytes, tmp_path: Path) -> None:
    """iPhones and headsets keep the second eye in a layer of HEVC that decoders pass over."""
    path = write_video(tmp_path / "x.mp4", both(2))
    data = path.read_bytes()
    assert data.count(b"btrt") == 1, "a box of the sample entry, to be called otherwise"
    path.write_bytes(data.replace(b"btrt", box))
    packing = read_container(path).packing
    assert packing == LAYERS
    with pytest.raises(FrameError, match=r"an eye a layer \(a spatial video, MV-HEVC\)"):
        check_packing(packing, path)


# --- tracks and two videos


def test_two_tracks_are_named(tmp_path: Path) -> None:
    path = tmp_path / "x.mkv"
    with av.open(str(path), "w") as container:
        streams = [container.add_stream("ffv1", rate=10) for _ in range(2)]
        for stream in streams:
            stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "bgr0"
        for eye, stream in enumerate(streams):
            container.mux(
                stream.encode(av.VideoFrame.from_ndarray(picture(0, eye), format="bgr24"))
            )
            container.mux(stream.encode(None))
    assert read_container(path).video_tracks == 2
    with pytest.raises(SourceError, match=r"has 2 video tracks.*-map 0:v:1 -c copy right\.mkv"):
        open_source(path)


def test_two_videos_are_paired_by_number_or_else_by_time(tmp_path: Path) -> None:
    for eye, name in enumerate(("left", "right")):
        write_video(tmp_path / f"{name}.mkv", [picture(n, eye) for n in range(5)])
    source = open_source(tmp_path)
    assert source.names == tuple(f"{n:06d}" for n in range(5))
    np.testing.assert_array_equal(source.read(3).right, picture(3, 1))
    write_video(tmp_path / "short.mkv", [picture(n, 1) for n in range(3)])
    source = open_two_files(tmp_path / "left.mkv", tmp_path / "short.mkv")
    assert source.description["unpaired"] == 2
    np.testing.assert_array_equal(source.read(2).right, picture(2, 1))
    with pytest.raises(FrameError, match="has no right picture"):
        source.read(4)


# --- times


def test_the_beginning_that_a_container_tells(tmp_path: Path) -> None:
    path = tmp_path / "x.mkv"
    with av.open(str(path), "w") as container:
        container.metadata["creation_time"] = "2026-03-31T12:00:00.000000Z"
        stream = container.add_stream("ffv1", rate=10)
        stream.width, stream.height, stream.pix_fmt = 2 * WIDTH, HEIGHT, "bgr0"
        for image in both(2):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
        container.mux(stream.encode(None))
    source = open_source(path)
    assert source.stamp(0) == (1_774_958_400_000_000_000, "container")
    assert source.read(1).stamp_ns == 1_774_958_400_100_000_000


@given(st.binary(max_size=200))
@settings(deadline=None)
def test_any_bytes_behind_a_magic_are_a_container_that_says_something_or_nothing(
    content: bytes,
) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        for magic in (
            bytes.fromhex("1a45dfa3"),
            b"\0\0\0\x14ftypisom",
            bytes.fromhex("1a45dfa380 18538067ff 1654ae6b88ae"),
        ):
            path = Path(folder) / "x"
            path.write_bytes(magic + content)
            assert isinstance(read_container(path), Container)
        assert packing_of(b"\0\0\1\x06\x2d" + content) is None or content


@pytest.mark.parametrize("kind", [b"mvhd", b"hdlr", b"stsd"])
def test_a_box_without_content_says_nothing(kind: bytes, tmp_path: Path) -> None:
    path = tmp_path / "x.mp4"
    inner = struct.pack(">I4s", 8, kind)
    path.write_bytes(
        struct.pack(">I4s8s", 16, b"ftyp", b"isom") + struct.pack(">I4s", 16, b"moov") + inner
    )
    assert read_container(path) == Container()
