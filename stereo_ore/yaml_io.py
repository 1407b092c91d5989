"""Strict YAML: no aliases, no tags, no duplicate keys, finite numbers, bounded size."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from stereo_ore.errors import StereoOreError

MAX_BYTES = 4_000_000


class _StrictLoader(yaml.SafeLoader):
    """SafeLoader that refuses what a hand-written file never needs and a hostile one uses."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            event = self.peek_event()  # type: ignore[no-untyped-call,unused-ignore]
            raise yaml.MarkedYAMLError(None, None, "aliases (*name) are not allowed", event.start_mark)
        return super().compose_node(parent, index)  # type: ignore[no-untyped-call,unused-ignore]

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        seen = set()
        for key_node, _ in node.value:
            key = key_node.value
            if isinstance(key, str) and key in seen:
                raise yaml.MarkedYAMLError(None, None, f"key {key!r} is given twice", key_node.start_mark)
            if isinstance(key, str):
                seen.add(key)
        return super().construct_mapping(node, deep)


def load_yaml(path: Path, error: type[StereoOreError]) -> dict[str, Any]:
    """The mapping in a YAML file.

    Parameters
    ----------
    path : Path
        File to read.
    error : type
        Exception raised for anything that can't be used, naming file, line and remedy.
    """
    return parse_yaml(read_text(path, error), path, error)


def read_text(path: Path, error: type[StereoOreError]) -> str:
    """A text file of bounded size; `error` when it can't be read."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise error(f"has {path.stat().st_size:,} bytes; at most {MAX_BYTES:,} are read", file=path)
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise error("no such file", file=path, remedy="Check the path") from None
    except OSError as fault:
        raise error(f"can't be read: {fault.strerror}", file=path) from None
    except UnicodeDecodeError:
        raise error("is not a text file (UTF-8)", file=path) from None


def parse_yaml(text: str, path: Path, error: type[StereoOreError]) -> dict[str, Any]:
    """The mapping in a YAML text; `path` is for messages."""
    try:
        data = yaml.load(text, Loader=_StrictLoader)
    except (yaml.YAMLError, ValueError, RecursionError) as fault:
        mark = getattr(fault, "problem_mark", None)
        line = f" (line {mark.line + 1})" if mark else ""
        problem = getattr(fault, "problem", None) or str(fault) or type(fault).__name__
        raise error(f"is not valid YAML{line}: {problem}", file=path) from None
    if not isinstance(data, dict):
        raise error(f"must hold a mapping, not {type(data).__name__}", file=path)
    return data
