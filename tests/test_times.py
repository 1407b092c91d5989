"""Times of frames: where they are from, that the user may give them, and that they reach the
records."""

import json
import os
import re
import threading
import time
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest
from runs import make_run, ore, quarter_scene, record

from stereo_ore.cli import launch
from stereo_ore.cli.closing import Closing, cause
from stereo_ore.errors import ConfigError, FrameError
from stereo_ore.io.record_check import record_fault
from stereo_ore.io.recordings import open_source
from stereo_ore.io.recordings.retimed import parse_time, retime
from stereo_ore.plant.frames import LiveFrame, Position
from stereo_ore.plant.watch import FolderWatch

MARCH = 1_774_958_400_000_000_000
JUNE = 1_687_000_000_123_456_789
"""2023-06-17T11:06:40.123456789Z"""


def save_pair(
    folder: Path, number: int, changed_ns: int | None = None, suffix: str = ".png"
) -> None:
    for eye in ("left", "right"):
        path = folder / f"{eye}{number:06d}{suffix}"
        image = np.random.default_rng([number, eye == "left"]).integers(
            0, 255, (12, 16, 3), np.uint8
        )
        path.write_bytes(cv2.imencode(suffix, image)[1].tobytes())
        if changed_ns is not None:
            os.utime(path, ns=(0, changed_ns))


# --- given times


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("2026-03-31T12:00:00Z", MARCH),
        ("2026-03-31T14:00:00.250+02:00", MARCH + 250_000_000),
        ("2026-03-31 12:00:00.000001", MARCH + 1000),
        ("2026-03-31", MARCH - 12 * 3600 * 10**9),
    ],
)
def test_times_are_iso_8601(text: str, expected: int) -> None:
    assert parse_time(text) == expected


@pytest.mark.parametrize("text", ["yesterday", "", "12:00", "2026-13-01"])
def test_what_is_no_time(text: str) -> None:
    with pytest.raises(ConfigError, match="is no time"):
        parse_time(text)


def test_a_beginning_and_a_rate_replace_what_the_recording_says(tmp_path: Path) -> None:
    for number, changed_s in enumerate((100, 107, 109)):
        save_pair(tmp_path, number, changed_s * 10**9)
    source = open_source(tmp_path)

    def stamps(start_ns: int | None, fps: float | None) -> list[int]:
        return [retime(source, start_ns, fps).stamp(index).ns for index in range(3)]

    assert stamps(None, None) == [100 * 10**9, 107 * 10**9, 109 * 10**9]
    assert stamps(MARCH, None) == [MARCH, MARCH + 7 * 10**9, MARCH + 9 * 10**9]
    assert stamps(MARCH, 4) == [MARCH, MARCH + 250_000_000, MARCH + 500_000_000]
    assert stamps(None, 2) == [100 * 10**9, 100 * 10**9 + 500_000_000, 101 * 10**9]
    pair = retime(source, MARCH, 4).read(2)
    assert (pair.stamp_ns, pair.stamp_source, pair.index, pair.name) == (
        MARCH + 500_000_000,
        "options",
        2,
        "000002",
    )
    assert retime(source, None, None) is source


def test_records_hold_times_and_where_they_are_from(tmp_path: Path) -> None:
    for number in range(2):
        save_pair(
            (
                tmp_path / "recording"
                if (tmp_path / "recording").exists()
                else made(tmp_path / "recording")
            ),
            number,
            MARCH,
        )
    (tmp_path / "recording" / "right000001.png").unlink()
    (tmp_path / "calibration.yaml").write_text(
        "format: stereo_ore/stereo-calibration\nversion: 1\ncamera: test\nimage_size: [16,"
        " 12]\nimages: rectified\nleft: {focal_px: [20.0, 20.0], principal_point_px: [8.0,"
        " 6.0]}\nright: {focal_px: [20.0, 20.0], principal_point_px: [8.0, 6.0]}\nright_from_left:"
        " {rotation_vector_rad: [0, 0, 0], translation_m: [-0.12, 0, 0]}\n"
    )
    command = [
        "run",
        tmp_path / "recording",
        "--calib",
        tmp_path / "calibration.yaml",
        "--out",
        tmp_path / "out",
        "--no-report",
    ]
    with pytest.raises(SystemExit) as end:
        launch([str(word) for word in command])
    assert end.value.code == 3, "no frame is usable"
    records = [
        json.loads(line) for line in (tmp_path / "out" / "frames.jsonl").read_text().splitlines()
    ]
    assert [(entry["stamp_ns"], entry["stamp_source"]) for entry in records] == [
        (MARCH, "modification time")
    ] * 2
    assert {record_fault(entry) for entry in records} == {None}
    assert record_fault({**records[0], "stamp_source": "guess"}) is not None


