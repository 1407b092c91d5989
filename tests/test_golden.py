"""No result changes unasked: records, tables, clouds, overlays and stages have the bytes of
golden.json."""

import json
from pathlib import Path

import golden
import pytest


@pytest.fixture(scope="module")
def parent(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("golden")


@pytest.fixture(scope="module")
def stored() -> dict[str, dict[str, golden.Hashes]]:
    document: dict[str, dict[str, golden.Hashes]] = json.loads(
        golden.FILE.read_text(encoding="utf-8")
    )
    if document["environment"] != golden.environment():
        pytest.skip(f"hashes are of {document['environment']}, this is {golden.environment()}")
    return document


def scene(name: str, parent: Path, stored: dict[str, dict[str, golden.Hashes]]) -> Path:
    folder = golden.scene(name, parent)
    if golden.pictures(folder) != stored["pictures"][name]:
        assert name not in golden.RECORDED
        pytest.skip(f"{name} is rendered otherwise on this processor")
    return folder


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("name", golden.SCENES)
def test_a_scene_gives_the_same_bytes(
    name: str,
    count: int,
    parent: Path,
    stored: dict[str, dict[str, golden.Hashes]],
    tmp_path: Path,
) -> None:
    folder = scene(name, parent, stored)
    with golden.threads(count):
        assert golden.run(folder, folder, tmp_path / "out") == stored["hashes"][name]


@pytest.mark.parametrize("workers", ["1", "2"])
def test_a_recording_gives_the_same_bytes(
    workers: str, parent: Path, stored: dict[str, dict[str, golden.Hashes]], tmp_path: Path
) -> None:
    folder = scene("paper", parent, stored)
    source = golden.recording(folder, tmp_path / "recording")
    found = golden.run(source, folder, tmp_path / "out", "--workers", workers)
    assert found == stored["hashes"]["recording"]
