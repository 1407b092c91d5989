"""Hostile input planted in the real command: each ends as one line that names file and remedy,
never as a traceback."""

import json
import os
import re
import shutil
import struct
import subprocess
import sys
import threading
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
from runs import make_run, ore, quarter_scene, record
from test_report import Page

from stereo_ore.cli import launch
from stereo_ore.io.results import Results
from stereo_ore.plant.frames import Position
from stereo_ore.plant.watch import FolderWatch

MEGABYTE = 2**20
GOOD = "000000"
FUZZED = Path(__file__).parent / "fuzz" / "corpus"


class Done(NamedTuple):
    code: int
    out: str
    err: str


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str]) -> Callable[..., Done]:
    """Runs the command in this process: any exception but a known error would leave it, as a
    traceback does."""

    def run(*arguments: object) -> Done:
        with pytest.raises(SystemExit) as end:
            launch([str(argument) for argument in arguments])
        printed = capsys.readouterr()
        return Done(int(end.value.code or 0), printed.out, printed.err)

    return run


def refused(done: Done, *words: str) -> str:
    """The error of a command that ended as it should: one line, or one a fault; exit code 1, or 3
    where frames fail."""
    assert done.code == 3 if "error: no frame is usable" in done.err else done.code == 1, done
    assert "Traceback" not in done.err
    lines = done.err[done.err.index("error: ") :].splitlines()
    assert all(line.startswith("  ") for line in lines[1:]), lines
    for word in words:
        assert word in lines[0], lines[0]
    return lines[0]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scene")
    quarter_scene(folder)
    return folder


@pytest.fixture
def recording(scene: Path, tmp_path: Path) -> Path:
    """A folder with one good frame."""
    folder = tmp_path / "recording"
    folder.mkdir()
    for eye in ("left", "right"):
        shutil.copy(scene / f"{eye}.png", folder / f"{eye}{GOOD}.png")
    return folder


def run_arguments(scene: Path, recording: Path, out: Path, **changed: Path) -> list[object]:
    files = {"calib": scene / "calibration.yaml", "site": scene / "site.yaml"} | changed
    return [
        "run",
        recording,
        "--out",
        out,
        *(word for key, file in files.items() for word in (f"--{key}", file)),
    ]


def records(out: Path) -> dict[str, dict[str, Any]]:
    lines = (out / "frames.jsonl").read_bytes().split(b"\n")[:-1]
    return {entry["frame"]: entry for entry in map(json.loads, lines)}


# --- files of parameters

LAUGHS = "a0: &a0 lol\n" + "".join(
    f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 10)
)
YAML = {
    "aliases": b"a: &x [1]\nb: *x\n",
    "billion laughs": LAUGHS.encode(),
    "a tag": b"matching: !!python/object/apply:os.system ['true']\n",
    "a harmless tag": b"matching: !!set {a, b}\n",
    "a key twice": b"matching: {}\nmatching: {}\n",
    "NaN": b"matching: {sigma_px: .nan}\nformat: .nan\n",
    "1e400": b"matching: {sigma_px: 1.0e+400}\nformat: 1.0e+400\n",
    "infinity": b"matching: {sigma_px: -.inf}\nformat: -.inf\n",
    "deep nesting": b"matching: " + b"[" * 100_000,
    "deep mappings": b"{a: " * 100_000,
    "a huge number": b"matching: {fuse: " + b"9" * 5000 + b"}\n",
    "a huge hexadecimal number": b"matching: {fuse: 0x" + b"f" * 300_000 + b"}\n",
    "a huge sexagesimal number": b"matching: {fuse: 1" + b":10" * 300_000 + b"}\n",
    "a large number": b"matching: {fuse: 0x" + b"f" * 390 + b"}\nformat: 0x" + b"f" * 390 + b"\n",
    "NUL bytes": b"matching: {}\n\0\0\0\n",
    "NUL in a text": b'matching: {mode: "a\\0b"}\nbackground: "a\\0b"\nformat: "a\\0"\n',
    "UTF-16": "matching: {}\n".encode("utf-16"),
    "no UTF-8": b"matching: {mode: \xff\xfe}\n",
    "a list": b"- 1\n",
    "nothing": b"",
    "a terminal's escapes": b'"\\e[2J\\e]0;owned\\a": 1\n',
    "a line break in a key": b'"a\\nerror: all is well": 1\n',
    "a key that is none": b"? [1, 2]\n: 3\n",
}


