"""The networks that tell noise from a point's features, shipped as readable JSON."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from stereo_ore.errors import ConfigError
from stereo_ore.network import Network
from stereo_ore.types import F32


@dataclass(frozen=True)
class Scorer:
    """The networks of successive passes, and the names of all features; a network may take only the first of them.

    A point is noise above `threshold` unless parameters say otherwise; where more than the share `most_lost` of good
    points is then foretold to go, above the least probability that loses no more. `provenance` says what the networks
    were fitted to, by which version and seed, and how good they were on clouds left out.
    """

    features: list[str]
    passes: list[Network]
    threshold: float = 0.5
    most_lost: float | None = None
    provenance: dict[str, Any] = field(default_factory=dict)

    def decide(self, noise: F32) -> float:
        """Probability above which points with noise probabilities (M,) are removed."""
        if self.most_lost is None or not len(noise):
            return self.threshold
        falling = np.sort(noise)[::-1]
        lost = np.cumsum(1 - falling, dtype=np.float64)
        kept_from = int(np.searchsorted(lost, self.most_lost * lost[-1], side="right"))
        return max(self.threshold, float(falling[min(kept_from, len(falling) - 1)]))

    def to_json(self) -> str:
        """Readable text, a row of weights a line."""
        text = json.dumps(asdict(self), ensure_ascii=False, indent=1)
        return text.replace(",\n    ", ", ").replace("[\n    ", "[").replace("\n   ]", "]") + "\n"

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Scorer:
        """The scorer that `to_json` wrote."""
        return cls(**{**data, "passes": [Network(**network) for network in data["passes"]]})


@cache
def load(name: str) -> Scorer:
    """A scorer that ships with the package: ``geometry`` or ``stereo``."""
    text = (files("stereo_ore.filters") / "scorers" / f"{name}.json").read_text(encoding="utf-8")
    return Scorer.from_dict(json.loads(text))


@cache
def read(path: Path) -> Scorer:
    """A scorer that `tune --train` wrote.

    Raises
    ------
    ConfigError
        When the file can't be read, or is none.
    """
    try:
        return Scorer.from_dict(json.loads(path.read_text(encoding="utf-8")))
    except OSError as fault:
        raise ConfigError(f"can't be read: {fault.strerror}", file=path, key="filter.params.scorer") from None
    except (ValueError, TypeError, KeyError):
        remedy = "Name a file that tune --train geometry or stereo wrote"
        raise ConfigError("is no scorer", file=path, key="filter.params.scorer", remedy=remedy) from None
