"""Rules of the design that a reader relies on, checked on the code's own imports."""

import ast
import subprocess
import sys
from pathlib import Path

import architecture
import pytest
from architecture import PACKAGE

STAGES = PACKAGE / "stages"
MORE_THAN_ONE = {"health": {"grizzly"}, "empty_screen": {"cloud", "grizzly", "matching"}}
"""Stages that are about others: the check of the screen looks for a plane as the grizzly does."""
HEAVY = ("open3d", "sklearn", "matplotlib", "plotly", "scipy.spatial", "pydantic", "cv2", "numpy")


def stage(module: str) -> str | None:
    parts = module.split(".")
    return parts[2] if parts[1:2] == ["stages"] and len(parts) > 2 else None


def stages_that_import_others(graph: architecture.Imports) -> list[str]:
    return [
        f"{module} imports {other}"
        for module, others in graph.items()
        for other in sorted(others)
        if (mine := stage(module))
        and (theirs := stage(other))
        and theirs not in {mine, *MORE_THAN_ONE.get(mine, ())}
    ]


@pytest.fixture(scope="module")
def graph() -> architecture.Imports:
    return architecture.imports()


def test_no_wing_imports_what_it_must_not_know(graph: architecture.Imports) -> None:
    assert architecture.breaches(graph) == []


def test_nothing_is_imported_in_a_circle(graph: architecture.Imports) -> None:
    assert architecture.circles(graph) == []


def test_no_stage_knows_another(graph: architecture.Imports) -> None:
    names = {file.stem for file in STAGES.iterdir() if not file.name.startswith("_")}
    assert {"matching", "filters", "strike"} <= names
    assert set(MORE_THAN_ONE) <= names
    assert stages_that_import_others(graph) == []


def planted(folder: Path, **files: str) -> architecture.Imports:
    """The graph of a package whose modules hold these lines; a dot in a name is two underscores."""
    for name, text in files.items():
        file = folder / "stereo_ore" / Path(*name.split("__")).with_suffix(".py")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    return architecture.imports(folder / "stereo_ore")


def test_each_rule_sees_a_breach(tmp_path: Path) -> None:
    found = planted(
        tmp_path,
        stages__strike="from stereo_ore.stages import cloud",
        stages__cloud="def f():\n    import stereo_ore.io.site",
        io__site="from stereo_ore.stages.cloud import f\nfrom stereo_ore.lab.synth import g",
        lab__synth="",
        cli__run="from stereo_ore.lab import synth",
        cli__bench="from stereo_ore.lab import synth",
    )
    assert stages_that_import_others(found) == [
        "stereo_ore.stages.strike imports stereo_ore.stages.cloud"
    ]
    assert architecture.circles(found) == [["stereo_ore.io.site", "stereo_ore.stages.cloud"]]
    assert architecture.breaches(found) == [
        "stereo_ore.cli.run, which is no verb of the laboratory, imports stereo_ore.lab.synth",
        "stereo_ore.io.site imports stereo_ore.lab.synth",
        "stereo_ore.stages.cloud imports stereo_ore.io.site",
    ]


def test_no_public_name_is_defined_twice(tmp_path: Path) -> None:
    """A word that a reader looks up leads to one place."""
    assert architecture.defined_twice() == {}
    planted(tmp_path, io__site="LIMIT = 1\n_OWN = 2", stages__cloud="class LIMIT: ...\n_OWN = 3")
    assert architecture.defined_twice(tmp_path / "stereo_ore") == {
        "LIMIT": ["stereo_ore.io.site", "stereo_ore.stages.cloud"]
    }


def test_only_the_command_line_exits_and_prints() -> None:
    offenders = []
    for file in PACKAGE.rglob("*.py"):
        if "cli" in file.relative_to(PACKAGE).parts:
            continue
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func) in (
                "print",
                "sys.exit",
                "exit",
            ):
                offenders.append(f"{file.name}:{node.lineno}")
    assert offenders == []


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys; from stereo_ore import cli; cli.load_verbs();"
        f"print([name for name in {HEAVY!r} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
