"""Whether a JSON value is a record, by the JSON Schema that ships with the package: read is only
what was written.

The schema is turned into nested functions once; a record of ten ores then takes a fraction of a
millisecond.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping
from functools import lru_cache
from importlib.resources import files
from typing import Any

Check = Callable[[Any], str | None]
"""What is wrong with a value, with the way to it; None when nothing is."""

LARGEST_INTEGER = 2**63
FRAME_NAME = re.compile(r"(?!\.)[\w.-]{1,200}", re.ASCII)
"""Names of frames are names of files: a foreign record must not lead out of the run's folder."""

_TYPES: Mapping[str, Callable[[Any], bool]] = {
    "object": lambda value: isinstance(value, dict),
    "array": lambda value: isinstance(value, list),
    "string": lambda value: isinstance(value, str),
    "boolean": lambda value: isinstance(value, bool),
    "null": lambda value: value is None,
    "integer": lambda value: type(value) is int and abs(value) < LARGEST_INTEGER,
    "number": lambda value: type(value) in (int, float) and abs(value) < math.inf,
}


NEWEST = "frame-2.json"
SCHEMAS = {"stereo_ore/frame/1": "frame-1.json", "stereo_ore/frame/2": NEWEST}
"""What is written today, and what was written before: runs stay readable."""


def record_fault(value: Any) -> str | None:
    """Why a JSON value is no record of a frame; None when it is one."""
    name = value.get("schema") if isinstance(value, dict) else None
    fault = _record_check(SCHEMAS.get(name if isinstance(name, str) else "", NEWEST))(value)
    if fault is None and not FRAME_NAME.fullmatch(value["frame"]):
        return "frame: is no name of a file"
    return fault


@lru_cache
def _record_check(file: str) -> Check:
    text = (files("stereo_ore") / "schema" / file).read_text(encoding="utf-8")
    schema = json.loads(text)
    return _compile(schema, schema["$defs"])


def _compile(schema: Mapping[str, Any], definitions: Mapping[str, Any]) -> Check:
    """The check of a schema: the first fault of its keywords."""
    if "$ref" in schema:
        return _compile(definitions[schema["$ref"].removeprefix("#/$defs/")], definitions)
    checks = [make(schema, definitions) for keyword, make in KEYWORDS.items() if keyword in schema]

    def check(value: Any) -> str | None:
        for each in checks:
            if fault := each(value):
                return fault
        return None

    return check


def _simple(
    holds: Callable[[Any, Any], bool], keyword: str
) -> Callable[[Mapping[str, Any], Any], Check]:
    """Maker of the check of a keyword that looks at the value alone."""

    def make(schema: Mapping[str, Any], _: Mapping[str, Any]) -> Check:
        limit = schema[keyword]
        return lambda value: (
            None if holds(value, limit) else f": {keyword} {limit!r:.80} does not hold"
        )

    return make


def _any_of(schema: Mapping[str, Any], definitions: Mapping[str, Any]) -> Check:
    choices = [_compile(choice, definitions) for choice in schema["anyOf"]]

    def check(value: Any) -> str | None:
        faults = [choice(value) for choice in choices]
        return None if None in faults else faults[0]

    return check


def _properties(schema: Mapping[str, Any], definitions: Mapping[str, Any]) -> Check:
    checks = {key: _compile(part, definitions) for key, part in schema["properties"].items()}
    required = frozenset(schema["required"])

    def check(value: Any) -> str | None:
        if missing := required - value.keys():
            return f"{min(missing)}: is missing"
        for key, part in value.items():
            if key not in checks:
                return f"{key[:40]}: is unknown"
            if fault := checks[key](part):
                return f"{key}{'' if fault.startswith(':') else '.'}{fault}"
        return None

    return check


def _items(schema: Mapping[str, Any], definitions: Mapping[str, Any]) -> Check:
    each = _compile(schema["items"], definitions)

    def check(value: Any) -> str | None:
        for place, item in enumerate(value):
            if fault := each(item):
                return f"{place}{'' if fault.startswith(':') else '.'}{fault}"
        return None

    return check


KEYWORDS: Mapping[str, Callable[[Mapping[str, Any], Mapping[str, Any]], Check]] = {
    "type": _simple(lambda value, name: _TYPES[name](value), "type"),
    "const": _simple(lambda value, wanted: bool(value == wanted), "const"),
    "enum": _simple(lambda value, allowed: value in allowed, "enum"),
    "anyOf": _any_of,
    "minimum": _simple(lambda value, limit: bool(value >= limit), "minimum"),
    "maximum": _simple(lambda value, limit: bool(value <= limit), "maximum"),
    "minLength": _simple(lambda value, limit: len(value) >= limit, "minLength"),
    "pattern": _simple(lambda value, pattern: re.search(pattern, value) is not None, "pattern"),
    "minItems": _simple(lambda value, limit: len(value) >= limit, "minItems"),
    "maxItems": _simple(lambda value, limit: len(value) <= limit, "maxItems"),
    "items": _items,
    "uniqueItems": _simple(lambda value, _: len(set(value)) == len(value), "uniqueItems"),
    "properties": _properties,
}
"""Keywords of JSON Schema that the records' schema uses, in the order in which they can be relied
on."""