@pytest.mark.parametrize("option", ["config", "site", "calib"])
@pytest.mark.parametrize("name", YAML)
def test_hostile_yaml(
    name: str, option: str, scene: Path, recording: Path, tmp_path: Path, command: Any
) -> None:
    file = tmp_path / "hostile.yaml"
    file.write_bytes(
        (b"format: stereo_ore/stereo-calibration\n" if option == "calib" else b"") + YAML[name]
    )
    line = refused(
        command(*run_arguments(scene, recording, tmp_path / "out", **{option: file})), str(file)
    )
    assert len(line) < 2000
    assert line.isprintable()
    assert not (tmp_path / "out" / "frames.jsonl").exists()


@pytest.mark.parametrize("name", ["aliases", "a tag", "a huge number", "UTF-16"])
def test_hostile_yaml_of_consumers(name: str, scene: Path, tmp_path: Path, command: Any) -> None:
    file = tmp_path / "hostile.yaml"
    file.write_bytes(YAML[name])
    arguments = ("--calib", scene / "calibration.yaml", "--out", tmp_path / "out", "--sinks", file)
    refused(command("serve", "--watch", tmp_path, *arguments), str(file))


def test_yaml_with_a_byte_order_mark_is_read(
    scene: Path, recording: Path, tmp_path: Path, command: Any
) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_bytes(b"\xef\xbb\xbfsegment: {min_pixels: 121}\r\n")
    assert command(*run_arguments(scene, recording, tmp_path / "out", config=file)).code == 0
    assert "min_pixels: 121" in (tmp_path / "out" / "config.yaml").read_text()


@pytest.mark.parametrize("option", ["config", "site", "calib"])
def test_files_without_end_are_not_read_to_their_end(
    option: str, scene: Path, recording: Path, tmp_path: Path, command: Any
) -> None:
    huge = tmp_path / "huge.yaml"
    with huge.open("wb") as file:
        file.truncate(100 * MEGABYTE)
    for endless in (huge, Path("/dev/zero")):
        if endless.exists():
            arguments = run_arguments(scene, recording, tmp_path / "out", **{option: endless})
            refused(command(*arguments), f"{endless}: has more than 1,000,000 bytes")


def test_a_site_whose_background_is_no_path(
    scene: Path, recording: Path, tmp_path: Path, command: Any
) -> None:
    file = tmp_path / "site.yaml"
    file.write_text((scene / "site.yaml").read_text() + '\nbackground: "a\\0b"\n')
    refused(command(*run_arguments(scene, recording, tmp_path / "out", site=file)), "background")


# --- pictures


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width: int, height: int, rows: int, before: bytes = b"") -> bytes:
    """A grey PNG of zeros that claims a size and holds so many rows."""
    packer = zlib.compressobj(9)
    pixels = b"".join(packer.compress(bytes(width + 1)) for _ in range(rows)) + packer.flush()
    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", head)
        + before
        + chunk(b"IDAT", pixels)
        + chunk(b"IEND", b"")
    )


def tiff(width: int, height: int, big: bool = False) -> bytes:
    """A TIFF or BigTIFF that claims a size and holds nothing."""
    if big:
        tags = b"".join(
            struct.pack("<HHQQ", tag, 16, 1, value) for tag, value in ((256, width), (257, height))
        )
        return b"II+\0" + struct.pack("<HHQQ", 8, 0, 16, 2) + tags + bytes(8)
    tags = b"".join(
        struct.pack("<HHII", tag, 4, 1, value) for tag, value in ((256, width), (257, height))
    )
    return b"II*\0" + struct.pack("<IH", 8, 2) + tags + bytes(4)


def claims_jpeg(image: np.ndarray) -> bytes:
    data = bytearray(cv2.imencode(".jpg", image)[1].tobytes())
    place = data.index(b"\xff\xc0")
    data[place + 5 : place + 9] = b"\xff" * 4
    return bytes(data)


def claims_bmp(image: np.ndarray) -> bytes:
    data = bytearray(cv2.imencode(".bmp", image)[1].tobytes())
    data[18:26] = struct.pack("<ii", 2**31 - 1, -(2**31))
    return bytes(data)


