"""The folder of a run: whole files only, resumable after any tear, never another run's results."""

import errno
import json
from pathlib import Path

import pytest

from stereo_ore.cli import launch
from stereo_ore.errors import OutputError
from stereo_ore.io.atomic import write_bytes, write_text
from stereo_ore.runs.folder import LINES, FrameLines, RunFolder, digest

DESCRIPTION = {"schema": "stereo_ore/run/1", "source": "recording"}


def frame(index: int) -> FrameLines:
    record = {"frame": f"{index:06d}", "targets": [], "ores": []}
    return FrameLines(
        json.dumps(record), json.dumps({"frame": index}), json.dumps({"frame": index, "files": {}})
    )


def fill(folder: Path, indices: range, *, resume: bool = False, finish: bool = True) -> None:
    with RunFolder(folder, DESCRIPTION, resume=resume, overwrite=False) as run:
        for index in indices[run.done :]:
            run.add(frame(index))
        if finish:
            run.finish()


def test_an_unfinished_run_has_no_final_files(tmp_path: Path) -> None:
    fill(tmp_path, range(3), finish=False)
    assert not (tmp_path / "frames.jsonl").exists()
    assert len((tmp_path / "frames.jsonl.part").read_text().splitlines()) == 3


@pytest.mark.parametrize("cut", range(0, 260, 13))
@pytest.mark.parametrize("torn", LINES)
def test_a_run_torn_at_any_byte_of_any_file_resumes_to_the_same(
    tmp_path: Path, cut: int, torn: str
) -> None:
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    fill(whole, range(5))
    fill(killed, range(4), finish=False)
    part = killed / f"{torn}.part"
    part.write_bytes(part.read_bytes()[:cut])
    fill(killed, range(5), resume=True)
    for name in ("frames.jsonl", "timings.jsonl", "ores.csv", "run.json"):
        assert (killed / name).read_bytes() == (whole / name).read_bytes(), name
    assert not list(killed.glob("*.part"))


def test_resuming_a_finished_run_changes_nothing(tmp_path: Path) -> None:
    fill(tmp_path, range(3))
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    fill(tmp_path, range(3), resume=True)
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before


def test_what_a_killed_writer_left_goes(tmp_path: Path) -> None:
    fill(tmp_path, range(3), finish=False)
    (tmp_path / "clouds").mkdir()
    left = tmp_path / "clouds" / ".000002.ply.0badcafe.tmp"
    left.write_bytes(b"half")
    fill(tmp_path, range(3), resume=True)
    assert not left.exists()


@pytest.mark.parametrize("resume", [True, False])
def test_another_run_s_folder_is_left_alone(tmp_path: Path, resume: bool) -> None:
    fill(tmp_path, range(3))
    with pytest.raises(OutputError, match="--overwrite"):
        RunFolder(tmp_path, {**DESCRIPTION, "source": "other"}, resume=resume, overwrite=False)
    assert len((tmp_path / "frames.jsonl").read_text().splitlines()) == 3


def test_a_damaged_run_json_counts_as_another_run(tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text("[1")
    with pytest.raises(OutputError, match="other inputs"):
        RunFolder(tmp_path, DESCRIPTION, resume=False, overwrite=False)


def test_overwriting_removes_the_other_run_s_files_only(tmp_path: Path) -> None:
    fill(tmp_path, range(3))
    (tmp_path / "clouds").mkdir()
    (tmp_path / "clouds" / "old.ply").write_text("")
    (tmp_path / "notes.txt").write_text("mine")
    RunFolder(tmp_path, {**DESCRIPTION, "source": "other"}, resume=False, overwrite=True)
    assert sorted(file.name for file in tmp_path.rglob("*") if file.is_file()) == [
        "notes.txt",
        "run.json",
    ]


@pytest.mark.parametrize(
    "name", ["overlays", "clouds", "frames.jsonl", "frames.jsonl.part", "run.json"]
)
def test_a_link_in_the_folder_is_not_followed(name: str, tmp_path: Path) -> None:
    fill(tmp_path / "out", range(2))
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "000000.png").write_bytes(b"not ours")
    place = tmp_path / "out" / name
    place.unlink(missing_ok=True)
    place.symlink_to(foreign / "000000.png" if "." in name else foreign)
    with pytest.raises(OutputError, match=f"{name}.*link"):
        RunFolder(tmp_path / "out", {"other": 1}, resume=False, overwrite=True)
    assert (foreign / "000000.png").read_bytes() == b"not ours"


def test_the_folder_itself_may_be_a_link(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "out").symlink_to(tmp_path / "disk")
    fill(tmp_path / "out", range(2))
    assert (tmp_path / "disk" / "frames.jsonl").is_file()


def test_a_folder_that_holds_no_run_keeps_its_files(tmp_path: Path) -> None:
    (tmp_path / "clouds").mkdir()
    (tmp_path / "clouds" / "mine.ply").write_text("")
    RunFolder(tmp_path, DESCRIPTION, resume=False, overwrite=False)
    assert (tmp_path / "clouds" / "mine.ply").exists()


def test_the_digest_does_not_depend_on_the_order_of_keys() -> None:
    assert digest({"a": 1, "b": 2}) == digest({"b": 2, "a": 1}) != digest({"a": 2, "b": 1})


def test_a_full_disk_is_an_error_and_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "frames.jsonl"
    write_text(path, "old")

    def full(self: Path, data: bytes) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OutputError, match=r"frames\.jsonl.*No space left"):
        write_bytes(path, b"new")
    assert [file.name for file in tmp_path.iterdir()] == ["frames.jsonl"]
    assert path.read_text() == "old"


def test_a_file_where_a_folder_should_be_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("")
    with pytest.raises(OutputError, match="can't be written"):
        write_text(tmp_path / "out" / "run.json", "{}")


@pytest.mark.parametrize(
    "arguments",
    [["tune"], ["bench", "filter", "--out"], ["bench", "stereo", "data", "--out"]],
    ids=" ".join,
)
def test_a_folder_that_cannot_be_made_is_refused_before_the_work(
    arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(SystemExit) as stop:
        launch([*arguments, str(tmp_path / "file")])
    assert stop.value.code == 1
    assert "can't be written" in capsys.readouterr().err
