"""Records twenty frames with real recorders, none of which needs a device, and compares what a run
of each makes with what a run of the folder of pictures makes.

``python tests/real_recorders.py [RECORDER…]`` prints a line a recorder and ends with 1 when one
differs. Packages that are no dependency are installed, pinned, into a temporary environment; so it
needs a package index, and for the last two ``mkvmerge`` and ``ffmpeg``."""

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import venv
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from runs import quarter_scene

SCRIPTS = Path(__file__).parent / "recorders"
START_NS, PERIOD_NS, COUNT = 1_700_000_000_000_000_000, 100_000_000, 20


class Recorder(NamedTuple):
    """Packages and the script that records with them, or a function of this file; the file to
    write; which keys of a record the recording can't know."""

    file: str
    record: str | Callable[[Path, Path], None]
    packages: Sequence[str] = ()
    unknown: frozenset[str] = frozenset(("frame", "stamp_ns"))
    right_first: bool = False


def encoded(pictures: Path, file: Path, *options: str) -> None:
    """A video of the pictures by ffmpeg."""
    command = ["ffmpeg", "-v", "error", "-framerate", "10", "-i", str(pictures / "%06d.png")]
    subprocess.run([*command, *options, str(file)], check=True)


def with_mkvmerge(pictures: Path, file: Path) -> None:
    plain = file.with_name("plain.mkv")
    encoded(pictures, plain, "-c:v", "ffv1", "-pix_fmt", "bgr0")
    subprocess.run(
        ["mkvmerge", "-q", "-o", str(file), "--stereo-mode", "0:side_by_side_right_first", plain],
        check=True,
    )
    plain.unlink()


def with_frame_packing(pictures: Path, file: Path) -> None:
    lossless = ("-c:v", "libx264rgb", "-qp", "0", "-pix_fmt", "bgr24")
    encoded(pictures, file, *lossless, "-x264-params", "frame-packing=3")


NUMPY = "numpy==2.2.6"
RECORDERS = {
    "librealsense 2.57": Recorder(
        "ride.bag", "librealsense.py", ("pyrealsense2==2.57.7.10387", NUMPY)
    ),
    "librealsense 2.59": Recorder(
        "ride.db3", "librealsense.py", ("pyrealsense2==2.59.1.11053", NUMPY)
    ),
    "foxglove-sdk": Recorder(
        "ride.mcap", "foxglove_sdk.py", ("foxglove-sdk==0.30.3", NUMPY), frozenset()
    ),
    "depthai": Recorder("ride.mkv", "depthai_video.py", ("depthai==3.12.0", NUMPY)),
    "mkvmerge": Recorder("ride.mkv", with_mkvmerge, right_first=True),
    "ffmpeg": Recorder("ride.mp4", with_frame_packing),
}


def write_pictures(folder: Path, eyes: Sequence[np.ndarray]) -> None:
    """Twenty grey pictures an eye, no two alike, by stamp and as one array; and both beside each
    other, left or right eye first, by number."""
    together = []
    grain = np.random.default_rng(0).integers(0, 4, (COUNT, *eyes[0].shape), np.uint8)
    for number, noise in enumerate(grain):
        left, right = (cv2.add(eye, noise) for eye in eyes)
        together.append((left, right))
        shown = {
            f"plain/left/{START_NS + number * PERIOD_NS}": left,
            f"plain/right/{START_NS + number * PERIOD_NS}": right,
            f"left first/{number:06d}": np.hstack((left, right)),
            f"right first/{number:06d}": np.hstack((right, left)),
        }
        for name, picture in shown.items():
            path = folder / f"{name}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(str(path), picture)
    np.save(folder / "pictures.npy", together)


def record(recorder: Recorder, pictures: Path, folder: Path) -> Path:
    """Let a recorder write its file in `folder`."""
    file = folder / recorder.file
    if callable(recorder.record):
        order = "right first" if recorder.right_first else "left first"
        recorder.record(pictures / order, file)
        return file
    venv.create(folder / "venv", with_pip=True)
    python = folder / "venv" / "bin" / "python"
    subprocess.run([python, "-m", "pip", "install", "-q", *recorder.packages], check=True)
    subprocess.run([python, SCRIPTS / recorder.record, pictures / "pictures.npy", file], check=True)
    shutil.rmtree(folder / "venv")
    return file


def records(source: Path, known: Sequence[str], out: Path) -> list[dict[str, object]]:
    """The records of a run."""
    command = [sys.executable, "-m", "stereo_ore", "run", str(source), *known, "--out", str(out)]
    subprocess.run(
        [*command, "--no-report", "--no-clouds", "--no-overlays"],
        check=True, stdout=subprocess.DEVNULL,
    )  # fmt: skip
    lines = (out / "frames.jsonl").read_text(encoding="utf-8").splitlines()
    return [json.loads(line) for line in lines]


def differences(
    found: Sequence[dict[str, object]],
    expected: Sequence[dict[str, object]],
    unknown: frozenset[str],
) -> Iterator[str]:
    """What of the records differs but for `unknown`; where stamps are from always does."""
    if len(found) != len(expected):
        yield f"{len(found)} frames of {len(expected)}"
    for number, (mine, theirs) in enumerate(zip(found, expected, strict=False)):
        keys = sorted(theirs.keys() - unknown - {"stamp_source"})
        if wrong := [key for key in keys if mine[key] != theirs[key]]:
            yield f"frame {number}: {', '.join(wrong)}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recorders", nargs="*", default=list(RECORDERS), metavar="RECORDER")
    names, failed = parser.parse_args().recorders, False
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        known = quarter_scene(folder / "scene")
        eyes = [
            cv2.imread(str(folder / "scene" / f"{eye}.png"), cv2.IMREAD_GRAYSCALE)
            for eye in ("left", "right")
        ]
        write_pictures(folder / "pictures", eyes)
        expected = records(folder / "pictures" / "plain", known, folder / "plain")
        for each in names:
            place = folder / each
            place.mkdir()
            file = record(RECORDERS[each], folder / "pictures", place)
            found = records(file, known, place / "out")
            wrong = list(differences(found, expected, RECORDERS[each].unknown))
            failed |= bool(wrong)
            same = f"{len(found)} frames, the records of the folder"
            sys.stdout.write(f"{each}: {'; '.join(wrong) or same}\n")
            sys.stdout.flush()
    sys.exit(failed)


if __name__ == "__main__":
    main()
