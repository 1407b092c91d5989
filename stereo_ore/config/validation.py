"""Models' faults in words: every key at once, with what is allowed and the nearest valid name."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError

from stereo_ore.errors import StereoOreError

_Model = TypeVar("_Model", bound=BaseModel)
SECRETS = frozenset(("users", "password"))
"""Keys whose value an error does not repeat: where it is wrong, it may be a password in the wrong
place."""


def validate(
    model: type[_Model], data: Any, file: str | Path, error: type[StereoOreError]
) -> _Model:
    """Parse `data` as `model`, or raise `error` with all faults, a line each where there are
    several.
    """
    try:
        return model.model_validate(data)
    except ValidationError as fault:
        lines = [
            _describe(item, model).replace("\n", "\\n") for item in fault.errors(include_url=False)
        ]
        text = lines[0] if len(lines) == 1 else f"{len(lines)} faults:\n  " + "\n  ".join(lines)
        raise error(text, file=file) from None


def _describe(item: Any, model: type[BaseModel]) -> str:
    key = ".".join(str(part) for part in item["loc"])
    if item["type"] != "extra_forbidden":
        hidden = item["type"] == "missing" or not SECRETS.isdisjoint(item["loc"])
        shown = "" if hidden else f" (given: {item['input']!r:.80})"
        too_long = key.endswith("_m") and item["type"] in ("less_than_equal", "less_than")
        return f"{key}: {item['msg']}{shown}{'; millimetres given for metres?' if too_long else ''}"
    near = nearest_word(str(item["loc"][-1]), _keys_at(model, item["loc"][:-1]))
    return f"{key}: unknown key{near}"


def nearest_word(name: str, valid: Iterable[str]) -> str:
    """A hint ``; did you mean …?`` or the list of valid names, for an error text."""
    names = sorted(valid)
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    return f"; did you mean {close[0]}?" if close else f"; valid: {', '.join(names)}"


def _keys_at(model: type[BaseModel], location: Sequence[Any]) -> list[str]:
    for part in location:
        field = model.model_fields.get(str(part))
        kinds = (field.annotation, *get_args(field.annotation)) if field else ()
        inner = next(
            (kind for kind in kinds if isinstance(kind, type) and issubclass(kind, BaseModel)), None
        )
        if inner is None:
            return list(model.model_fields)
        model = inner
    return list(model.model_fields)
