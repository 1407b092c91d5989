"""Configuration in and out: YAML files, ``--set a.b=v``, the resolved dump, the schema."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, TypeVar, get_args

import yaml
from pydantic import BaseModel, ValidationError

from stereo_ore.config.models import Config
from stereo_ore.errors import ConfigError, StereoOreError
from stereo_ore.io.yaml_io import load_yaml, parse_yaml

Model = TypeVar("Model", bound=BaseModel)
SECRETS = frozenset(("users", "password"))
"""Keys whose value an error does not repeat: where it is wrong, it may be a password in the wrong place."""


def load_config(path: Path | None = None, settings: Sequence[str] = ()) -> Config:
    """Defaults, overlaid by a file, overlaid by ``key.sub=value`` settings.

    Raises
    ------
    ConfigError
        Naming every fault of the file at once: key, value, what is allowed, and the nearest valid key.
    """
    data: dict[str, Any] = load_yaml(path, ConfigError) if path else {}
    for setting in settings:
        _apply_setting(data, setting)
    return validate(Config, data, path or "--set", ConfigError)


def _apply_setting(data: dict[str, Any], setting: str) -> None:
    key, equals, text = setting.partition("=")
    if not equals or not all(key.split(".")):
        raise ConfigError(f"{setting!r} is not of the form key.sub=value", file="--set")
    value = parse_yaml(f"value: {text}", Path("--set"), ConfigError)["value"]
    *parents, leaf = key.split(".")
    for parent in parents:
        data = data.setdefault(parent, {})
        if not isinstance(data, dict):
            raise ConfigError(f"{parent} is not a section", file="--set", key=key)
    data[leaf] = value


def validate(model: type[Model], data: Any, file: str | Path, error: type[StereoOreError]) -> Model:
    """Parse `data` as `model`, or raise `error` with all faults, a line each where there are several."""
    try:
        return model.model_validate(data)
    except ValidationError as fault:
        lines = [_describe(item, model).replace("\n", "\\n") for item in fault.errors(include_url=False)]
        text = lines[0] if len(lines) == 1 else f"{len(lines)} faults:\n  " + "\n  ".join(lines)
        raise error(text, file=file) from None


def _describe(item: Any, model: type[BaseModel]) -> str:
    key = ".".join(str(part) for part in item["loc"])
    if item["type"] != "extra_forbidden":
        hidden = item["type"] == "missing" or not SECRETS.isdisjoint(item["loc"])
        shown = "" if hidden else f" (given: {item['input']!r:.80})"
        too_long = key.endswith("_m") and item["type"] in ("less_than_equal", "less_than")
        return f"{key}: {item['msg']}{shown}{'; millimetres given for metres?' if too_long else ''}"
    near = nearest(str(item["loc"][-1]), _keys_at(model, item["loc"][:-1]))
    return f"{key}: unknown key{near}"


def nearest(name: str, valid: Iterable[str]) -> str:
    """A hint ``; did you mean …?`` or the list of valid names, for an error text."""
    names = sorted(valid)
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    return f"; did you mean {close[0]}?" if close else f"; valid: {', '.join(names)}"


def _keys_at(model: type[BaseModel], location: Sequence[Any]) -> list[str]:
    for part in location:
        field = model.model_fields.get(str(part))
        kinds = (field.annotation, *get_args(field.annotation)) if field else ()
        inner = next((kind for kind in kinds if isinstance(kind, type) and issubclass(kind, BaseModel)), None)
        if inner is None:
            return list(model.model_fields)
        model = inner
    return list(model.model_fields)


def dump_config(config: Config, comments: bool = False) -> str:
    """YAML text that `load_config` reads back to the same configuration; comments give meaning, unit and range."""
    if not comments:
        return yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False, allow_unicode=True)
    lines: list[str] = []
    for name, field in Config.model_fields.items():
        section: BaseModel = getattr(config, name)
        doc = (type(section).__doc__ or "").splitlines()[0]
        values = section.model_dump(mode="json")
        lines += [f"# {field.description or doc}", f"{name}:" if values else f"{name}: {{}}"]
        for key, value in values.items():
            text = yaml.safe_dump(value, default_flow_style=True, allow_unicode=True).removesuffix("...\n").strip()
            lines.append(f"  {key}: {text}  # {_comment(type(section), key)}")
    return "\n".join(lines) + "\n"


def _comment(model: type[BaseModel], key: str) -> str:
    field = model.model_fields[key]
    extra = field.json_schema_extra if isinstance(field.json_schema_extra, dict) else {}
    unit = f" [{extra['unit']}]" if extra.get("unit") else ""
    limits = [f"{sign} {bound}" for sign, bound in _bounds(field.metadata)]
    return f"{field.description}{unit}{' (' + ', '.join(limits) + ')' if limits else ''}"


def _bounds(metadata: Iterable[Any]) -> Iterable[tuple[str, Any]]:
    for limit in metadata:
        for attribute, sign in (("ge", "≥"), ("gt", ">"), ("le", "≤"), ("lt", "<")):
            if (bound := getattr(limit, attribute, None)) is not None:
                yield sign, bound
