"""No result changes unasked: records, tables, clouds, overlays and stages have the bytes of golden.json."""

import json
from pathlib import Path

import golden
import pytest


@pytest.fixture(scope="module")
def parent(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("golden")


@pytest.fixture(scope="module")
def expected() -> dict[str, golden.Hashes]:
    stored = json.loads(golden.FILE.read_text(encoding="utf-8"))
    if stored["environment"] != golden.environment():
        pytest.skip(f"hashes are of {stored['environment']}, this is {golden.environment()}")
    hashes: dict[str, golden.Hashes] = stored["hashes"]
    return hashes


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("name", golden.SCENES)
def test_a_scene_gives_the_same_bytes(
    name: str, count: int, parent: Path, expected: dict[str, golden.Hashes], tmp_path: Path
) -> None:
    folder = golden.scene(name, parent)
    with golden.threads(count):
        assert golden.run(folder, folder, tmp_path / "out") == expected[name]


@pytest.mark.parametrize("workers", ["1", "2"])
def test_a_recording_gives_the_same_bytes(
    workers: str, parent: Path, expected: dict[str, golden.Hashes], tmp_path: Path
) -> None:
    folder = golden.scene("paper", parent)
    source = golden.recording(folder, tmp_path / "recording")
    assert golden.run(source, folder, tmp_path / "out", "--workers", workers) == expected["recording"]
