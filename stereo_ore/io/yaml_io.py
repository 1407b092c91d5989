"""Strict YAML: no aliases, no tags, no duplicate keys, finite numbers, bounded size."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from stereo_ore.errors import StereoOreError

MAX_BYTES = 1_000_000
"""A megabyte of YAML takes a quarter of a minute; files written by hand or by a camera have
kilobytes."""

_LONGEST_NUMBER = 400
"""Characters of a number; Python takes time that grows with their square."""


class _StrictLoader(yaml.SafeLoader):
    """SafeLoader that refuses what a hand-written file never needs and a hostile one uses."""

    flat_aliases = False

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent) and not (self.flat_aliases and self._is_flat()):
            event = self.peek_event()  # type: ignore[no-untyped-call,unused-ignore]
            raise yaml.MarkedYAMLError(
                None, None, "aliases (*name) are not allowed", event.start_mark
            )
        event = self.peek_event()  # type: ignore[no-untyped-call,unused-ignore]
        if getattr(event, "tag", None) is not None:
            raise yaml.MarkedYAMLError(
                None, None, f"tags ({event.tag[:40]!r}) are not allowed", event.start_mark
            )
        return super().compose_node(parent, index)  # type: ignore[no-untyped-call,unused-ignore]

    def _is_flat(self) -> bool:
        """Whether the next alias stands for a scalar or a list of scalars, which can't grow."""
        event = self.peek_event()  # type: ignore[no-untyped-call,unused-ignore]
        node = self.anchors.get(event.anchor)
        parts = node.value if isinstance(node, yaml.SequenceNode) else [node]
        return all(isinstance(part, yaml.ScalarNode) for part in parts)

    def construct_scalar(self, node: Any) -> Any:
        if node.tag.endswith((":int", ":float")) and len(node.value) > _LONGEST_NUMBER:
            raise yaml.MarkedYAMLError(None, None, "a number has too many digits", node.start_mark)
        return super().construct_scalar(node)  # type: ignore[no-untyped-call,unused-ignore]

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        seen = set()
        for key_node, _ in node.value:
            key = key_node.value
            if isinstance(key, str) and key in seen:
                raise yaml.MarkedYAMLError(
                    None, None, f"key {key!r} is given twice", key_node.start_mark
                )
            if isinstance(key, str):
                seen.add(key)
        return super().construct_mapping(node, deep)


class _AliasLoader(_StrictLoader):
    """Takes aliases of numbers and of lists of numbers, as PyYAML writes them for a list that
    occurs twice.
    """

    flat_aliases = True


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
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise error("no such file", file=path, remedy="Check the path") from None
    except (OSError, ValueError) as fault:  # ValueError: a NUL in the name
        raise error(
            f"can't be read: {getattr(fault, 'strerror', None) or fault}", file=path
        ) from None
    return decode_text(data, path, error)


def decode_text(data: bytes, path: Path, error: type[StereoOreError]) -> str:
    """The text in the bytes of a file, one kind of line end; `error` when they are too many or no
    UTF-8.
    """
    if len(data) > MAX_BYTES:
        raise error(
            f"has more than {MAX_BYTES:,} bytes; no more are read",
            file=path,
            remedy="Is it the right file?",
        )
    try:
        return data.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError:
        raise error("is not a text file (UTF-8)", file=path, remedy="Save it as UTF-8") from None


def parse_yaml(
    text: str, path: Path, error: type[StereoOreError], aliases: bool = False
) -> dict[str, Any]:
    """The mapping in a YAML text; `path` is for messages, `aliases` allows those of numbers and
    lists of them.
    """
    try:
        data = yaml.load(text, Loader=_AliasLoader if aliases else _StrictLoader)
    except (yaml.YAMLError, ValueError, RecursionError) as fault:
        mark = getattr(fault, "problem_mark", None)
        line = f" (line {mark.line + 1})" if mark else ""
        problem = " ".join(
            (getattr(fault, "problem", None) or str(fault) or type(fault).__name__).split()
        )
        raise error(f"is not valid YAML{line}: {problem}", file=path) from None
    if not isinstance(data, dict):
        raise error(f"must hold a mapping, not {type(data).__name__}", file=path)
    return data