def made(folder: Path) -> Path:
    folder.mkdir()
    return folder


def test_a_recording_without_header_stamps_can_be_asked_by_day_and_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Numbered PNG files → `run` → `export` → the query of the guide and pandas, beside a run whose
    frames have no stamp at all."""
    duckdb = pytest.importorskip("duckdb", reason="duckdb is not installed")
    pandas = pytest.importorskip("pandas", reason="pandas is not installed")
    known = quarter_scene(tmp_path / "scene")
    stamps = [JUNE + number * 33_000_000 for number in range(2)]
    (tmp_path / "recording").mkdir()
    for number, stamp in enumerate(stamps):
        for eye in ("left", "right"):
            image = cv2.imread(str(tmp_path / "scene" / f"{eye}.png"))
            image[0, 0] = number  # no frozen image
            path = tmp_path / "recording" / f"{eye}{number:06d}.png"
            cv2.imwrite(str(path), image)
            os.utime(path, ns=(0, stamp))
    site = tmp_path / "scene" / "site.yaml"
    # A narrower opening, so that some lump is surely too large for it.
    site.write_text(site.read_text().replace("opening_m: 0.148", "opening_m: 0.11"))
    # Of so small a picture depths tell little of where the screen is.
    coarse = ("--set", "health.max_bar_shift=0.3")
    command(0, "run", tmp_path / "recording", *known, *coarse, "--out", tmp_path / "out")
    command(0, "export", tmp_path / "out", tmp_path / "tables", "--format", "parquet")
    bare = make_run(tmp_path / "bare", [record(0, [ore(1)], stamp_ns=None)], stages=False)
    command(0, "export", bare, tmp_path / "tables", "--format", "parquet")

    monkeypatch.chdir(tmp_path)
    guide = (Path(__file__).parents[1] / "docs" / "cluster.md").read_text(encoding="utf-8")
    ((month, _, oversize, targets, volume),) = duckdb.sql(
        guide.partition("```sql\n")[2].partition("```")[0]
    ).fetchall()
    assert (str(month), targets <= oversize, volume > 0) == ("2023-06-01", True, True)
    table = pandas.read_parquet("tables/ores")
    dated = table[table.stamp_source == "modification time"]
    assert oversize == dated.oversize.sum() > 0
    assert sorted({stamp.value for stamp in dated.stamp_utc}) == stamps, "to the nanosecond"
    assert {str(date) for date in dated.date} == {"2023-06-17"}
    assert table[~table.index.isin(dated.index)][["date", "stamp_utc"]].isna().all(axis=None)
    rows = pandas.read_csv(tmp_path / "out" / "ores.csv", parse_dates=["stamp_utc"])
    assert [stamp.value for stamp in rows.stamp_utc] == [stamp.value for stamp in dated.stamp_utc]
    assert set(rows.stamp_source) == {"modification time"}


def command(code: int, *words: object) -> None:
    with pytest.raises(SystemExit) as end:
        launch([str(word) for word in words])
    assert end.value.code == code


# --- the end of a run


def reason(code: str) -> dict[str, str]:
    return {"code": code, "detail": code.lower()}


@pytest.mark.parametrize(
    ("codes", "expected"),
    [
        (["FEW_DISPARITIES", "EYES_DISAGREE", "SCREEN_MOVED"], "EYES_DISAGREE"),
        (["ROWS_DISAGREE", "NO_SCREEN"], "ROWS_DISAGREE"),
        (["ROWS_DISAGREE", "EYES_DISAGREE"], "EYES_DISAGREE"),
        (["NO_SCREEN", "TOO_DARK"], "TOO_DARK"),
        (["NO_SCREEN", "SCREEN_MOVED"], "SCREEN_MOVED"),
        (["UNPAIRED"], "UNPAIRED"),
    ],
)
def test_the_cause_comes_first(codes: list[str], expected: str) -> None:
    assert cause([reason(code) for code in codes])["code"] == expected


def test_ores_of_degraded_frames_are_not_in_the_sum() -> None:
    records = [
        {
            "status": status,
            "frame": status,
            "counts": {"ores": 3, "targets": 2},
            "reasons": [reason("TOO_DARK")],
        }
        for status in ("ok", "degraded", "failed", "empty", "ok")
    ]
    closing = Closing(records)
    assert (closing.totals["ores"], closing.totals["targets"], closing.totals["frames"]) == (
        9,
        6,
        5,
    )
    closing.check_usable()


# --- watched folders


def frames(source: FolderWatch, count: int) -> list[LiveFrame]:
    return list(islice(source.frames(Position(), threading.Event()), count))


def test_28_watch_padded_jpegs_do_not_wait(tmp_path: Path) -> None:
    save_pair(tmp_path, 0, suffix=".jpg")
    for path in tmp_path.iterdir():
        path.write_bytes(path.read_bytes() + bytes(900))
    start = time.monotonic()
    (frame,) = frames(FolderWatch(tmp_path, poll_s=0.01, patience_s=60), 1)
    assert time.monotonic() - start < 5
    assert frame.read().left.shape == (12, 16, 3)


def test_what_was_waited_for_in_vain_says_so(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    save_pair(tmp_path, 0)
    path = tmp_path / "left000000.png"
    path.write_bytes(path.read_bytes()[:-8])
    (frame,) = frames(FolderWatch(tmp_path, poll_s=0.01, patience_s=1.0), 1)
    assert "frame 000000 was not complete and did not change for 1 s" in caplog.text
    with pytest.raises(FrameError, match=r"its end marker is missing \(waited for 1 s\)"):
        frame.read()


def test_a_watched_frame_was_taken_when_it_arrived(tmp_path: Path) -> None:
    save_pair(tmp_path, 0, 10**9)
    save_pair(tmp_path, 1_700_000_000_000_000_001)
    watched = FolderWatch(tmp_path, poll_s=0.01).frames(Position(), threading.Event())
    first, second = (next(watched).read() for _ in range(2))
    assert (first.stamp_ns, first.stamp_source) == (10**9, "modification time")
    assert (second.stamp_ns, second.stamp_source) == (1_700_000_000_000_000_001, "file name")
    save_pair(tmp_path, 1)
    third = next(watched).read()
    assert third.stamp_source == "arrival"
    assert abs(third.stamp_ns - time.time_ns()) < 60 * 10**9


@pytest.mark.parametrize(("skew_s", "trust"), [(8, False), (-8, False), (8, True), (-8, True)])
def test_16_file_server_clock(
    skew_s: int,
    trust: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Times of files are 8 s off this machine's, either way: what seems old is old, unless times
    are not trusted."""
    now_ns = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: now_ns() + skew_s * 10**9)
    watch = FolderWatch(tmp_path, poll_s=0.01, trust_times=trust)
    stop, found = threading.Event(), []
    thread = threading.Thread(
        target=lambda: found.extend(islice(watch.frames(Position(), stop), 2))
    )
    thread.start()
    time.sleep(0.2)
    save_pair(tmp_path, 0)
    time.sleep(0.3)
    save_pair(tmp_path, 1)
    thread.join(10)
    stop.set()
    assert [0 <= frame.age_s < 5 for frame in found] == [not (trust and skew_s > 0)] * 2
    said = [
        entry.getMessage() for entry in caplog.records if "the clock of files" in entry.getMessage()
    ]
    assert len(said) == 1
    way = "behind" if skew_s > 0 else "ahead of"
    assert re.search(rf"is [78]\.\d s {way} this machine's", said[0])


