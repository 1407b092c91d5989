"""Configuration: files, settings, all faults at once, and the resolved dump."""

from pathlib import Path

import pytest

from stereo_ore.config import Config
from stereo_ore.errors import ConfigError
from stereo_ore.io.parameters import dump_config, load_config


def write(folder: Path, text: str) -> Path:
    path = folder / "parameters.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_defaults_without_any_file() -> None:
    assert load_config() == Config()


def test_a_setting_wins_over_the_file(tmp_path: Path) -> None:
    path = write(tmp_path, "strike: {alternates: 1, tool_diameter_m: 0.06}\n")
    config = load_config(path, ["strike.alternates=2"])
    assert (config.strike.alternates, config.strike.tool_diameter_m) == (2, 0.06)


@pytest.mark.parametrize("comments", [True, False])
def test_the_dump_reads_back_to_the_same(tmp_path: Path, comments: bool) -> None:
    config = load_config(None, ["voxel.size_m=0.007", "filter.method=statistical"])
    assert load_config(write(tmp_path, dump_config(config, comments))) == config


def test_the_commented_dump_explains_every_parameter() -> None:
    lines = [
        line for line in dump_config(Config(), comments=True).splitlines() if line.startswith("  ")
    ]
    assert len(lines) == sum(
        len(getattr(Config(), name).model_dump()) for name in Config.model_fields
    )
    assert [line for line in lines if len(line.partition("  # ")[2]) < 8] == []


def test_all_faults_of_a_file_are_listed_at_once(tmp_path: Path) -> None:
    path = write(tmp_path, "matching: {p1: -3, blok_size: 5}\nvoxl: {}\n")
    with pytest.raises(ConfigError) as error:
        load_config(path)
    text = str(error.value)
    assert str(path) in text
    assert "matching.p1" in text
    assert "-3" in text
    assert "did you mean block_size?" in text
    assert "did you mean voxel?" in text


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("strike: {tool_diameter_m: .nan}", "strike.tool_diameter_m"),
        ("strike: {tool_diameter_m: 1e400}", "strike.tool_diameter_m"),
        ("strike: {tool_diameter_m: four}", "four"),
        ("strike: 3", "strike"),
        ("- 1", "mapping"),
        ("", "mapping"),
        ("strike: {alternates: 1}\nstrike: {}", "given twice"),
        ("a: &x [1]\nb: *x", "alias"),
        ("strike: !!python/object:os.system {}", "tag"),
        ("strike: {", "line 1"),
    ],
)
def test_what_is_no_configuration_is_a_config_error(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        load_config(write(tmp_path, text))


@pytest.mark.parametrize(
    "setting",
    ["strike", "=3", "strike.=3", "strike.tool_diameter_m.x=3", "strike.alternates=[", "a=b"],
)
def test_a_malformed_setting_is_a_config_error(setting: str) -> None:
    with pytest.raises(ConfigError, match="--set"):
        load_config(None, [setting])


LENGTHS = {
    "cloud.max_depth_m": 20.0,
    "voxel.size_m": 0.007,
    "grizzly.distance_m": 0.01,
    "segment.min_size_m": 0.04,
    "segment.default_opening_m": 0.3,
    "strike.tool_diameter_m": 0.04,
    "strike.clearance_m": 0.005,
    "strike.max_roughness_m": 0.006,
}
"""Usual values [m]."""


def test_the_lengths_of_these_tests_are_all_there_are() -> None:
    config = Config()
    found = {
        f"{stage}.{name}"
        for stage in type(config).model_fields
        for name in getattr(type(getattr(config, stage)), "model_fields", {})
        if name.endswith("_m")
    }
    assert found == LENGTHS.keys()


@pytest.mark.parametrize("key", LENGTHS)
def test_a_length_in_millimetres_is_asked_about(key: str) -> None:
    assert load_config(None, [f"{key}={LENGTHS[key]}"])
    with pytest.raises(ConfigError, match=rf"{key}: .*millimetres given for metres\?"):
        load_config(None, [f"{key}={1000 * LENGTHS[key]}"])
    for wrong in ("-0.01", ".nan", ".inf"):
        with pytest.raises(ConfigError, match=key):
            load_config(None, [f"{key}={wrong}"])


def test_a_missing_file_names_itself(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"absent\.yaml: no such file"):
        load_config(tmp_path / "absent.yaml")


def test_a_folder_is_no_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="can't be read"):
        load_config(tmp_path)


def test_a_huge_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="bytes"):
        load_config(write(tmp_path, "#" * 5_000_000))


def test_bytes_that_are_no_text_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "parameters.yaml"
    path.write_bytes(b"\xff\xfe\x00strike")
    with pytest.raises(ConfigError, match="text"):
        load_config(path)
