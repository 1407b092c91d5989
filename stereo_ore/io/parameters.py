"""Parameters in and out: YAML files, ``--set a.b=v``, the resolved dump."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel

from stereo_ore.config import Config
from stereo_ore.config.validation import validate
from stereo_ore.errors import ConfigError
from stereo_ore.io.yaml_io import load_yaml, parse_yaml


def load_config(path: Path | None = None, settings: Sequence[str] = ()) -> Config:
    """Defaults, overlaid by a file, overlaid by ``key.sub=value`` settings.

    Raises
    ------
    ConfigError
        Naming every fault of the file at once: key, value, what is allowed, and the nearest valid
        key.
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


def dump_config(config: Config, comments: bool = False) -> str:
    """YAML text that `load_config` reads back to the same configuration; comments give meaning,
    unit and range.
    """
    if not comments:
        return yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False, allow_unicode=True)
    lines: list[str] = []
    for name, field in Config.model_fields.items():
        section: BaseModel = getattr(config, name)
        doc = (type(section).__doc__ or "").splitlines()[0]
        values = section.model_dump(mode="json")
        lines += [f"# {field.description or doc}", f"{name}:" if values else f"{name}: {{}}"]
        for key, value in values.items():
            text = (
                yaml.safe_dump(value, default_flow_style=True, allow_unicode=True)
                .removesuffix("...\n")
                .strip()
            )
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
