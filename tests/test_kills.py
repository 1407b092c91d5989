"""Killed at any moment, a run goes on to the same bytes, and no file is ever half written under its
final name.

Run as a program this file kills a writer of a run's folder before each of its operations on files,
one after the other."""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from runs import quarter_scene

from stereo_ore.io import clouds

pytestmark = pytest.mark.skipif(os.name != "posix", reason="SIGKILL is POSIX")

FRAMES = 10
LEFT_OUT = {"timings.jsonl", "report.html"}
"""Files with final names that may differ between two runs."""

GROWING = (".part", ".tmp")
LOOSE = {"run.json": "finished"}
"""Files that are written whole more than once: until the end they are JSON without this key."""


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Arguments of `run` for ten small frames that differ, one of them without its right eye."""
    folder = tmp_path_factory.mktemp("kills")
    arguments = quarter_scene(folder / "scene")
    images = folder / "recording"
    images.mkdir()
    for index in range(FRAMES):
        for eye in ("left", "right"):
            if (index, eye) != (4, "right"):
                image = cv2.imread(str(folder / "scene" / f"{eye}.png"))
                cv2.imwrite(
                    str(images / f"{eye}{index:06d}.png"),
                    cv2.subtract(image, np.full_like(image, 2 * index)),
                )
    return ["stereo-ore", "-q", "run", str(images), *arguments, "--no-report"]


def final_files(out: Path) -> dict[str, bytes]:
    """Files that have their final names, hidden and growing ones left out."""
    found = (file for file in out.rglob("*") if file.is_file() and not file.name.endswith(GROWING))
    return {str(file.relative_to(out)): file.read_bytes() for file in found}


def check_whole(out: Path, reference: dict[str, bytes]) -> None:
    """What has its final name is what the undisturbed run has there, whole."""
    for name, data in final_files(out).items():
        if name in LOOSE and data != reference[name]:
            assert LOOSE[name] not in json.loads(data), name
        elif name == "timings.jsonl":
            assert len(data.splitlines()) == FRAMES
        else:
            assert data == reference[name], name


def check_end(out: Path, reference: dict[str, bytes]) -> None:
    found = final_files(out)
    assert found.keys() == reference.keys()
    assert [name for name in found if name not in LEFT_OUT and found[name] != reference[name]] == []
    assert [file for file in out.rglob("*") if file.name.endswith(GROWING)] == []
    for name in found:
        if name.endswith(".ply"):
            assert len(clouds.read(out / name))


def start(command: list[str]) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    )


def until_opened(process: subprocess.Popen[bytes], out: Path) -> None:
    """Wait until a run has begun to write, or has ended."""
    while process.poll() is None and not (out / "inputs.jsonl.part").exists():
        time.sleep(0.01)


def kill_after(command: list[str], out: Path, seconds: float, from_start: bool) -> bool:
    """Start a command and kill it some time after it started, or began to write; False when it had
    ended before."""
    with start(command) as process:
        if not from_start:
            until_opened(process, out)
        time.sleep(seconds)
        alive = process.poll() is None
        process.kill()
    return alive


def kill_and_resume(
    recording: list[str], out: Path, workers: int, kills: int, seed: int
) -> dict[str, int]:
    """Kill runs at random moments until there were so many kills; each run is resumed to its
    end."""
    rng = random.Random(seed)
    command = [*recording, "--out", str(out), "--workers", str(workers)]
    with start(command) as process:
        until_opened(process, out)
        opened = time.monotonic()
    work_s = time.monotonic() - opened
    reference = final_files(out)
    counts = {"kills": 0, "runs": 0, "before the first frame": 0, "with all frames done": 0}
    while counts["kills"] < kills:
        shutil.rmtree(out)
        again: list[str] = []
        for _ in range(min(rng.randint(1, 4), kills - counts["kills"])):
            # What is done before anything is written is half of the time, and shows little: one
            # kill in eight.
            if kill_after(
                [*command, *again],
                out,
                rng.uniform(0, 1.05 * work_s),
                from_start=rng.random() < 1 / 8,
            ):
                counts["kills"] += 1
                part = out / "frames.jsonl.part"
                done = len(part.read_bytes().splitlines()) if part.exists() else 0
                counts["before the first frame"] += done == 0
                counts["with all frames done"] += done == FRAMES
            if out.exists():
                check_whole(out, reference)
            again = ["--resume"]
        subprocess.run([*command, "--resume"], check=True, capture_output=True)
        check_end(out, reference)
        counts["runs"] += 1
    return counts


def test_killed_five_times_it_ends_with_the_same_bytes(
    recording: list[str], tmp_path: Path
) -> None:
    assert kill_and_resume(recording, tmp_path / "out", workers=1, kills=5, seed=1)["kills"] == 5


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_killed_200_times_it_ends_with_the_same_bytes(
    recording: list[str], workers: int, tmp_path: Path
) -> None:
    counts = kill_and_resume(recording, tmp_path / "out", workers, kills=200, seed=workers)
    sys.stdout.write(f"{workers} workers: {counts}\n")
    assert counts["kills"] == 200


@pytest.mark.skipif(not hasattr(os, "fork"), reason="POSIX only")
@pytest.mark.parametrize("begin", ["new", "finished", "killed"])
def test_killed_before_each_operation_on_a_file_it_loses_no_frame(
    begin: str, tmp_path: Path
) -> None:
    done = subprocess.run(
        [sys.executable, __file__, str(tmp_path), begin],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    kills, lost = map(int, done.stdout.split())
    assert kills > (10 if begin == "finished" else 20)
    assert lost == 0


# --- the program: forks from a process that has one thread


def write_run(folder: Path, resume: bool, frames: int = FRAMES, finish: bool = True) -> int:
    """Write a run's folder as `run` does; the number of frames that were done before."""
    from stereo_ore.io.atomic import write_bytes
    from stereo_ore.runs.folder import FrameLines, RunFolder

    with RunFolder(folder, {"source": "here"}, resume=resume, overwrite=False) as run:
        for index in range(run.done, frames):
            write_bytes(folder / "clouds" / f"{index}.ply", b"x" * 9999)
            record = {"frame": str(index), "targets": [], "ores": []}
            run.add(
                FrameLines(
                    json.dumps(record), json.dumps({"frame": index}), json.dumps({"frame": index})
                )
            )
        if finish:
            run.finish()
    return run.done


