"""Health, metrics and the log of a live run, as a watchdog, Prometheus and a log collector read
them."""

import json
import logging
import re
import shutil
import subprocess
import sys
import time
from collections import namedtuple
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from live import ListSink, make_record, running, wait_for

from stereo_ore.cli.logs import JsonLines
from stereo_ore.plant.monitor import health, metrics
from stereo_ore.plant.publisher import Publisher
from stereo_ore.plant.status import LATENCY_S, PlantStatus

SAMPLE = re.compile(r'(stereo_ore_[a-z_]+)(?:\{((?:[a-z_]+="(?:[^"\\\n]|\\[\\"n])*",?)+)\})? (\S+)')
Usage = namedtuple("Usage", "total used free")


class Source:
    name = "test"

    def frames(self, start: Any, stop: Any) -> Iterator[Any]:
        return iter(())

    def state(self) -> str:
        return "watching"


class Sink(ListSink):
    """A sink whose state can be said."""

    def __init__(self) -> None:
        super().__init__()
        self.more: dict[str, Any] = {}

    def state(self) -> Any:
        return replace(super().state(), **self.more)


@pytest.fixture
def sink() -> Sink:
    return Sink()


@pytest.fixture
def status(sink: Sink) -> Iterator[PlantStatus]:
    with Publisher([sink], valid_for_s=5.0) as publisher:
        yield PlantStatus(Source(), publisher)


def samples(text: str) -> dict[str, float]:
    """Values by name and labels of a text in Prometheus' format; every line must be of it."""
    found, types = {}, {}
    for line in text.splitlines():
        if line.startswith("# TYPE "):
            _, _, name, kind = line.split(" ")
            assert name not in types
            types[name] = kind
        elif not line.startswith("# HELP "):
            name, labels, value = SAMPLE.fullmatch(line).groups()
            assert re.sub(r"_(bucket|sum|count)$", "", name) in types or name in types
            assert f"{name}{{{labels or ''}}}" not in found
            found[f"{name}{{{labels or ''}}}"] = float(value)
    assert text.endswith("\n")
    return found


def test_metrics_count_what_happened(status: PlantStatus, sink: Sink, tmp_path: Path):
    for index, (verdict, latency_s) in enumerate(
        (("ok", 0.3), ("ok", 0.25), ("failed", 100.0), ("ok", -5.0))
    ):
        status.add(make_record(index, status=verdict), latency_s)
    sink.more = {"restarts": 2, "alarm": "x", "address": 'a"b\\c\nd'}
    found = samples(metrics(status, tmp_path))
    assert found['stereo_ore_frames_total{status="ok"}'] == 3
    assert found['stereo_ore_frames_total{status="failed"}'] == 1
    assert found['stereo_ore_reasons_total{code="FEW_DISPARITIES"}'] == 1
    assert found["stereo_ore_targets_total{}"] == 6
    buckets = [
        found[f'stereo_ore_latency_seconds_bucket{{le="{bound}"}}']
        for bound in (*LATENCY_S, "+Inf")
    ]
    assert buckets == [1, 2, 3, 3, 3, 3, 3, 3, 4]
    assert found["stereo_ore_latency_seconds_count{}"] == 4
    assert found["stereo_ore_latency_seconds_sum{}"] == pytest.approx(100.55)
    assert 0 <= found["stereo_ore_frame_age_seconds{}"] < 5
    labels = r'{sink="list",address="a\"b\\c\nd"}'
    assert (
        found[f"stereo_ore_sink_restarts_total{labels}"],
        found[f"stereo_ore_sink_alarm{labels}"],
    ) == (2, 1)
    assert found["stereo_ore_disk_free_bytes{}"] > 0


def test_metrics_before_the_first_frame_are_of_the_format_too(status: PlantStatus, tmp_path: Path):
    found = samples(metrics(status, tmp_path))
    assert not any(
        name.startswith(("stereo_ore_frame_age", "stereo_ore_target_age")) for name in found
    )
    assert found["stereo_ore_targets_valid{}"] == 0
    assert "stereo_ore_fines_share{}" not in found


def test_metrics_have_the_fines_of_the_last_frame(status: PlantStatus, tmp_path: Path):
    for share in (0.25, None):
        status.add(make_record(3) | {"grizzly": {"fines_share": share}})
        lines = metrics(status, tmp_path).splitlines()
        shown = [line for line in lines if line.startswith("stereo_ore_fines_share ")]
        assert shown == ([] if share is None else ["stereo_ore_fines_share 0.25"])


