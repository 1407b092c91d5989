"""The network of lumps that a run uses: chosen by folder, refused by name, told in run.json."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from stereo_ore.cli import app, load_verbs
from stereo_ore.errors import ConfigError
from stereo_ore.stages import segment
from stereo_ore.stages.segment import model

MODELS = Path(model.__file__).parents[2] / "models"
SCENE = Path(__file__).parents[1] / "data" / "paper_03"


def run(out: Path, *options: str, verb: str = "run") -> object:
    load_verbs()
    rig = ("--calib", str(SCENE / "calibration.yaml"), "--site", str(SCENE / "site.yaml"))
    files = ("--no-clouds", "--no-overlays", *(["--no-report"] if verb == "run" else []))
    return CliRunner().invoke(app, [verb, str(SCENE), *rig, "--out", str(out), *files, *options])


def test_a_run_tells_which_network_it_used_and_another_folder_is_another_run(tmp_path: Path):
    shipped = segment.load_lump_model()
    assert run(tmp_path / "a").exit_code == 0
    told = json.loads((tmp_path / "a" / "run.json").read_text())
    assert told["models"] == {"lumps": {"sha256": shipped.card.sha256}}
    model.write(tmp_path / "mine", shipped.onnx, {})
    assert run(tmp_path / "b", "--models", str(tmp_path / "mine")).exit_code == 0
    found = [json.loads((tmp_path / n / "frames.jsonl").read_text()) for n in "ab"]
    assert found[0]["counts"]["ores"] > 2
    assert found[0]["counts"]["voxels"] == found[1]["counts"]["voxels"]
    again = run(tmp_path / "a", "--resume", "--models", str(tmp_path / "mine"))
    assert isinstance(again.exception, ConfigError) or again.exit_code == 1


def test_the_layer_of_small_networks_is_what_it_says():
    onnx = pytest.importorskip("onnx")
    graph = onnx.load(str(MODELS / "hidden_layer.onnx")).graph
    steps = [(node.op_type, *node.input, *node.output) for node in graph.node]
    assert steps == [
        ("MatMul", "w", "x", "a"),
        ("Add", "a", "b", "c"),
        ("Relu", "c", "d"),
        ("MatMul", "v", "d", "y"),
    ]
    assert [each.name for each in graph.input] == ["x", "w", "b", "v"]


@pytest.mark.parametrize("verb", ["run", "serve"])
def test_a_folder_without_a_network_ends_the_run_before_the_first_frame(tmp_path: Path, verb: str):
    done = run(tmp_path / "out", "--models", str(tmp_path), verb=verb)
    assert isinstance(done.exception, ConfigError)
    assert done.exception.key == "models.lumps"
    assert not (tmp_path / "out").exists()