SMALL = np.full((180, 320, 3), 90, np.uint8)
GIF = (
    b"GIF89a\xff\xff\xff\xff\x80\0\0\0\0\0\xff\xff\xff!\xf9\x04\0\n\0\0\0,\0\0\0\0\1\0\1"
    b"\0\0\2\2D\1\0;"
)
PICTURES: dict[str, tuple[Callable[[], bytes], str]] = {
    "png that claims 4 terapixels": (lambda: png(2_000_000, 2_000_000, 0), "IMAGE_TOO_LARGE"),
    "png that holds 144 megapixels": (lambda: png(12_000, 12_000, 12_000), "IMAGE_TOO_LARGE"),
    "png of no width": (lambda: png(0, 180, 180), "UNREADABLE_IMAGE"),
    "png whose rows are missing": (lambda: png(320, 180, 3), "UNREADABLE_IMAGE"),
    "png of one pixel": (lambda: png(1, 1, 1), "SIZE_MISMATCH"),
    "png whose first chunk is another": (
        lambda: png(320, 180, 180)[:8] + chunk(b"tEXt", b"a\0b") + png(320, 180, 180)[8:],
        "UNREADABLE_IMAGE",
    ),
    "png of a chunk of 4 GB": (
        lambda: (FUZZED / "image" / "png_chunk_of_4_GB").read_bytes(), "UNREADABLE_IMAGE",
    ),
    "jpeg that claims 4 gigapixels": (lambda: claims_jpeg(SMALL), "IMAGE_TOO_LARGE"),
    "jpeg without a frame": (lambda: b"\xff\xd8\xff\xe0\0\x10JFIF\0" + bytes(20) + b"\xff\xd9",
        "UNREADABLE_IMAGE"),
    "tiff that claims 4 terapixels": (lambda: tiff(2_000_000, 2_000_000), "IMAGE_TOO_LARGE"),
    "big tiff that claims 2^100 pixels": (lambda: tiff(2**50, 2**50, big=True), "IMAGE_TOO_LARGE"),
    "tiff whose directory lies beyond 64 bit": (
        lambda: (FUZZED / "image" / "tiff_directory_beyond_64_bit").read_bytes(),
        "UNREADABLE_IMAGE",
    ),
    "tiff that holds nothing": (lambda: tiff(320, 180), "UNREADABLE_IMAGE"),
    "tiff whose directory lies elsewhere": (lambda: b"II*\0\xff\xff\xff\xff", "UNREADABLE_IMAGE"),
    "bmp that claims 2^62 pixels": (lambda: claims_bmp(SMALL), "IMAGE_TOO_LARGE"),
    "gif under another name": (lambda: GIF, "UNREADABLE_IMAGE"),
    "webp under another name": (lambda: cv2.imencode(".webp", SMALL)[1].tobytes(), "NO_POINTS"),
    "netpbm under another name": (lambda: b"P5\n2000000 2000000\n255\n", "UNREADABLE_IMAGE"),
    "nothing": (lambda: b"", "UNREADABLE_IMAGE"),
    "html": (lambda: b"<html><body>404</body></html>" * 99, "UNREADABLE_IMAGE"),
    "zeros": (lambda: bytes(100_000), "UNREADABLE_IMAGE"),
}  # fmt: skip


def test_hostile_pictures_fail_alone(
    scene: Path, recording: Path, tmp_path: Path, command: Any
) -> None:
    for place, (make, _) in enumerate(PICTURES.values(), 1):
        (recording / f"left{place:06d}.png").write_bytes(make())
        shutil.copy(scene / "right.png", recording / f"right{place:06d}.png")
    done = command(*run_arguments(scene, recording, tmp_path / "out"))
    assert done.code == 0, done.err
    found = records(tmp_path / "out")
    assert found[GOOD]["status"] == "ok"
    for place, (name, (_, code)) in enumerate(PICTURES.items(), 1):
        entry = found[f"{place:06d}"]
        assert (name, entry["status"], entry["reasons"][-1]["code"]) == (name, "failed", code)
        assert f"left{place:06d}.png" in entry["reasons"][-1]["detail"] or code == "NO_POINTS"


