"""The page itself: template, style, script, plotly and data put into one file."""

from __future__ import annotations

import html
import json
import re
from collections.abc import Mapping
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from stereo_ore.errors import MissingExtraError

SCRIPTS = ("table.js", "picture.js", "cloud.js", "page.js")


def render(data: Mapping[str, Any], title: str) -> str:
    """HTML with everything inside."""
    parts = {
        "title": html.escape(title),
        "style": _part("page.css"),
        "data": _script_json(data),
        "plotly": _plotly(),
        "script": "\n".join(_part(name) for name in SCRIPTS),
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda mark: parts[mark[1]], _part("page.html"))


def _part(name: str) -> str:
    return (files("stereo_ore.report") / name).read_text(encoding="utf-8")


def _script_json(data: Mapping[str, Any]) -> str:
    """JSON that can stand in a script element: no tag can begin or end inside it."""
    text = json.dumps(data, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _plotly() -> str:
    """JavaScript of plotly, from the package's data: importing the package itself would take a
    second.
    """
    spec = find_spec("plotly")
    for place in (spec.submodule_search_locations or ()) if spec else ():
        file = Path(place) / "package_data" / "plotly.min.js"
        if file.is_file():
            return file.read_text(encoding="utf-8")
    raise MissingExtraError("plotly", "report")
