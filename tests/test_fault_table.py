"""The table of faults in tests/README.md names tests that exist."""

import re
from pathlib import Path

TESTS = Path(__file__).parent
NAMED = re.compile(r"`(test_\w+\.py)::(test_\w+)`")


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
