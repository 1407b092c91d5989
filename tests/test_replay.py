"""Recorded results to the arm's side: same messages, at the recorded pace, always marked as a
replay."""

import json
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from live import free_port, make_record
from typer.testing import CliRunner

from stereo_ore.cli import app, load_verbs
from stereo_ore.errors import SourceError, StereoOreError
from stereo_ore.plant.replay import frames, schedule
from stereo_ore.plant.sinks.message import transform_id

COMMAND = [sys.executable, "-c", "from stereo_ore.cli import launch; launch()", "replay"]


def write_run(folder: Path, stamps: list[int | None], part: bool = False) -> Path:
    folder.mkdir(exist_ok=True)
    records = [make_record(index, stamp_ns=stamp) for index, stamp in enumerate(stamps)]
    end = ".part" if part else ""
    (folder / f"frames.jsonl{end}").write_text(
        "".join(json.dumps(record) + "\n" for record in records)
    )
    timings = [
        json.dumps({"frame": record["frame"], "stages_ms": {}, "total_ms": 250.0}) + "\n"
        for record in records
    ]
    (folder / f"timings.jsonl{end}").write_text("".join(timings))
    return folder


def invoke(*arguments: object):
    load_verbs()
    return CliRunner().invoke(app, ["replay", *map(str, arguments)])


@pytest.mark.parametrize(
    ("stamps", "rate", "speed", "due"),
    [
        ([10**18, 10**18 + 2 * 10**9, 10**18 + 3 * 10**9], None, 1.0, [0, 2, 3]),
        ([10**18, 10**18 + 2 * 10**9, 10**18 + 3 * 10**9], None, 2.0, [0, 1, 1.5]),
        ([10**18, 10**18 - 5 * 10**9, 10**18], None, 1.0, [0, 0, 5]),
        ([None, None, None], None, 1.0, [0, 0.25, 0.5]),
        ([10**18, 10**18 + 2 * 10**9, None], 10.0, 1.0, [0, 0.1, 0.2]),
    ],
)
def test_frames_are_due_as_recorded_or_at_a_rate(tmp_path, stamps, rate, speed, due):
    found = [at for at, _ in schedule(write_run(tmp_path, stamps), rate, speed)]
    assert found == pytest.approx(due)


def test_an_unfinished_run_is_read_up_to_its_last_whole_line(tmp_path):
    write_run(tmp_path, [None, None], part=True)
    with (tmp_path / "frames.jsonl.part").open("a") as file:
        file.write(json.dumps(make_record(2))[:100])
    assert [record["frame"] for record in frames(tmp_path)] == ["000000", "000001"]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("{}\n", "line 1 is no record"),
        ("nonsense\n", "line 1 is no JSON"),
        ("[]\n", "line 1 is no JSON"),
    ],
)
def test_lines_that_are_no_records(tmp_path, text, says):
    (tmp_path / "frames.jsonl").write_text(text)
    with pytest.raises(SourceError, match=says):
        list(frames(tmp_path))


def test_a_folder_without_a_run(tmp_path):
    with pytest.raises(SourceError, match=r"no frames\.jsonl"):
        list(frames(tmp_path))


def test_dry_run_prints_every_message_marked_as_replay_with_the_transform(tmp_path):
    write_run(tmp_path, [None] * 3)
    T = np.eye(4)
    T[:3, 3] = 1, 2, 3
    site = {"format": "stereo_ore/site", "version": 1, "arm_from_camera": T.tolist()}
    (tmp_path / "site.yaml").write_text(yaml.safe_dump(site))
    result = invoke(tmp_path, "--dry-run")
    assert result.exit_code == 0, result.output
    messages = [json.loads(line) for line in result.stdout.splitlines()]
    assert [message["sequence"] for message in messages] == [1, 2, 3]
    assert all(message["replay"] and message["valid"] for message in messages)
    assert {message["transform_id"] for message in messages} == {transform_id(T)}


def test_without_a_consumer_it_says_what_to_name(tmp_path):
    result = invoke(write_run(tmp_path, [None]))
    assert result.exit_code == 2
    assert "--dry-run" in result.output


def test_an_address_beyond_this_machine_is_refused(tmp_path):
    file = tmp_path / "sinks.yaml"
    file.write_text("format: stereo_ore/sinks\nversion: 1\ntcp: {host: 0.0.0.0}\n")
    result = invoke(write_run(tmp_path, [None]), "--sinks", file)
    assert isinstance(result.exception, StereoOreError)
    assert "beyond this machine" in str(result.exception)


def test_the_command_sends_at_the_given_rate_and_withdraws_at_the_end(tmp_path):
    write_run(tmp_path, [None] * 5)
    port = free_port()
    command = [*COMMAND, str(tmp_path), "--rate", "5", "--tcp", str(port), "--valid-for", "1"]
    with subprocess.Popen(command) as process:
        end = time.monotonic() + 30
        while True:
            try:
                connection = socket.create_connection(("127.0.0.1", port), timeout=10)
                break
            except OSError:
                assert time.monotonic() < end
                time.sleep(0.01)
        with connection, connection.makefile("rb") as lines:
            received = [(time.monotonic(), json.loads(line)) for line in lines]
        assert process.wait(20) == 0
    messages = [(at, line) for at, line in received if line["schema"] == "stereo_ore/targets/1"]
    of_frames = [(at, line) for at, line in messages if line["status"] == "ok"]
    assert of_frames[-1][1]["frame"] == "000004"
    between = (of_frames[-1][0] - of_frames[0][0]) / max(
        1, of_frames[-1][1]["index"] - of_frames[0][1]["index"]
    )
    assert between == pytest.approx(0.2, abs=0.08)
    withdrawn_at, withdrawn = messages[len(of_frames)]
    assert not withdrawn["valid"]
    assert withdrawn_at - of_frames[-1][0] == pytest.approx(1.0, abs=0.3), (
        "the last targets run out as they would have"
    )
    assert messages[-1][1]["status"] == "stopped"
    assert all(line["replay"] for _, line in messages)