def test_unusual_pictures_are_read(scene: Path, tmp_path: Path, command: Any) -> None:
    left, right = (cv2.imread(str(scene / f"{eye}.png")) for eye in ("left", "right"))
    folder = tmp_path / "recording"
    folder.mkdir()
    alpha = (cv2.cvtColor(image, cv2.COLOR_BGR2BGRA) for image in (left, right))
    deep = (image.astype(np.uint16) * 257 for image in (left, right))
    grey = (cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in (left, right))
    for name, images in {
        "alpha": alpha,
        "deep": deep,
        "grey": grey,
        "suffix": (left, right),
    }.items():
        for eye, image in zip(("left", "right"), images, strict=True):
            data = cv2.imencode(".tif" if name == "deep" else ".png", image)[1].tobytes()
            (folder / f"{name}_{eye}.jpg").write_bytes(data)
    assert command(*run_arguments(scene, folder, tmp_path / "out")).code == 0
    found = {
        name: entry for name, entry in records(tmp_path / "out").items() if entry["counts"]["ores"]
    }
    assert found.keys() == {"alpha", "deep", "grey", "suffix"}


def test_the_limit_on_pixels_is_a_parameter(
    scene: Path, recording: Path, tmp_path: Path, command: Any
) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text("source: {max_pixels: 57599}\n")
    done = command(*run_arguments(scene, recording, tmp_path / "out", config=file))
    refused(done, f"left{GOOD}.png", "57,599", "source.max_pixels")
    assert records(tmp_path / "out")[GOOD]["reasons"][0]["code"] == "IMAGE_TOO_LARGE"
    assert (
        command(
            *run_arguments(scene, recording, tmp_path / "more"), "--set", "source.max_pixels=57600"
        ).code
        == 0
    )


@pytest.mark.parametrize("board", ["9x6", "charuco:9x6:20"])
def test_a_board_in_a_tiny_picture(board: str, tmp_path: Path, command: Any) -> None:
    cv2.imwrite(str(tmp_path / "both.png"), SMALL[:12, :16])
    done = command(
        "calibrate",
        "stereo",
        tmp_path,
        "--board",
        board,
        "--square-mm",
        25,
        "--out",
        tmp_path / "c.yaml",
    )
    assert done.code in (1, 2)
    assert not (tmp_path / "c.yaml").exists()


def limit_memory() -> None:
    import resource

    resource.setrlimit(resource.RLIMIT_AS, (4_000 * MEGABYTE, 4_000 * MEGABYTE))


def peak_mb(*arguments: object) -> tuple[int, str, float]:
    """Exit code, errors and peak memory [MB] of the installed command, which may have 4 GB of
    addresses at most."""
    script = (
        "import resource, subprocess, sys; code = subprocess.call(sys.argv[1:]);"
        "print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024, file=sys.stderr);"
        "sys.exit(code)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, "stereo-ore", *map(str, arguments)],
        capture_output=True, text=True, timeout=120, preexec_fn=limit_memory,
    )  # fmt: skip
    assert "Traceback" not in done.stderr
    *lines, peak = done.stderr.splitlines()
    return done.returncode, "\n".join(lines), float(peak)


@pytest.mark.skipif(sys.platform != "linux", reason="limits of addresses are Linux")
def test_a_bomb_costs_no_memory(scene: Path, recording: Path, tmp_path: Path) -> None:
    """12,000 × 12,000 pixels in 150 kB: 432 MB when it is decoded."""
    code, _, plain_mb = peak_mb(
        "-q", *run_arguments(scene, recording, tmp_path / "plain"), "--no-report"
    )
    assert code == 0
    for eye in ("left", "right"):
        (recording / f"{eye}000001.png").write_bytes(png(12_000, 12_000, 12_000))
        shutil.copy(FUZZED / "image" / "png_chunk_of_4_GB", recording / f"{eye}000002.png")
    code, _, bomb_mb = peak_mb(
        "-q", *run_arguments(scene, recording, tmp_path / "bomb"), "--no-report"
    )
    assert code == 0
    assert records(tmp_path / "bomb")["000001"]["reasons"][0]["code"] == "IMAGE_TOO_LARGE"
    assert bomb_mb < plain_mb + 60


# --- clouds


def npy_head(shape: str, kind: str = "<f4", order: str = "False") -> bytes:
    text = f"{{'descr': '{kind}', 'fortran_order': {order}, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


