"""Every parser against damaged files: its corpus again, and new damage by hypothesis. `campaign.py`
looks for more."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from parsers import CORPUS, PARSERS

from stereo_ore.errors import SourceError
from stereo_ore.io.record_check import KEYWORDS, record_fault
from stereo_ore.io.results import Results, parse_record
from stereo_ore.record import record, to_line
from stereo_ore.types import FrameResult, Grizzly, Plane, Reason, Site

SCHEMA = json.loads(
    (Path(__file__).parents[2] / "stereo_ore" / "schema" / "frame-2.json").read_text()
)
VALIDATOR = jsonschema.Draft202012Validator(SCHEMA)
SLOW = {"db3": 40, "mcap": 40, "rosbag1": 40, "video": 40, "svo2": 40, "foxglove": 40}
"""Examples for parsers whose libraries take their time."""

VALID = {
    name: sorted(file for file in (CORPUS / name).iterdir() if file.suffix or file.name == "users")
    for name in PARSERS
}
"""Files to begin from; what fuzzing added has no suffix."""

settings.register_profile("fuzz", deadline=None, suppress_health_check=list(HealthCheck))
settings.load_profile("fuzz")


@pytest.mark.parametrize("name", PARSERS)
def test_corpus(name: str, tmp_path: Path) -> None:
    files = sorted((CORPUS / name).iterdir())
    assert files
    for file in files:
        PARSERS[name](file.read_bytes(), tmp_path)


@pytest.mark.parametrize("name", PARSERS)
def test_the_files_to_begin_from_are_read(name: str, tmp_path: Path) -> None:
    assert VALID[name]
    for file in VALID[name]:
        assert PARSERS[name](file.read_bytes(), tmp_path) is None, file


def test_the_corpus_is_small() -> None:
    assert sum(file.stat().st_size for file in CORPUS.rglob("*") if file.is_file()) < 1_000_000


def mutated(data: bytes) -> st.SearchStrategy[bytes]:
    """The file with up to four cuts, doublings, overwritten bytes or numbers."""
    place = st.integers(0, max(len(data) - 1, 0))
    word = st.sampled_from(
        (b"0", b"-1", b"nan", b"1e400", b"9" * 30, b"\xff" * 8, b"\0" * 8, b"[" * 99, b"\n", b'"')
    )
    edit = st.tuples(place, st.integers(0, 40), st.one_of(st.binary(max_size=12), word))

    def apply(edits: list[tuple[int, int, bytes]]) -> bytes:
        changed = data
        for start, length, new in edits:
            changed = changed[:start] + new + changed[start + length :]
        return changed

    return st.lists(edit, min_size=1, max_size=4).map(apply)


@pytest.mark.parametrize("name", PARSERS)
def test_damaged_files_are_read_or_refused(name: str, tmp_path: Path) -> None:
    seeds = [file.read_bytes() for file in VALID[name]]

    @settings(max_examples=SLOW.get(name, 200))
    @given(st.one_of(*map(mutated, seeds), st.binary(max_size=200)))
    def check(data: bytes) -> None:
        PARSERS[name](data, tmp_path)

    check()


# --- the record: what is made from any result is read back, and only that

numbers = st.floats(allow_nan=True, allow_infinity=True)
texts = st.text(max_size=30)
results = st.builds(
    FrameResult,
    name=st.from_regex(r"[A-Za-z0-9_][\w.-]{0,20}", fullmatch=True).filter(str.isascii),
    index=st.integers(0, 2**31),
    stamp_ns=st.none() | st.integers(0, 2**63 - 1),
    status=st.sampled_from(("ok", "degraded", "empty", "failed")),
    reasons=st.lists(
        st.builds(Reason, st.sampled_from(("UNPAIRED", "NO_ORE")), texts), max_size=3
    ).map(tuple),
    counts=st.just(dict.fromkeys(SCHEMA["properties"]["counts"]["required"], 3)),
    grizzly=st.none() | st.just(Grizzly(Plane(np.array([0.0, 0.0, -1.0]), -1.0), "auto", None)),
)


@given(results)
def test_a_record_of_any_result_is_read_back(result: FrameResult) -> None:
    line = to_line(record(result, Site()))
    VALIDATOR.validate(json.loads(line))
    assert parse_record(line, Path("frames.jsonl"), 1) == json.loads(line)
    assert len(line.encode("utf-8", "backslashreplace").split(b"\n")) == 1


def values() -> st.SearchStrategy[Any]:
    leaf = st.none() | st.booleans() | st.integers() | numbers | texts | st.just(10**400)
    return st.recursive(
        leaf,
        lambda v: st.lists(v, max_size=3) | st.dictionaries(texts, v, max_size=3),
        max_leaves=5,
    )


def places(value: Any, way: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Ways to every part of a JSON value."""
    inner: Any = (
        value.items()
        if isinstance(value, dict)
        else enumerate(value)
        if isinstance(value, list)
        else ()
    )
    return [way, *(place for key, part in inner for place in places(part, (*way, key)))]


def change(value: Any, way: tuple[Any, ...], edit: Callable[[Any, Any], None]) -> Any:
    """A copy in which `edit` was done on the container at the end of the way."""
    copy = json.loads(json.dumps(value))
    inner = copy
    for key in way[:-1]:
        inner = inner[key]
    edit(inner, way[-1])
    return copy


@settings(max_examples=300)
@given(st.data())
def test_a_changed_record_is_refused_where_the_schema_refuses_it(data: st.DataObject) -> None:
    good = json.loads((CORPUS / "records" / "two.jsonl").read_text())
    way = data.draw(st.sampled_from(places(good)[1:]))
    new = data.draw(values())

    def put(inner: Any, key: Any) -> None:
        inner[key] = new

    changed = change(
        good, way, put if data.draw(st.booleans()) else lambda inner, key: inner.pop(key)
    )
    ours, theirs = record_fault(changed), VALIDATOR.is_valid(changed)
    if ours is None:
        assert theirs
    elif theirs:
        # Stricter in three things: whole numbers are integers of 64 bit, numbers finite, names
        # those of files.
        assert way == ("frame",) or isinstance(new, int | float)


def test_no_keyword_of_the_schema_is_passed_over() -> None:
    known = {
        *KEYWORDS,
        "$ref",
        "$defs",
        "$schema",
        "$id",
        "title",
        "description",
        "required",
        "additionalProperties",
    }

    def keywords(schema: Any) -> set[str]:
        if isinstance(schema, list):
            return set().union(*map(keywords, schema))
        if not isinstance(schema, dict):
            return set()
        named = [*schema.get("properties", {}).values(), *schema.get("$defs", {}).values()]
        rest = [
            part
            for key, part in schema.items()
            if key not in ("properties", "$defs", "const", "enum")
        ]
        return set(schema).union(*map(keywords, [*named, *rest]))

    assert keywords(SCHEMA) <= known


def test_records_of_earlier_versions_are_still_read() -> None:
    for name in ("one", "two"):
        assert record_fault(json.loads((CORPUS / "records" / f"{name}.jsonl").read_text())) is None


@pytest.mark.parametrize("name", ["../x", "a/b", ".hidden", "", "a\nb", "x" * 300, "a\0"])
def test_a_record_whose_frame_leads_elsewhere_is_refused(name: str, tmp_path: Path) -> None:
    line = json.loads((CORPUS / "records" / "one.jsonl").read_text()) | {"frame": name}
    (tmp_path / "frames.jsonl").write_text(json.dumps(line) + "\n")
    with pytest.raises(SourceError, match="frame"):
        assert Results(tmp_path).records
