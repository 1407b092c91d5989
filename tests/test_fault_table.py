"""The table of faults in tests/README.md names all reason codes, and tests that exist."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

TESTS = Path(__file__).parent
NAMED = re.compile(r"`(test_\w+\.py)::(test_\w+)`")


def codes_of(tree: ast.AST) -> Iterator[str]:
    """The codes of reasons and of errors of a frame that a module makes."""
    for call in ast.walk(tree):
        if not isinstance(call, ast.Call):
            continue
        named = [keyword.value for keyword in call.keywords if keyword.arg == "code"]
        first = call.args[:1] if getattr(call.func, "id", "") == "Reason" else []
        for value in named + first:
            if isinstance(value, ast.Constant) and isinstance(value.value, str):
                yield value.value


def test_every_reason_code_has_a_row() -> None:
    assert list(codes_of(ast.parse('x(code="A", other=Reason("B", ""))'))) == ["A", "B"]
    package = TESTS.parent / "stereo_ore"
    files = [file for file in package.rglob("*.py") if "lab" not in file.parts]
    codes = {code for file in files for code in codes_of(ast.parse(file.read_text("utf-8")))}
    assert len(codes) > 30
    table = (TESTS / "README.md").read_text(encoding="utf-8")
    assert sorted(code for code in codes if not re.search(rf"\b{code}\b", table)) == []


def test_every_test_that_the_table_names_exists() -> None:
    named = NAMED.findall((TESTS / "README.md").read_text(encoding="utf-8"))
    assert len(named) > 50
    text = {
        file: (TESTS / file).read_text(encoding="utf-8") for file in {file for file, _ in named}
    }
    assert [f"{file}::{name}" for file, name in named if f"def {name}(" not in text[file]] == []


def test_every_row_of_the_table_names_a_test_or_admits_that_there_is_none() -> None:
    table = (TESTS / "README.md").read_text(encoding="utf-8").partition("\n## Fuzzing")[0]
    rows = [line for line in table.splitlines() if line.startswith("| ")]
    assert len(rows) > 35
    bare = [row for row in rows[1:] if not NAMED.search(row) and not row.endswith("| none |")]
    assert bare == []
