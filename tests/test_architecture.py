"""Rules of the design that a reader relies on, checked on the code's own imports."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "stereo_ore"
STAGES = (
    "rectify",
    "matching",
    "cloud",
    "voxels",
    "surroundings",
    "filters",
    "grizzly",
    "segment",
    "solid",
    "strike",
    "order",
)
SHARED = ("types", "config", "errors", "transforms", "planes", "threads", "network")
HEAVY = ("open3d", "sklearn", "matplotlib", "plotly", "scipy.spatial", "pydantic", "cv2", "numpy")


def stage_files(stage: str) -> list[Path]:
    single = PACKAGE / f"{stage}.py"
    return [single] if single.exists() else sorted((PACKAGE / stage).rglob("*.py"))


def imported_parts(file: Path) -> set[str]:
    """Parts of this package that a file imports, as the first name below ``stereo_ore``."""
    parts = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: relative import"
            module = node.module or ""
            names = [f"{module}.{alias.name}" if module == "stereo_ore" else module for alias in node.names]
        else:
            continue
        parts |= {name.split(".")[1] for name in names if name.startswith("stereo_ore.")}
    return parts


def forbidden_imports(file: Path, stage: str) -> set[str]:
    return imported_parts(file) - {*SHARED, stage}


@pytest.mark.parametrize("stage", STAGES)
def test_a_stage_imports_only_types_config_errors_and_transforms(stage: str) -> None:
    files = stage_files(stage)
    assert files, f"stage {stage} is gone: update STAGES"
    assert {str(file): found for file in files if (found := forbidden_imports(file, stage))} == {}


def test_the_rule_sees_a_stage_that_imports_another(tmp_path: Path) -> None:
    bad = tmp_path / "strike.py"
    bad.write_text(
        "from stereo_ore.stages.solid import solids\nfrom stereo_ore import cloud\nimport stereo_ore.plant.sinks.files\n"
    )
    assert forbidden_imports(bad, "strike") == {"solid", "cloud", "sinks"}


def test_only_the_command_line_exits_and_prints() -> None:
    offenders = []
    for file in PACKAGE.rglob("*.py"):
        if "cli" in file.relative_to(PACKAGE).parts:
            continue
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func) in ("print", "sys.exit", "exit"):
                offenders.append(f"{file.name}:{node.lineno}")
    assert offenders == []


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys; from stereo_ore import cli; cli.load_verbs();"
        f"print([name for name in {HEAVY!r} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
