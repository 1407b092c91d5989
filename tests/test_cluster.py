"""Runs on a Dask cluster of real processes: the same bytes as without one, also when a worker
dies."""

import json
import pickle
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from runs import quarter_scene

from stereo_ore.chain import Chain
from stereo_ore.errors import (
    ClusterError,
    FrameError,
    MissingExtraError,
    OutputError,
    StereoOreError,
)
from stereo_ore.io import calibration, recordings
from stereo_ore.io.site import load_site
from stereo_ore.runs import batch, cluster
from stereo_ore.runs.driver import Driver
from stereo_ore.runs.frame_files import FrameFiles

pytest.importorskip("distributed", reason="the extra [cluster] is not installed")

import psutil

Process = subprocess.Popen[bytes]


@contextmanager
def process(*words: str) -> Iterator[Process]:
    """A part of the cluster, killed at the end."""
    started = subprocess.Popen(
        [sys.executable, "-m", *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        yield started
    finally:
        started.kill()
        started.wait()


@contextmanager
def dask(folder: Path, workers: int) -> Iterator[tuple[str, list[Process]]]:
    """Address of a scheduler on this machine, and the processes of its workers."""
    file = folder / "scheduler.json"
    common = ("--host", "127.0.0.1", "--no-dashboard")
    with ExitStack() as stack:
        words = (
            "distributed.cli.dask_scheduler",
            *common,
            "--port",
            "0",
            "--scheduler-file",
            str(file),
        )
        stack.enter_context(process(*words))
        worker = (
            "distributed.cli.dask_worker",
            *common,
            "--scheduler-file",
            str(file),
            "--nthreads",
            "1",
            "--no-nanny",
        )
        scratch = ("--local-directory", str(folder / "scratch"))
        started = [stack.enter_context(process(*worker, *scratch)) for _ in range(workers)]
        end = time.monotonic() + 60
        while not file.exists() and time.monotonic() < end:
            time.sleep(0.1)
        yield json.loads(file.read_text())["address"], started


def record(scene: Path, folder: Path, frames: int) -> Path:
    """A recording of equal frames; frame 1 lacks its right image."""
    folder.mkdir()
    for index in range(frames):
        for eye in ("left", "right"):
            if (index, eye) != (1, "right"):
                shutil.copy(scene / f"{eye}.png", folder / f"{eye}{index:06d}.png")
    return folder


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scene")
    quarter_scene(folder)
    return folder


def make_job(scene: Path, recording: Path, out: Path) -> batch.Job:
    chain = Chain(calibration.load(scene / "calibration.yaml"), load_site(scene / "site.yaml"))
    return batch.Job(recordings.open_source(recording), Driver(chain, FrameFiles(out)))


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_a_worker_dies_and_nothing_is_lost_nor_double(scene: Path, tmp_path: Path) -> None:
    recording = record(scene, tmp_path / "recording", 10)
    expected = list(batch.run_in_batches(make_job(scene, recording, tmp_path / "one"), range(10)))
    job, found = make_job(scene, recording, tmp_path / "many"), []
    with dask(tmp_path, workers=2) as (address, workers):
        listening = ports()
        for lines in cluster.run_on_cluster(job, range(10), address):
            if not found:
                assert ports() == listening
                done = len(list((tmp_path / "many" / "overlays").glob("*.png")))
                workers[0].kill()
            found.append(lines)
    assert done < 8, "the worker was killed in the middle"
    assert [(lines.record, lines.inputs) for lines in found] == [
        (lines.record, lines.inputs) for lines in expected
    ]
    assert contents(tmp_path / "many") == contents(tmp_path / "one")


def ports() -> set[int]:
    """Ports that this process listens on."""
    return {
        entry.laddr.port
        for entry in psutil.Process().net_connections("inet")
        if entry.status == "LISTEN"
    }


@pytest.mark.slow
def test_a_run_through_every_loss_ends_with_the_same_bytes(scene: Path, tmp_path: Path) -> None:
    record(scene, tmp_path / "recording", 48)
    frames = tmp_path / "many" / "frames.jsonl.part"
    files = [
        "--calib",
        str(scene / "calibration.yaml"),
        "--site",
        str(scene / "site.yaml"),
        "--no-report",
    ]
    run = ["stereo-ore", "run", "recording", *files, "--save-stages", "--out"]
    assert subprocess.run([*run, "one"], cwd=tmp_path, timeout=300).returncode == 0

    def wait_for(lines: int) -> None:
        end = time.monotonic() + 120
        while time.monotonic() < end:
            if frames.exists() and frames.read_bytes().count(b"\n") >= lines:
                return
            time.sleep(0.05)
        pytest.fail(f"{frames} does not get {lines} lines")

    with dask(tmp_path, workers=3) as (address, workers):
        command = [*run, "many", "--scheduler", address]
        with subprocess.Popen(command, cwd=tmp_path) as first:
            wait_for(4)
            workers[0].kill()
            wait_for(10)
            first.kill()
        with subprocess.Popen([*command, "--resume"], cwd=tmp_path) as second:
            wait_for(20)
            workers[1].kill()
            assert second.wait(timeout=300) == 0
    one, many = contents(tmp_path / "one"), contents(tmp_path / "many")
    assert one.pop("timings.jsonl") != many.pop("timings.jsonl")
    assert many == one


@pytest.mark.slow
def test_losing_the_scheduler_is_one_line(scene: Path, tmp_path: Path) -> None:
    recording = record(scene, tmp_path / "recording", 30)
    files = [
        "--calib",
        str(scene / "calibration.yaml"),
        "--no-report",
        "--out",
        str(tmp_path / "out"),
    ]
    part = tmp_path / "out" / "frames.jsonl.part"
    with dask(tmp_path, workers=1) as (address, _):
        command = ["stereo-ore", "run", str(recording), *files, "--scheduler", address]
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as run:
            while not part.exists() or not part.read_bytes():
                time.sleep(0.1)
            scheduler = next(
                p for p in psutil.Process().children() if "dask_scheduler" in " ".join(p.cmdline())
            )
            scheduler.kill()
            messages = run.communicate(timeout=60)[1].splitlines()
    assert run.returncode == 1
    error = (
        "error: the connection to the scheduler is lost. The same command with --resume continues"
    )
    assert [line for line in messages if line not in ("30 frames", "cluster with 1 worker")][
        -1
    ] == error
    assert "Traceback" not in "".join(messages)


def test_a_cluster_without_workers_or_none_at_all(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = make_job(scene, record(scene, tmp_path / "recording", 1), tmp_path / "out")
    monkeypatch.setattr(cluster, "CONNECT_S", 1)
    monkeypatch.setattr(cluster, "WORKERS_S", 1)
    with pytest.raises(ClusterError, match=r"tcp://127.0.0.1:9: can't be reached.*dask scheduler"):
        list(cluster.run_on_cluster(job, range(1), "tcp://127.0.0.1:9"))
    with pytest.raises(ClusterError, match=r"nonsense://x: can't be reached"):
        list(cluster.run_on_cluster(job, range(1), "nonsense://x"))
    with (
        dask(tmp_path, workers=0) as (address, _),
        pytest.raises(ClusterError, match=f"dask worker {address}"),
    ):
        list(cluster.run_on_cluster(job, range(1), address))
    assert list(cluster.run_on_cluster(job, range(0), "nobody is asked")) == []
    assert list((tmp_path / "out").glob(".job*")) == []


def test_a_worker_elsewhere_says_what_it_does_not_see(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster, "PATIENCE_S", 0.1)
    with pytest.raises(
        ClusterError, match=r"worker on .* does not see the output folder.*file system"
    ):
        cluster._work(cluster.Envelope(tmp_path / "out" / ".job-1.pickle", tmp_path), [0])
    recording = record(scene, tmp_path / "recording", 1)
    with cluster._shipped(make_job(scene, recording, tmp_path / "out")) as envelope:
        recording.rename(tmp_path / "away")
        with pytest.raises(
            ClusterError, match=rf"{recording}: worker on .* does not see the recording"
        ):
            cluster._work(envelope, [0])


def test_a_worker_with_other_versions_is_refused(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with cluster._shipped(
        make_job(scene, record(scene, tmp_path / "recording", 1), tmp_path / "out")
    ) as envelope:
        monkeypatch.setattr(cluster, "versions", lambda: batch_versions() | {"numpy": "1.0"})
        with pytest.raises(ClusterError, match=r"has numpy 1\.0, not "):
            cluster._work(envelope, [0])


batch_versions = cluster.versions


def test_strict_gives_the_frames_before_the_one_that_failed(scene: Path, tmp_path: Path) -> None:
    job = replace(
        make_job(scene, record(scene, tmp_path / "recording", 3), tmp_path / "out"), strict=True
    )
    with cluster._shipped(job) as envelope:
        done = cluster._work(envelope, [0, 1, 2])
    assert [json.loads(lines.record)["frame"] for lines in done.lines] == ["000000"]
    assert isinstance(done.error, FrameError)
    assert "000001" in str(done.error)


@given(st.integers(0, 5000), st.integers(1, 200), st.integers(1, 7))
@settings(deadline=None)
def test_chunks_are_all_frames_in_order_and_enough_for_all(
    frames: int, workers: int, every: int
) -> None:
    indices = range(0, frames, every)
    chunks = cluster.split(indices, workers)
    assert [index for chunk in chunks for index in chunk] == list(indices)
    assert all(1 <= len(chunk) <= cluster.LARGEST_CHUNK for chunk in chunks)
    assert len(chunks) >= min(len(indices), 8 * workers)


@pytest.mark.parametrize(
    "error",
    [
        FrameError("is dark", code="DARK", file="a.png", remedy="Light it"),
        OutputError("is full", file="out"),
        MissingExtraError("rosbags", "bags"),
        StereoOreError("why?"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_errors_come_whole_from_another_process(error: StereoOreError) -> None:
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is type(error)
    assert str(copy) == str(error)
    assert vars(copy) == vars(error)


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (["--scheduler", "tcp://localhost:1", "--workers", "2"], 2, "one of --workers and"),
        (["--scheduler", "tcp://localhost:1"], 1, 'pip install "stereo-ore[cluster]"'),
    ],
)
def test_command_line(tmp_path: Path, arguments: list[str], code: int, says: str) -> None:
    words = [
        "run",
        str(tmp_path),
        *quarter_scene(tmp_path),
        "--out",
        str(tmp_path / "out"),
        *arguments,
    ]
    program = (
        "import sys; sys.modules['distributed'] = None\nfrom stereo_ore.cli import launch;"
        f" launch({words!r})"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == code
    assert says in done.stderr
    assert "Traceback" not in done.stderr