def test_prometheus_own_parser_reads_them(status: PlantStatus, tmp_path: Path):
    parser = pytest.importorskip(
        "prometheus_client.parser", reason="prometheus_client is not installed"
    )
    status.add(make_record(0), 0.2)
    families = {
        family.name: family
        for family in parser.text_string_to_metric_families(metrics(status, tmp_path))
    }
    assert families["stereo_ore_latency_seconds"].type == "histogram"
    assert families["stereo_ore_frames"].samples[0].value == 1


def test_health_tells_what_needs_somebody(
    status: PlantStatus, sink: Sink, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    assert health(status, tmp_path)["status"] == "warning"
    status.add(make_record(0))
    status.publisher.publish(make_record(0), 0.0)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: Usage(1, 1, 10**12))
    assert health(status, tmp_path)["status"] == "ok"
    sink.more = {"connected": False}
    assert "nobody connected" in health(status, tmp_path)["warnings"][0]
    sink.more = {"alarm": "failed, starting again: x"}
    verdict = health(status, tmp_path)
    assert (verdict["status"], verdict["alarms"]) == ("alarm", ["list: failed, starting again: x"])
    sink.more = {}
    monkeypatch.setattr(shutil, "disk_usage", lambda path: Usage(1, 1, 10**7))
    assert "10 MB left" in health(status, tmp_path)["alarms"][0]
    monkeypatch.setattr(shutil, "disk_usage", lambda path: Usage(1, 1, 5 * 10**8))
    assert health(status, tmp_path)["status"] == "warning"
    monkeypatch.setattr(shutil, "disk_usage", lambda path: Usage(1, 1, 10**12))
    status.publisher.valid_for_s = 0.01
    time.sleep(0.05)
    assert health(status, tmp_path)["warnings"] == ["no frame for 0 s"]


def test_a_line_of_json_holds_whatever_a_message_holds():
    record = logging.makeLogRecord(
        {"name": "a", "levelname": "INFO", "msg": "x\n%s", "args": ("é\udce9",)}
    )
    record.frame, record.path = "1", Path("/x")
    line = JsonLines().format(record)
    assert "\n" not in line
    read = json.loads(line)
    assert (read["message"], read["frame"], read["path"], read["level"]) == (
        "x\né\udce9",
        "1",
        "/x",
        "info",
    )
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z", read["time"])
    try:
        1 / 0  # noqa: B018
    except ZeroDivisionError:
        record.exc_info = sys.exc_info()
    assert "ZeroDivisionError" in json.loads(JsonLines().format(record))["traceback"]


def test_each_frame_is_a_line_of_the_log(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    from test_serve_watch import put_pair, watch

    inbox = tmp_path / "in"
    inbox.mkdir()
    sink = ListSink()
    with (
        caplog.at_level(logging.INFO, "stereo_ore"),
        running(watch(inbox), tmp_path / "out", [sink]),
    ):
        put_pair(inbox, 0)
        (inbox / "left000001.png").write_bytes(b"nothing")
        (inbox / "right000001.png").write_bytes(b"nothing")
        put_pair(inbox, 2)
        wait_for(lambda: len(sink.messages) >= 3, 30)
    lines = [
        json.loads(JsonLines().format(r))
        for r in caplog.records
        if r.name == "stereo_ore.plant.loop"
    ]
    assert [line["frame"] for line in lines] == ["000000", "000002", "000001"]
    assert [line["status"] for line in lines] == ["ok", "ok", "failed"]
    assert [line["targets"] for line in lines] == [2, 2, 0]
    assert lines[2]["reasons"]
    assert all(line["latency_ms"] >= 0 for line in lines)


def test_the_command_writes_its_messages_as_json(tmp_path: Path):
    words = ["--log-format", "json", "-v", "replay", str(tmp_path), "--dry-run"]
    (tmp_path / "frames.jsonl").write_text(json.dumps(make_record(0)) + "\n")
    code = f"import logging; from stereo_ore.cli import launch, app\nlaunch({words!r})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert [json.loads(line)["level"] for line in done.stderr.splitlines()] == []
    code = (
        "import logging; logging.getLogger('stereo_ore.x').warning('a %s', 1, extra={'frame': 'f'})"
    )
    code = f"from stereo_ore import cli; cli.main(log_format=cli.LogFormat.JSON); {code}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    line = json.loads(done.stderr)
    assert (line["message"], line["frame"], line["logger"]) == ("a 1", "f", "stereo_ore.x")