PLY = (
    "ply\nformat {} 1.0\n{}element vertex {}\nproperty float x\nproperty float y\nproperty float"
    " z\nend_header\n"
)
PCD = "VERSION 0.7\nFIELDS x y z\nSIZE {size} 4 4\nTYPE F F F\nCOUNT {count} 1 1\n"
PCD += "WIDTH {width}\nHEIGHT {height}\nDATA {data}\n"
T12 = 10**12
CLOUDS: dict[str, tuple[str, bytes]] = {
    "ply of 10^12 points": ("a.ply", PLY.format("binary_little_endian", "", T12).encode()),
    "ply of 10^12 points as text": ("a.ply", PLY.format("ascii", "", T12).encode() + b"1 2 3\n"),
    "ply of 10^12 faces before its points": ("a.ply",
        PLY.format("ascii", f"element face {T12}\n", 1).encode()),
    "ply of 10^4000 points": ("a.ply", PLY.format("binary_little_endian", "", "9" * 4000).encode()),
    "ply of -1 points": ("a.ply", PLY.format("ascii", "", -1).encode()),
    "ply without columns": ("a.ply",
        b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nend_header\n"),
    "ply whose header has no end": ("a.ply", b"ply\n" + b"comment x\n" * 100_000),
    "ply of one long line": ("a.ply", b"ply\n" + b"x" * 10_000_000),
    "pcd of 10^24 points": ("a.pcd", PCD.format(size=4, count=1, width=T12, height=T12,
        data="binary").encode()),
    "pcd of 10^9000 points": (
        "a.pcd", PCD.format(size=4, count=1, width="9" * 4500, height="9" * 4500,
            data="binary").encode(),
    ),
    "pcd of 10^8 columns": (
        "a.pcd", PCD.format(size=4, count=10**8, width=1, height=1, data="binary").encode(),
    ),
    "pcd of a long size": ("a.pcd", PCD.format(size="4" * 5000, count=1, width=1, height=1,
        data="binary").encode()),
    "npy of 10^12 rows": ("a.npy", npy_head(f"({T12}, 3)")),
    "npy of -1 rows": ("a.npy", npy_head("(-1, 3)") + bytes(24)),
    "npy of 10^4000 rows": ("a.npy", npy_head(f"({'9' * 4000}, 3)")),
    "npy of objects": ("a.npy", npy_head("(1, 3)", "|O") + b"cos\nsystem\n(S'true'\ntR."),
    "npy of nothing": ("a.npy", npy_head(f"({T12}, 3)", "|V0")),
    "npy with code for a shape": ("a.npy", npy_head("(__import__('os').abort(), 3)")),
    "npy with an open bracket": ("a.npy", npy_head("((((((")),
    "npz that is none": ("a.npz", b"PK\x03\x04" + bytes(40)),
    "xyz of words": ("a.xyz", b"1 2 3\nfour 5 6\n"),
    "csv with a nameless column": ("a.csv", b"x,y,z,\n1,2,3,4\n"),
    "csv of one endless row": ("a.csv", b"1," * 2_000_000),
}  # fmt: skip


@pytest.mark.parametrize("name", CLOUDS)
def test_hostile_clouds(name: str, tmp_path: Path, command: Any) -> None:
    file_name, data = CLOUDS[name]
    file = tmp_path / file_name
    file.write_bytes(data)
    line = refused(command("filter", file, tmp_path / "out.ply"), str(file))
    assert len(line) < 1000
    assert not (tmp_path / "out.ply").exists()


def test_a_cloud_in_fortran_s_order_is_read_row_by_row(tmp_path: Path, command: Any) -> None:
    points = np.random.default_rng(0).uniform(0, 1, (500, 3))
    np.save(tmp_path / "a.npy", np.asfortranarray(points))
    assert command("filter", tmp_path / "a.npy", tmp_path / "out.npy", "--method", "none").code == 0
    np.testing.assert_array_equal(np.load(tmp_path / "out.npy"), points)


@pytest.mark.skipif(sys.platform != "linux", reason="limits of addresses are Linux")
def test_an_archive_that_unpacks_to_gigabytes_is_refused_before(tmp_path: Path) -> None:
    file = tmp_path / "bomb.npz"
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("xyz.npy", npy_head("(400000000, 3)") + bytes(50 * MEGABYTE))
        archive.filelist[0].file_size = 4_800_000_128
    code, errors, peak = peak_mb("filter", file, tmp_path / "out.ply")
    assert code == 1
    assert "claims arrays" in errors
    assert peak < 600


# --- recordings in one file


def test_damaged_bags(tmp_path: Path, scene: Path, command: Any) -> None:
    pytest.importorskip("rosbags", reason="rosbags is not installed")
    import bags

    shots = [
        bags.Shot(topic, 1000 + n, 1000 + n, SMALL[:20, :40])
        for n in range(2)
        for topic in bags.TOPICS
    ]
    bags.write_bag(tmp_path / "m", "mcap", shots)
    mcap = next((tmp_path / "m").glob("*.mcap")).read_bytes()
    bag = bags.write_bag(tmp_path / "b", "ros1", shots).read_bytes()
    file_names = {"x.mcap": mcap, "x.bag": bag}
    for name, data in file_names.items():
        file = tmp_path / name
        for length in (0, 5, 40, len(data) // 2, len(data) - 9):
            file.write_bytes(data[:length])
            done = command(
                "run",
                file,
                "--calib",
                scene / "calibration.yaml",
                "--out",
                tmp_path / "out",
                "--overwrite",
            )
            assert done.code == 1, (name, length)
            refused(done, str(file))
        for place in range(8, len(data) - 16, len(data) // 25):
            # Lengths are four or eight bytes, little endian: any of them may claim all there is.
            file.write_bytes(data[:place] + b"\xff" * 7 + b"\x7f" + data[place + 8 :])
            done = command(
                "run",
                file,
                "--calib",
                scene / "calibration.yaml",
                "--out",
                tmp_path / "out",
                "--overwrite",
            )
            assert done.code in (0, 1, 3), (name, place)
            assert "Traceback" not in done.err


def test_a_video_that_claims_more_pictures_than_it_can_hold(
    tmp_path: Path, scene: Path, command: Any
) -> None:
    data = bytearray((FUZZED / "video" / "v.avi").read_bytes())
    for mark, offset in ((b"avih", 24), (b"strh", 40)):
        place = data.index(mark) + offset
        data[place : place + 4] = b"\xff\xff\xff\x7f"
    file = tmp_path / "claims.avi"
    file.write_bytes(data)
    done = command(
        "run", file, "--calib", scene / "calibration.yaml", "--out", tmp_path / "out", "--no-report"
    )
    refused(done, "image_size")
    assert len(records(tmp_path / "out")) == 2


# --- calibrations of every format


@pytest.mark.parametrize(
    "name",
    [
        "native",
        "zed",
        "opencv",
        "ros",
        "kalibr",
        "middlebury",
        "simplestereo",
        "calibrating",
        "camera_array",
        "orbslam",
    ],
)
@pytest.mark.parametrize("damage", ["half", "no numbers", "huge numbers", "zeros", "NaN"])
def test_damaged_calibrations(
    name: str, damage: str, recording: Path, tmp_path: Path, command: Any
) -> None:
    folder = FUZZED / name
    shutil.copy(folder.parents[1] / "right.yaml", tmp_path / "right.yaml")
    number = re.compile(r"(?<=[\s\[,=>;])-?\d+\.\d[\d.e+-]*")
    change: dict[str, Callable[[str], str]] = {
        "half": lambda text: text[: len(text) // 2],
        "no numbers": lambda text: number.sub("x", text),
        "huge numbers": lambda text: number.sub("1" + "0" * 390, text),
        "zeros": lambda text: number.sub("0.0", text),
        "NaN": lambda text: number.sub("nan" if name in ("zed", "middlebury") else ".nan", text),
    }
    for file in sorted(folder.glob("*.*")):
        path = tmp_path / ("left.yaml" if name == "ros" else file.name)
        path.write_text(change[damage](file.read_text()))
        done = command("run", recording, "--calib", path, "--out", tmp_path / "out")
        refused(done, str(tmp_path))
        assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("side", [40_000, 10**9, 10**18])
def test_a_calibration_for_enormous_images(
    side: int, scene: Path, recording: Path, tmp_path: Path, command: Any
) -> None:
    file = tmp_path / "enormous.yaml"
    text = (scene / "calibration.yaml").read_text()
    assert "[320, 180]" in text
    file.write_text(text.replace("[320, 180]", f"[{side}, {side}]"))
    refused(
        command(*run_arguments(scene, recording, tmp_path / "out", calib=file)),
        str(file),
        "image_size",
    )


# --- names of files

NAMES = [
    "-rf", "--out=x", "a b", "'quoted'", '"quoted"', "$(touch x)", "`touch y`", "a;b|c&d", "%s%n",
    "{{plotly}}",
    "[bold]", "[]", "<img src=x onerror=alert(1)>", "a\nb", "a\tb", "a\rb", "\x1b[2J",
    "\u2028", "\x85", "\u202egnp", "\U0001f480", "é", "e\u0301",
    "..", "...", ".hidden", "CON", "x" * 200, "9999999999999999999", "0" * 19, "\udcff\udcfe",
]  # fmt: skip
"""The last one is no UTF-8."""


@pytest.mark.skipif(sys.platform != "linux", reason="other systems refuse such names themselves")
def test_odd_names_of_images_folders_and_files(scene: Path, tmp_path: Path, command: Any) -> None:
    folder = tmp_path / "in \n<b>\u2028[red]\udcff"
    folder.mkdir()
    for place, name in enumerate(NAMES):
        for eye in ("left", "right"):
            target = folder / f"{name}_{eye}.png"
            (
                target.symlink_to(scene / f"{eye}.png")
                if place % 3
                else target.write_bytes(b"no picture")
            )
    out = tmp_path / "-o 'x'\n<img src=x onerror=alert(1)>"
    config, site = folder / "-c\n.yaml", folder / "\u2028site.yaml"
    config.write_text("{}\n")
    shutil.copy(scene / "site.yaml", site)
    arguments = [*run_arguments(scene, folder, out, config=config, site=site)]
    before = {path for path in tmp_path.rglob("*") if not path.is_relative_to(out)}
    done = command(*arguments)
    assert done.code == 0, done
    assert {path for path in tmp_path.rglob("*") if not path.is_relative_to(out)} == before
    found = records(out)
    # Hidden files are no recordings.
    assert len(found) == len([name for name in NAMES if not name.startswith(".")])
    assert (
        sum(entry["status"] != "failed" for entry in found.values())
        == len(list((out / "overlays").iterdir()))
        > 15
    )
    assert len(Results(out).records) == len(found)
    check_page(out / "report.html")
    whole = (out / "frames.jsonl").read_bytes()
    assert command(*arguments, "--resume", "--no-report").code == 0
    assert (out / "frames.jsonl").read_bytes() == whole
    assert command("report", out).code == 0
    assert command("replay", "--dry-run", out).code == 0


def check_page(file: Path) -> None:
    page = Page(file)
    assert sum(tag == "script" for tag, _ in page.tags) == 3
    assert not any("onerror" in attributes for _, attributes in page.tags)


@pytest.mark.parametrize("out", ["x" * 300, "x/" * 3000 + "y", "file/below", "file"])
def test_an_output_folder_that_can_not_be(
    out: str, scene: Path, recording: Path, tmp_path: Path, command: Any
) -> None:
    (tmp_path / "file").write_text("")
    refused(command(*run_arguments(scene, recording, tmp_path / out)), out[:20])


@pytest.mark.parametrize("name", ["x" * 300, "x/" * 3000 + "y", "loop", "none"])
def test_a_recording_that_can_not_be(name: str, scene: Path, tmp_path: Path, command: Any) -> None:
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    refused(command(*run_arguments(scene, tmp_path / name, tmp_path / "out")), name[:20])
    refused(
        command(*run_arguments(scene, scene, tmp_path / "out", calib=tmp_path / name)), name[:20]
    )
    refused(command("filter", tmp_path / f"{name}.ply", tmp_path / "out.ply"), name[:20])


def test_replacing_a_run_removes_nothing_that_is_not_its_own(
    scene: Path, recording: Path, tmp_path: Path, command: Any
) -> None:
    arguments = run_arguments(scene, recording, tmp_path / "out")
    assert command(*arguments, "--no-report").code == 0
    (tmp_path / "out" / "clouds" / "mine").mkdir()
    (tmp_path / "out" / "clouds" / "notes.txt").write_text("mine")
    assert (
        command(*arguments, "--no-report", "--overwrite", "--set", "segment.min_pixels=121").code
        == 0
    )
    assert (tmp_path / "out" / "clouds" / "notes.txt").read_text() == "mine"


# --- folders of results


def break_line(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    file = folder / "frames.jsonl"
    first, *rest = file.read_text().splitlines(keepends=True)
    entry = json.loads(first)
    change(entry)
    file.write_text(json.dumps(entry) + "\n" + "".join(rest))


RESULTS: dict[str, Callable[[Path], object]] = {
    "a frame that leads elsewhere": lambda run: break_line(
        run, lambda entry: entry.update(frame="../../secret")
    ),
    "an ore without a box": lambda run: break_line(run, lambda entry: entry["ores"][0].pop("box")),
    "no ores": lambda run: break_line(run, lambda entry: entry.pop("ores")),
    "a size of words": lambda run: break_line(
        run, lambda entry: entry["ores"][0].update(size_m=["a", "b", "c"])
    ),
    "an infinite offset": (
        lambda run: (run / "frames.jsonl").write_text(
            (run / "frames.jsonl").read_text().replace('"offset_m":-1.0', '"offset_m":1e999')
        )
    ),
    "NaN": (
        lambda run: (run / "frames.jsonl").write_text(
            (run / "frames.jsonl").read_text().replace('"offset_m":-1.0', '"offset_m":NaN')
        )
    ),
    "deep nesting": lambda run: (run / "frames.jsonl").write_text("[" * 100_000 + "\n"),
    "zeros": lambda run: (run / "frames.jsonl").write_bytes(bytes(5000) + b"\n"),
    "a run that is a list": lambda run: (run / "run.json").write_text("[]"),
    "a run that holds infinity": lambda run: (run / "run.json").write_text('{"source": 1e999}'),
    "a cloud without scores": (
        lambda run: (run / "clouds" / "000000.ply").write_bytes(
            PLY.format("ascii", "", 1).encode() + b"1 2 3\n"
        )
    ),
    "a cloud of 10^12 points": (
        lambda run: (run / "clouds" / "000000.ply").write_bytes(
            PLY.format("binary_little_endian", "", T12).encode()
        )
    ),
    "stages that are none": lambda run: (run / "stages" / "000000.npz").write_bytes(b"PK\x03\x04"),
    "stages of another run": lambda run: np.savez(
        run / "stages" / "000000.npz", keep=np.ones(3, bool)
    ),
}


@pytest.mark.parametrize("verb", ["report", "replay", "export"])
@pytest.mark.parametrize("name", RESULTS)
def test_damaged_results(name: str, verb: str, tmp_path: Path, command: Any) -> None:
    run = make_run(tmp_path / "run")
    RESULTS[name](run)
    more = {"report": [], "replay": ["--dry-run"], "export": [tmp_path / "bag"]}[verb]
    done = command(verb, run, *more)
    # Some verbs do not look at what is broken.
    assert done.code in (0, 1), done
    if done.code:
        refused(done, str(run))
    else:
        assert name.startswith(("a run", "a cloud", "stages"))


@pytest.mark.parametrize(
    ("file", "content"),
    [
        ("timings.jsonl", b"{}\n"),
        ("timings.jsonl", b'{"frame": "000000", "total_ms": "slow", "stages_ms": {}}\n'),
        ("overlays/000000.png", b"no picture"),
        ("overlays/000000.png", png(2_000_000, 2_000_000, 0)),
        ("config.yaml", b"\xff\xfe\0"),
        ("calibration_check.json", b"{}"),
    ],
)
def test_a_report_of_what_is_there(file: str, content: bytes, tmp_path: Path, command: Any) -> None:
    run = make_run(tmp_path / "run", [record(0, [ore(1)])])
    (run / file).write_bytes(content)
    done = command("report", run)
    assert done.code in (0, 1), done
    if done.code:
        refused(done, str(run))


# --- what is no file


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="POSIX only")
def test_pipes_and_endless_files_under_the_names_of_images(
    scene: Path, recording: Path, command: Any
) -> None:
    os.mkfifo(recording / "left000001.png")
    (recording / "left000002.png").symlink_to("/dev/zero")
    for index in (1, 2):
        shutil.copy(scene / "right.png", recording / f"right{index:06d}.png")
    assert command(*run_arguments(scene, recording, recording / "out")).code == 0
    found = records(recording / "out")
    assert [found[f"{n:06d}"]["reasons"][-1]["code"] for n in (1, 2)] == ["UNREADABLE_IMAGE"] * 2
    (recording / "endless.xyz").symlink_to("/dev/zero")
    refused(command("filter", recording / "endless.xyz", recording / "out.ply"), "is no file")


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX only")
def test_pipes_in_a_watched_folder_hold_nobody_up(scene: Path, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "left000000.png")
    for index, eye in ((0, "right"), (1, "left"), (1, "right")):
        shutil.copy(scene / f"{eye}.png", tmp_path / f"{eye}{index:06d}.png")
    frames = FolderWatch(tmp_path, poll_s=0.02, patience_s=0.2).frames(
        Position(), threading.Event()
    )
    assert [next(frames).name for _ in range(2)] == ["000001", "000000"]