def operations(folder: Path, limit: int) -> None:
    """Kill this process before its operation `limit` on a file below the folder."""
    count = 0

    def hook(event: str, arguments: tuple[object, ...]) -> None:
        nonlocal count
        if event in ("open", "os.rename", "os.remove", "os.mkdir") and str(arguments[0]).startswith(
            str(folder)
        ):
            if count == limit:
                os.kill(os.getpid(), signal.SIGKILL)
            count += 1

    sys.addaudithook(hook)


def killed_writers(folder: Path, begin: str) -> Iterator[Path]:
    """Folders of writers that were killed before their first, second, … operation, until one comes
    to its end."""
    for limit in range(10_000):
        out = folder / str(limit)
        if begin != "new":
            write_run(
                out,
                resume=False,
                frames=FRAMES if begin == "finished" else 2,
                finish=begin == "finished",
            )
        child = os.fork()
        if child == 0:
            operations(out, limit)
            write_run(out, resume=True)
            os._exit(0)
        if os.waitpid(child, 0)[1] == 0:
            return
        yield out


def main() -> None:
    folder, begin = Path(sys.argv[1]), sys.argv[2]
    with tempfile.TemporaryDirectory() as whole:
        write_run(Path(whole), resume=False)
        reference = final_files(Path(whole))
    kills = lost = 0
    for out in killed_writers(folder, begin):
        kills += 1
        if out.exists():
            check_whole(out, reference)
        lines = [
            file
            for file in out.glob("frames.jsonl*")
            if file.name in ("frames.jsonl", "frames.jsonl.part")
        ]
        before = len(lines[0].read_bytes().splitlines()) if lines else 0
        # A frame counts when its three lines are there: of the last one, one or two may be missing.
        lost += max(0, before - 1 - write_run(out, resume=True))
        if begin == "finished":
            lost += before < FRAMES
        assert final_files(out) == reference
    sys.stdout.write(f"{kills} {lost}\n")


if __name__ == "__main__":
    main()
