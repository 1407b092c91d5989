"""The networks that tell noise from a point's features, shipped as readable JSON."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from functools import cache
from importlib.resources import files
from typing import Any

from stereo_ore.network import Network


@dataclass(frozen=True)
class Scorer:
    """The networks of successive passes, and the names of all features; a network may take only the first of them.

    `threshold` is the probability above which a point is called noise unless parameters say otherwise.
    """

    features: list[str]
    passes: list[Network]
    threshold: float = 0.5

    def to_json(self) -> str:
        """Readable text, a row of weights a line."""
        text = json.dumps(asdict(self), ensure_ascii=False, indent=1)
        return text.replace(",\n    ", ", ").replace("[\n    ", "[").replace("\n   ]", "]") + "\n"

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Scorer:
        """The scorer that `to_json` wrote."""
        return cls(data["features"], [Network(**network) for network in data["passes"]], data["threshold"])


@cache
def load(name: str) -> Scorer:
    """A scorer that ships with the package: ``geometry`` or ``stereo``."""
    text = (files("stereo_ore.stages.filters") / "scorers" / f"{name}.json").read_text(encoding="utf-8")
    return Scorer.from_dict(json.loads(text))
