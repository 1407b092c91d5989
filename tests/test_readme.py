"""What README and docs name exists: verbs, options, extras, links, words."""

import json
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import typer

from stereo_ore.cli import app, load_verbs
from stereo_ore.config import Config

ROOT = Path(__file__).parents[1]
GUIDES = (
    "README.md",
    "calib/README.md",
    *sorted(f"docs/{page.name}" for page in (ROOT / "docs").glob("*.md")),
)
WITH_COMMANDS = [
    guide for guide in GUIDES if "stereo-ore " in (ROOT / guide).read_text(encoding="utf-8")
]
PAGES = (*GUIDES, "CONTRIBUTING.md", "tests/README.md", "data/README.md", ".github/SECURITY.md")
COMMAND = re.compile(r"stereo-ore ((?!--)[a-z][^`\n#]*)")


def root() -> Any:
    load_verbs()
    return typer.main.get_command(app)


def commands(group: Any) -> dict[str, Any]:
    """Every command by its full name, such as "calibrate check"."""
    found = {}
    for name, command in group.commands.items():
        found[name] = command
        if hasattr(command, "commands"):
            found |= {f"{name} {sub}": entry for sub, entry in commands(command).items()}
    return found


def options(command: Any) -> set[str]:
    return {
        text
        for parameter in command.params
        for text in (*parameter.opts, *parameter.secondary_opts)
    } | {"--help"}


def named(guide: str) -> list[str]:
    return [line.strip() for line in COMMAND.findall((ROOT / guide).read_text(encoding="utf-8"))]


@pytest.mark.parametrize("guide", WITH_COMMANDS)
def test_every_command_shown_has_its_verb_and_options(guide: str) -> None:
    known, lines = commands(root()), named(guide)
    assert lines
    for line in lines:
        words = line.split()
        verb = " ".join(words[:2]) if " ".join(words[:2]) in known else words[0]
        assert verb in known, line
        given = {word.split("=")[0] for word in words if word.startswith("--")}
        assert given <= options(known[verb]), line


@pytest.mark.parametrize("guide", GUIDES)
def test_every_option_named_exists_somewhere(guide: str) -> None:
    # What other programs are given on lines of their own is not ours.
    others = r"^(?:dask|ros2|pip|python -m pip|useradd|systemctl|systemd-analyze|docker) .*"
    text = (ROOT / guide).read_text(encoding="utf-8")
    text = re.sub(others, "", text, flags=re.MULTILINE)
    known = options(root()).union(*(options(command) for command in commands(root()).values()))
    assert set(re.findall(r"(?<![\w-])--[a-z][a-z0-9-]*", text)) <= known | {
        "--strict",
        "--require-hashes",
    }


@pytest.mark.parametrize("page", PAGES)
def test_every_link_leads_somewhere(page: str) -> None:
    folder = (ROOT / page).parent
    links = re.findall(r"\]\(([^)#\s]+)", (ROOT / page).read_text(encoding="utf-8"))
    assert [link for link in links if "://" not in link and not (folder / link).exists()] == []


def test_the_readme_is_short() -> None:
    assert (ROOT / "README.md").stat().st_size <= 10_000


def record_keys(schema: Any) -> set[str]:
    """Names of all properties of a JSON schema."""
    if isinstance(schema, list):
        return set().union(*map(record_keys, schema))
    if not isinstance(schema, dict):
        return set()
    inner = [part for key, part in schema.items() if key not in ("const", "enum")]
    properties = schema.get("properties", {})
    return set(properties if isinstance(properties, dict) else ()).union(*map(record_keys, inner))


def test_the_glossary_has_the_words_of_records_and_parameters() -> None:
    schema = json.loads(
        (ROOT / "stereo_ore" / "schema" / "frame-2.json").read_text(encoding="utf-8")
    )
    text = (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8")
    words = set(re.findall(r"\w+", text))
    assert {
        key for key in record_keys(schema["$defs"]) | record_keys(schema) if key not in words
    } == set()
    assert {name for name in Config.model_fields if name not in words} == set()


def test_every_verb_is_in_the_table() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert [
        verb for verb in root().commands if not re.search(rf"`(?:stereo-ore )?{verb}\b", text)
    ] == []


def test_every_extra_is_in_the_table() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"][
        "optional-dependencies"
    ]
    table = text.partition("## Extras")[2].partition("\n## ")[0]
    assert [
        name for name in extras if name not in ("test", "dev") and f"`{name}`" not in table
    ] == []