@pytest.mark.parametrize(("skew_s", "fresh"), [(8, [False, False, True, True]), (32, [False] * 4)])
def test_a_clock_that_is_off_is_not_for_ever(
    skew_s: int, fresh: list[bool], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three frames alike late by seconds are another clock; half a minute is old files."""
    now_ns = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: now_ns() + skew_s * 10**9)
    watch = FolderWatch(tmp_path, poll_s=0.01)
    stop, found = threading.Event(), []
    thread = threading.Thread(
        target=lambda: found.extend(islice(watch.frames(Position(), stop), 4))
    )
    thread.start()
    for index in range(4):
        time.sleep(0.2)
        save_pair(tmp_path, index)
    thread.join(10)
    stop.set()
    assert [frame.age_s < 5 for frame in found] == fresh


def test_clocks_that_agree_are_no_news(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    watch, stop, found = FolderWatch(tmp_path, poll_s=0.01), threading.Event(), []
    thread = threading.Thread(
        target=lambda: found.extend(islice(watch.frames(Position(), stop), 1))
    )
    thread.start()
    time.sleep(0.2)
    save_pair(tmp_path, 0)
    thread.join(10)
    stop.set()
    assert len(found) == 1
    assert "the clock of files" not in caplog.text


def test_a_watched_image_of_one_eye_is_told(tmp_path: Path) -> None:
    save_pair(tmp_path, 0)
    (tmp_path / "left000000.png").rename(tmp_path / "frame.png")
    (tmp_path / "right000000.png").unlink()
    (frame,) = frames(FolderWatch(tmp_path, poll_s=0.01, eye_size=(16, 12)), 1)
    with pytest.raises(FrameError, match="these are images of one eye"):
        frame.read()
